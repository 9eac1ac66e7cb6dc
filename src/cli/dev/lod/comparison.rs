//! Images with levels of detail next to images at full detail.

use std::io::Write;
use std::path::Path;

use anyhow::Context;
use image::RgbImage;
use image::imageops;

use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::{RenderProfile, Rig, Scene};
use wildcity_twin::ingest::cameras;
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, Version};

use crate::cli::{output, progress};

/// Pixels between two images.
const GAP_PX: u32 = 8;

/// A comparison of values of `tau_px` with full detail.
pub(super) struct Comparison<'a> {
    /// The values, in pixels.
    pub(super) taus_px: &'a [f64],
    /// A list of cameras. None for the rig in the middle of the drive.
    pub(super) cameras: Option<&'a Path>,
    pub(super) backend: &'a dyn Backend,
}

/// A camera with its name.
struct NamedView {
    name: String,
    view: View,
}

impl Comparison<'_> {
    /// Writes a PNG for each camera, with full detail on the left, and prints for each value the
    /// share of Gaussians that is rendered and the PSNR.
    pub(super) fn write(
        &self,
        catalog: Catalog,
        version: &Version,
        out: &Path,
    ) -> anyhow::Result<()> {
        let named_views = self.views(version)?;
        let views: Vec<View> = named_views.iter().map(|named| named.view).collect();
        let profiles = self.profiles(version.manifest.profile)?;
        let resident = Cache::new(catalog).open(&version.manifest.twin, Some(version.number))?;
        output::create_dir(out)?;

        // Images of all cameras, profile by profile.
        let viewpoints = wildcity_session::viewpoints(&views);
        let bar = progress::count("rendering");
        bar.set_length(profiles.len() as u64);
        let mut by_profile: Vec<Vec<RgbImage>> = Vec::new();
        let mut lines = Vec::new();
        for profile in &profiles {
            let scene = resident.scene(&viewpoints, profile)?;
            by_profile.push(self.render(&scene, profile, &views)?);
            // Of all views together: each draws levels of its own.
            let drawn: usize = (0..views.len()).map(|view| scene.for_view(view).gaussians()).sum();
            let all = views.len() as f64 * version.manifest.gaussians() as f64;
            let share = 100.0 * drawn as f64 / all;
            let full = &by_profile[0];
            let now = &by_profile[by_profile.len() - 1];
            let pairs = full.iter().zip(now).flat_map(|(full, now)| full.iter().zip(now.iter()));
            let psnr = match psnr_db_u8(pairs) {
                f64::INFINITY => "the same image".to_owned(),
                db => format!("{db:.1} dB"),
            };
            lines.push(format!("tau {:>4} px: {share:>5.1} % drawn, {psnr}", profile.tau_px));
            bar.inc(1);
        }
        bar.finish_and_clear();

        // The first line compares full detail with itself.
        let mut stdout = output::stdout();
        for line in &lines[1..] {
            writeln!(stdout, "{line}")?;
        }
        for (camera, NamedView { name, .. }) in named_views.iter().enumerate() {
            let path = out.join(format!("{name}.png"));
            let row: Vec<&RgbImage> = by_profile.iter().map(|images| &images[camera]).collect();
            let joined = side_by_side(&row);
            let file = wildcity_session::png(&joined, joined.width(), joined.height());
            output::write(&path, &file.map_err(anyhow::Error::msg)?)?;
            writeln!(stdout, "{}", path.display())?;
        }
        Ok(())
    }

    /// The profile at full detail, and with each value.
    fn profiles(&self, own: RenderProfile) -> anyhow::Result<Vec<RenderProfile>> {
        let mut profiles = vec![RenderProfile { tau_px: 0.0, ..own }];
        for &tau_px in self.taus_px {
            let profile = RenderProfile { tau_px, ..own };
            profile.check().context("--tau")?;
            profiles.push(profile);
        }
        Ok(profiles)
    }

    /// The cameras of the list, or of the rig in the middle of the drive.
    fn views(&self, version: &Version) -> anyhow::Result<Vec<NamedView>> {
        if let Some(path) = self.cameras {
            let listed = cameras::read(path).with_context(|| format!("{}", path.display()))?;
            let view = |listed: cameras::ListedCamera| {
                let cameras::ListedCamera { name, camera, world_from_camera, .. } = listed;
                NamedView { name, view: View::new(camera, world_from_camera) }
            };
            return Ok(listed.into_iter().map(view).collect());
        }
        let manifest = &version.manifest;
        let drive = manifest.trajectories.first().with_context(|| {
            format!("twin {:?} has no trajectory: give --cameras", manifest.twin)
        })?;
        let world_from_rig = drive.at_station(0.5 * drive.length_m());
        let rig = manifest
            .rig
            .clone()
            .or_else(|| Rig::preset(wildcity_session::limits::RIG))
            .context("the default rig preset is missing")?;
        let names = rig.cameras.iter().map(|camera| camera.name.clone());
        let views = View::from_rig(&rig.cameras, world_from_rig);
        Ok(names.zip(views).map(|(name, view)| NamedView { name, view }).collect())
    }

    fn render(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        views: &[View],
    ) -> anyhow::Result<Vec<RgbImage>> {
        let empty = |view: &View| RgbImage::new(view.camera.width_px, view.camera.height_px);
        let mut images: Vec<RgbImage> = views.iter().map(empty).collect();
        let target = |image| Target { rgb8: Some(image), ..Target::default() };
        let mut targets: Vec<Target<'_>> = images.iter_mut().map(|image| target(image)).collect();
        self.backend.render(&Frame { scene, profile, views }, &mut targets, &|_, _| {})?;
        Ok(images)
    }
}

/// One image with several of the same size in a row.
fn side_by_side(row: &[&RgbImage]) -> RgbImage {
    let width = row[0].width();
    let height = row[0].height();
    let count = row.len() as u32;
    let mut joined = RgbImage::new(count * (width + GAP_PX) - GAP_PX, height);
    for (column, image) in (0_u32..).zip(row) {
        imageops::replace(&mut joined, *image, i64::from(column * (width + GAP_PX)), 0);
    }
    joined
}
