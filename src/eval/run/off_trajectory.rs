//! Views off the trajectory, for which there is no real image.

use std::sync::Arc;

use glam::DVec3;

use crate::{ExtrapolatedView, Extrapolation, Reprojection, ViewScores, jpeg};
use wildcity_render::View;
use wildcity_render::compare::flicker::flicker;
use wildcity_repair::Image;
use wildcity_repair::reference::{
    Projection, Rays, Reference, WarpTarget, Warped, opaque_depth, warp,
};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_session::{OfflineView, RenderedImage};

use super::drive::{DrivePlace, Drives};
use super::renderer::{Renderer, covered, expose};
use super::repairer::Repairer;

/// The renderer, the repairer and the recorded drives that the views need.
#[derive(Clone, Copy)]
pub(super) struct Tools<'a> {
    pub(super) renderer: &'a Renderer,
    pub(super) repairer: Option<&'a Repairer>,
    pub(super) drives: &'a Drives,
}

/// A real image, whose camera is moved sideways for the views.
pub(super) struct OnDrive<'a> {
    pub(super) name: &'a str,
    pub(super) camera: &'a RigCamera,
    pub(super) lens: &'a Lens,
    /// Exposure of the real image in stops against the twin's, if it is known.
    pub(super) exposure_stops: Option<f64>,
    pub(super) view: &'a View,
    pub(super) profile: &'a RenderProfile,
    pub(super) truth: &'a [u8],
    /// The image that was rendered with its camera.
    pub(super) rendered: &'a RenderedImage,
    /// Which pixels of the real image count.
    pub(super) counts: Option<&'a [bool]>,
    /// Whether the page shows the pictures of its views.
    pub(super) is_shown: bool,
}

/// The pixels of a view off the trajectory.
pub(super) struct OffTrajectoryImage {
    pub(super) rendered: Vec<u8>,
    pub(super) repaired: Option<Vec<u8>>,
}

/// The views off the trajectory, distance by distance.
pub(super) struct OffTrajectoryViews(Vec<Line>);

struct Line {
    offset_m: f64,
    views: Vec<ExtrapolatedView>,
    pictures: Vec<(&'static str, Vec<u8>)>,
}

/// A rendered view, with its repaired pixels if there is a model.
struct Drawn {
    view: View,
    rendered: RenderedImage,
    repaired: Option<Vec<u8>>,
    /// Name of the nearest recorded image, if the model saw it.
    nearest: Option<String>,
}

/// The camera of an image and of its views, in the form that the warp needs.
pub(super) struct Lens {
    pub(super) rays: Rays,
    projection: Arc<Projection>,
}

impl Lens {
    pub(super) fn from_camera(camera: &Camera) -> Self {
        Self {
            rays: Rays::from_camera(camera),
            projection: Arc::new(Projection::from_camera(camera)),
        }
    }
}

impl OffTrajectoryViews {
    pub(super) fn new(offsets_m: &[f64]) -> Self {
        let line =
            |offset_m: &f64| Line { offset_m: *offset_m, views: Vec::new(), pictures: Vec::new() };
        Self(offsets_m.iter().map(line).collect())
    }

    /// Renders and compares the views of an image. Returns their pixels, distance by distance.
    pub(super) fn add(
        &mut self,
        tools: Tools<'_>,
        image: &OnDrive<'_>,
    ) -> anyhow::Result<Vec<OffTrajectoryImage>> {
        let place = tools.drives.place(&image.camera.name, &image.view.world_from_camera);
        let Some(place) = place else { return Ok(Vec::new()) };
        let mut drawn = Vec::with_capacity(self.0.len());
        for line in &mut self.0 {
            drawn.push(line.add(tools, image, &place)?);
        }
        Ok(drawn)
    }

