//! Compares a rendered image with the real one, and the repaired image, too.

use crate::{EvaluatedImage, Pair, PairScores, Thumbnails};
use wildcity_render::View;
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::FieldMask;
use wildcity_scene::rig::RigCamera;
use wildcity_session::{OfflineView, RenderedImage};

use super::Evaluator;
use super::off_trajectory::Lens;
use super::renderer::{covered, expose};
use crate::images::{RealImage, own_vehicle, picture};

/// A compared image, with all that its views off the trajectory need.
pub(super) struct Compared {
    pub(super) scores: EvaluatedImage,
    pub(super) view: View,
    pub(super) profile: RenderProfile,
    pub(super) truth: Vec<u8>,
    pub(super) rendered: RenderedImage,
    pub(super) repaired: Option<Vec<u8>>,
    pub(super) counts: Option<Vec<bool>>,
    pub(super) camera: RigCamera,
    /// The camera for the warp, if images are repaired or there are views off the trajectory.
    pub(super) lens: Option<Lens>,
}

/// A real image, and the pixels of it that count.
#[derive(Clone, Copy)]
struct Truth<'a> {
    name: &'a str,
    size_px: [u32; 2],
    rgb8: &'a [u8],
    counts: Option<&'a [bool]>,
}

impl Evaluator<'_> {
    /// Renders one image and compares it with the real one. Does the same with the repaired image,
    /// if there is a model.
    pub(super) fn evaluate(
        &self,
        image: &RealImage,
        camera_name: &str,
    ) -> anyhow::Result<Compared> {
        let Self { renderer, repairer, labels, .. } = self;
        // Render the view of the camera.
        let profile = renderer.profile(image.near)?;
        let (truth, camera) = picture::real(&image.file, &image.camera, profile.background)?;
        let size_px = [camera.width_px, camera.height_px];
        let view = View::new(camera, renderer.alignment.pose(&image.world_from_camera));
        let mut rendered = renderer.render(&view, &profile)?;

        // Repair it, in the exposure of the twin.
        let needs_lens = repairer.is_some() || !self.settings.offsets_m.is_empty();
        let lens = needs_lens.then(|| Lens::from_camera(&camera));
        let camera = RigCamera::new(camera_name, camera, Pose::IDENTITY);
        let mut repaired = match &lens {
            Some(lens) => self.repaired(&view, &profile, &camera, lens, &mut rendered)?,
            None => None,
        };
        expose(image.exposure_stops, &mut rendered, &mut repaired);

        // Leave out what the twin does not have: masked pixels, the own vehicle, and moving
        // objects.
        let mask = image.mask.as_deref().map(|file| picture::mask(file, size_px)).transpose()?;
        let rig = renderer.source.version().and_then(|version| version.manifest.rig.as_ref());
        let outside = own_vehicle::outside(rig, camera_name, size_px);
        let (still, moving) = labels.hide(image, &view, &renderer.alignment).unzip();
        if self.save.is_some() {
            still.iter().try_for_each(|still| self.save_mask(&image.name, still, size_px))?;
        }
        let masked = own_vehicle::both(own_vehicle::both(mask, outside), still);
        let counts = counted(&view, masked);

        // Compare.
        let of = Truth { name: &image.name, size_px, rgb8: &truth, counts: counts.as_deref() };
        let folders = ["rendered", "errors"];
        let (pair, compared) = self.compare(of, &rendered.rgb8, folders)?;
        let name = image.name.clone();
        let mut scores = EvaluatedImage::new(name, size_px, covered(&rendered), &compared);
        scores.moving = moving;
        scores.lidar = labels.depth(image, &view, &rendered, of.counts);
        let mut thumbnails =
            Thumbnails::from_pair(&pair, &compared.error_map).map_err(anyhow::Error::msg)?;
        if let Some(rgb8) = &repaired {
            let folders = ["repaired", "repaired_errors"];
            let (pair, compared) = self.compare(of, rgb8, folders)?;
            scores.repaired = Some(compared.scored());
            let with = thumbnails.with_repaired(&pair, &compared.error_map);
            thumbnails = with.map_err(anyhow::Error::msg)?;
        }
        scores.thumbnails = Some(thumbnails);
        Ok(Compared { scores, view, profile, truth, rendered, repaired, counts, camera, lens })
    }

    /// Compares an image with the real one. If images are saved, saves the image and the map of
    /// its errors to two folders.
    fn compare(
        &self,
        Truth { name, size_px, rgb8: truth, counts }: Truth<'_>,
        rgb8: &[u8],
        folders: [&str; 2],
    ) -> anyhow::Result<(Pair, PairScores)> {
        let owned = counts.map(<[bool]>::to_vec);
        let pair = Pair::new(size_px, truth.to_vec(), rgb8.to_vec(), owned)?;
        let mut compared = PairScores::compare(&pair, self.settings.align_exposure);
        compared.scores.lpips = self.networks.lpips(size_px, rgb8, truth, counts)?;
        if self.save.is_some() {
            self.save_pair(name, folders, &pair, &compared.error_map)?;
        }
        Ok((pair, compared))
    }

    /// The repaired pixels of an image, if there is a model. Sets the trust of the image.
    fn repaired(
        &self,
        view: &View,
        profile: &RenderProfile,
        camera: &RigCamera,
        lens: &Lens,
        rendered: &mut RenderedImage,
    ) -> anyhow::Result<Option<Vec<u8>>> {
        let Some(repairer) = &self.repairer else { return Ok(None) };
        let placed = self.drives.as_ref().and_then(|drives| {
            let place = drives.place(&camera.name, &view.world_from_camera)?;
            Some((drives, place.world_from_rig))
        });
        // Without a drive the pose of the camera is taken for that of the rig, and the trust is 1.
        let world_from_rig = placed.map_or(view.world_from_camera, |(_, rig)| rig);
        rendered.trust = placed.map_or(1.0, |(drives, rig)| drives.trust(&rig, view, rendered));
        let of = OfflineView {
            camera,
            rays: &lens.rays,
            view,
            world_from_rig: &world_from_rig,
            rendered,
            kept: None,
        };
        Ok(Some(repairer.repair(&self.renderer, &of, profile)?.rgb8))
    }
}

/// The pixels that count: not masked, and within the lens' field.
fn counted(view: &View, mask: Option<Vec<bool>>) -> Option<Vec<bool>> {
    let Some(field) = FieldMask::from_camera(&view.camera) else { return mask };
    let mut counts = mask.unwrap_or_else(|| vec![true; view.camera.pixels()]);
    field.clear_outside(&view.camera, 1, &mut counts);
    Some(counts)
}
