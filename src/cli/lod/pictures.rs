//! Full detail beside what is drawn with levels of detail.

use std::io::{self, Write};
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

use super::Lod;
use crate::cli::{output, progress};

/// Pixels between two pictures.
const GAP_PX: u32 = 8;

/// Writes a PNG per camera, full detail first, and says what each tau draws.
pub(super) fn draw(
    lod: &Lod,
    catalog: Catalog,
    version: &Version,
    out: &Path,
) -> anyhow::Result<()> {
    let shots = shots(lod, version)?;
    let (names, views): (Vec<String>, Vec<View>) = shots.into_iter().unzip();
    let mut profiles = vec![RenderProfile { tau_px: 0.0, ..version.manifest.profile }];
    for &tau_px in &lod.tau {
        let profile = RenderProfile { tau_px, ..version.manifest.profile };
        profile.check()?;
        profiles.push(profile);
    }
    let backend = lod.backend.backend()?;
    let resident = Cache::new(catalog).open(&version.manifest.twin, Some(version.number))?;
    output::make_dir(out)?;
    let eyes = wildcity_session::viewpoints(&views);
    let bar = progress::count("rendering");
    bar.set_length(profiles.len() as u64);
    let mut drawn: Vec<Vec<RgbImage>> = Vec::new();
    let mut lines = Vec::new();
    for profile in &profiles {
        let scene = resident.scene(&eyes, profile)?;
        drawn.push(render(&*backend, &scene, profile, &views)?);
        let share = 100.0 * scene.gaussians() as f64 / version.manifest.gaussians() as f64;
        let (full, now) = (&drawn[0], &drawn[drawn.len() - 1]);
        let pairs = full.iter().zip(now).flat_map(|(full, now)| full.iter().zip(now.iter()));
        let decibels = match psnr_db_u8(pairs) {
            f64::INFINITY => "the same image".to_owned(),
            db => format!("{db:.1} dB"),
        };
        lines.push(format!("tau {:>4} px: {share:>5.1} % drawn, {decibels}", profile.tau_px));
        bar.inc(1);
    }
    bar.finish_and_clear();
    let mut said = io::stdout().lock();
    for line in &lines[1..] {
        writeln!(said, "{line}")?;
    }
    for (camera, name) in names.iter().enumerate() {
        let path = out.join(format!("{name}.png"));
        let row: Vec<&RgbImage> = drawn.iter().map(|images| &images[camera]).collect();
        let picture = side_by_side(&row);
        let file = wildcity_session::png(&picture, picture.width(), picture.height());
        output::write(&path, &file.map_err(anyhow::Error::msg)?)?;
        writeln!(said, "{}", path.display())?;
    }
    Ok(())
}

/// The cameras of the list, or of the rig in the middle of the drive.
fn shots(lod: &Lod, version: &Version) -> anyhow::Result<Vec<(String, View)>> {
    if let Some(path) = &lod.cameras {
        let listed = cameras::read(path).with_context(|| format!("{}", path.display()))?;
        let view = |listed: cameras::ListedCamera| {
            let cameras::ListedCamera { name, camera, world_from_camera, .. } = listed;
            (name, View::new(camera, world_from_camera))
        };
        return Ok(listed.into_iter().map(view).collect());
    }
    let manifest = &version.manifest;
    let log = manifest
        .trajectories
        .first()
        .with_context(|| format!("twin {:?} has no trajectory: give --cameras", manifest.twin))?;
    let world_from_rig = log.at_station(0.5 * log.length_m());
    let rig = manifest.rig.clone().or_else(|| Rig::preset(wildcity_session::limits::RIG));
    let rig = rig.context("no rig")?;
    let names = rig.cameras.iter().map(|camera| camera.name.clone());
    Ok(names.zip(View::of_rig(&rig.cameras, world_from_rig)).collect())
}

fn render(
    backend: &dyn Backend,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) -> anyhow::Result<Vec<RgbImage>> {
    let empty = |view: &View| RgbImage::new(view.camera.width_px, view.camera.height_px);
    let mut images: Vec<RgbImage> = views.iter().map(empty).collect();
    let target = |image| Target { rgb8: Some(image), ..Target::default() };
    let mut targets: Vec<Target<'_>> = images.iter_mut().map(|image| target(image)).collect();
    backend.render(&Frame { scene, profile, views }, &mut targets, &|_, _| {})?;
    Ok(images)
}

fn side_by_side(row: &[&RgbImage]) -> RgbImage {
    let [width, height] = [row[0].width(), row[0].height()];
    let count = row.len() as u32;
    let mut picture = RgbImage::new(count * (width + GAP_PX) - GAP_PX, height);
    for (place, image) in (0_u32..).zip(row) {
        imageops::replace(&mut picture, *image, i64::from(place * (width + GAP_PX)), 0);
    }
    picture
}