    /// The means of all views.
    pub(super) fn finish(self) -> Vec<Extrapolation> {
        let line = |line: Line| Extrapolation {
            pictures: line.pictures,
            ..Extrapolation::new(line.offset_m, line.views)
        };
        self.0.into_iter().map(line).collect()
    }
}

impl Line {
    fn add(
        &mut self,
        tools: Tools<'_>,
        image: &OnDrive<'_>,
        place: &DrivePlace<'_>,
    ) -> anyhow::Result<OffTrajectoryImage> {
        let lens = image.lens;
        let moved_m = self.offset_m * place.left();
        // The previous view is rendered first, and this one keeps its nearest recorded image, as in
        // a session.
        let step = place.step_back();
        // The step is applied after the shift: so the view before is as far beside the drive as
        // this one, also in a curve.
        let before = step
            .map(|step| draw(tools, image, place, &|pose| step * moved(pose, moved_m), None))
            .transpose()?;
        let kept = before.as_ref().and_then(|before| before.nearest.as_deref());
        let now = draw(tools, image, place, &|pose| moved(pose, moved_m), kept)?;

        // The geometry is that of the rendered views, also for the repaired pixels.
        let onto_now = |of: &dyn Fn(&Drawn) -> Vec<u8>| match &before {
            Some(before) => {
                let back = into(lens, &now.view, &now.rendered, before, of(before));
                // NaN if no pixel can be compared: 0 would say that nothing flickers.
                flicker(&of(&now), &back.image.rgb8, &back.valid).unwrap_or(f64::NAN)
            }
            None => f64::NAN,
        };
        let size_px = [image.view.camera.width_px, image.view.camera.height_px];
        let scores = |of: &dyn Fn(&Drawn) -> Vec<u8>| {
            let back = into(lens, image.view, image.rendered, &now, of(&now));
            let reprojection = Reprojection::compare(
                size_px,
                image.truth,
                &back.image.rgb8,
                &back.valid,
                image.counts,
            );
            let scores = ViewScores { reprojection: reprojection?, flicker: onto_now(of) };
            anyhow::Ok((scores, back.image.rgb8))
        };
        let (rendered, mut came_back) = scores(&|drawn| drawn.rendered.rgb8.clone())?;
        // The picture that is brought back is the one that a session would deliver.
        let mut repaired = None;
        if now.repaired.is_some() {
            let of = |drawn: &Drawn| drawn.repaired.clone().unwrap_or_default();
            let (scores, back) = scores(&of)?;
            repaired = Some(scores);
            came_back = back;
        }
        if image.is_shown {
            let mut show = |what, pixels: &[u8]| {
                let file = jpeg(pixels, size_px).map_err(anyhow::Error::msg)?;
                self.pictures.push((what, file));
                anyhow::Ok(())
            };
            show("on the drive", image.truth)?;
            show("rendered beside it", &now.rendered.rgb8)?;
            if let Some(repaired) = &now.repaired {
                show("repaired", repaired)?;
            }
            show("brought back", &came_back)?;
        }
        self.views.push(ExtrapolatedView {
            name: image.name.to_owned(),
            trust: now.rendered.trust,
            covered: covered(&now.rendered),
            rendered,
            repaired,
        });
        Ok(OffTrajectoryImage { rendered: now.rendered.rgb8, repaired: now.repaired })
    }
}

fn moved(pose: &Pose, by_m: DVec3) -> Pose {
    Pose { position_m: pose.position_m + by_m, ..*pose }
}

/// Renders the view of an image after moving the camera and the rig.
fn draw(
    tools: Tools<'_>,
    image: &OnDrive<'_>,
    place: &DrivePlace<'_>,
    moved: &dyn Fn(&Pose) -> Pose,
    kept: Option<&str>,
) -> anyhow::Result<Drawn> {
    let Tools { renderer, repairer, drives } = tools;
    let view = View::new(image.view.camera, moved(&image.view.world_from_camera));
    let world_from_rig = moved(&place.world_from_rig);
    let mut rendered = renderer.render(&view, image.profile)?;
    // Before the repair: a model may take the trust as an input.
    rendered.trust = drives.trust(&world_from_rig, &view, &rendered);
    let of = OfflineView {
        camera: image.camera,
        rays: &image.lens.rays,
        view: &view,
        world_from_rig: &world_from_rig,
        rendered: &rendered,
        kept,
    };
    let repair = |repairer: &Repairer| repairer.repair(renderer, &of, image.profile);
    let (mut repaired, nearest) =
        repairer.map(repair).transpose()?.map(|it| (it.rgb8, it.nearest)).unzip();
    // After the repair, which works in the exposure of the twin.
    expose(image.exposure_stops, &mut rendered, &mut repaired);
    Ok(Drawn { view, rendered, repaired, nearest: nearest.flatten() })
}

/// Warps pixels of one view into another by the rendered depths of both.
fn into(lens: &Lens, view: &View, rendered: &RenderedImage, from: &Drawn, rgb8: Vec<u8>) -> Warped {
    let depth_m = opaque_depth(&rendered.depth_m, &rendered.opacity);
    let [width, height] = [view.camera.width_px, view.camera.height_px].map(|side| side as usize);
    let reference = Reference {
        image: Image { width, height, rgb8 },
        depth_m: opaque_depth(&from.rendered.depth_m, &from.rendered.opacity),
        projection: lens.projection.clone(),
        world_from_camera: from.view.world_from_camera,
    };
    let target = WarpTarget {
        camera: &view.camera,
        rays: &lens.rays,
        world_from_camera: view.world_from_camera,
        shutter: None,
        depth_m: &depth_m,
    };
    warp(&target, &[Arc::new(reference)])
}
