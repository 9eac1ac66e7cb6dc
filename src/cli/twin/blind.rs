//! Cameras that see nothing of their twin: a rig or a drive in other axes than the twin, which
//! nothing else tells before the first session.

use std::io::{self, Write};

use wildcity_render::View;
use wildcity_render::compare::images::render_images;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_session::OpenScene;
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, Version};

/// Places that are looked from along each drive, at most.
const PLACES: usize = 6;
/// Places that are looked from in all, at most: each is rendered while a camera sees nothing.
const MOST_PLACES: usize = 24;
/// Longer side of the images that are looked at, in pixels.
const SIDE_PX: u32 = 64;
/// Share of an image that must be opaque.
const LEAST_SEEN: f64 = 0.01;

/// Warns of the cameras of a version's rig that see nothing of it, at no place along its drives, or
/// at the origin if it has none.
pub(in crate::cli) fn warn(catalog: &Catalog, version: &Version) -> anyhow::Result<()> {
    let Some(rig) = version.manifest.rig.as_ref().filter(|_| !version.manifest.chunks.is_empty())
    else {
        return Ok(());
    };
    let places = places(version);
    // The version is published: what cannot be looked at is no error.
    let text = match blind(catalog, version, rig, &places) {
        Ok(names) if names.is_empty() => return Ok(()),
        Ok(names) => format!(
            "these cameras see nothing of the twin, wherever the drive is: {}; look at the rig's camera_to_rig, and \
             at the axes and the unit of the drive (places looked from: {})",
            names.join(", "),
            places.len()
        ),
        Err(error) => format!("what the cameras see was not looked at: {error}"),
    };
    writeln!(io::stderr(), "warning: rig {}: {text}", rig.name)?;
    Ok(())
}

/// The names of the cameras that see nothing from any of the places.
fn blind<'a>(
    catalog: &Catalog,
    version: &Version,
    rig: &'a Rig,
    places: &[Pose],
) -> anyhow::Result<Vec<&'a str>> {
    let resident =
        Cache::new(catalog.clone()).open(&version.manifest.twin, Some(version.number))?;
    let scene = OpenScene::Twin(resident);
    let profile = version.manifest.profile;
    let backend = Cpu::new(0, Simd::Best)?;
    // One place at which it sees something is enough for a camera: it is not drawn again.
    let mut unseen: Vec<&RigCamera> = rig.cameras.iter().collect();
    for place in places {
        let views = views(&unseen, place)?;
        let drawn = scene.scene(&views, &profile)?;
        let images = render_images(&backend, &drawn, &profile, &views)?;
        let mut seen = images.iter().map(|image| is_seen(&image.opacity));
        // One image for each camera, in order.
        unseen.retain(|_| !seen.next().unwrap_or(false));
        if unseen.is_empty() {
            break;
        }
    }
    Ok(unseen.into_iter().map(|camera| camera.name.as_str()).collect())
}

fn is_seen(opacity: &[f32]) -> bool {
    let opaque = opacity.iter().filter(|&&opacity| opacity > 0.5).count();
    // Pixels and not Gaussians are counted: one large Gaussian is enough to see something.
    opaque as f64 >= LEAST_SEEN * opacity.len() as f64
}

/// Poses of the rig, evenly along each drive, and evenly over all drives if those are too many.
fn places(version: &Version) -> Vec<Pose> {
    let drives = &version.manifest.trajectories;
    if drives.is_empty() {
        return vec![Pose::IDENTITY];
    }
    let along_each = drives.iter().flat_map(|drive| {
        let chosen = spread(drive.keyframes.len(), PLACES);
        chosen.map(move |at| drive.keyframes[at].world_from_rig)
    });
    let all: Vec<Pose> = along_each.collect();
    spread(all.len(), MOST_PLACES).map(|at| all[at]).collect()
}

/// Indices of at most this many of `count` things, evenly from the first to the last one.
fn spread(count: usize, most: usize) -> impl Iterator<Item = usize> {
    let chosen = count.min(most);
    // For no things the closure is never called, so that nothing underflows.
    (0..chosen).map(move |at| at * (count - 1) / (chosen - 1).max(1))
}

fn views(cameras: &[&RigCamera], world_from_rig: &Pose) -> anyhow::Result<Vec<View>> {
    cameras.iter().map(|camera| view(camera, world_from_rig)).collect()
}

fn view(camera: &RigCamera, world_from_rig: &Pose) -> anyhow::Result<View> {
    let full = &camera.camera;
    let shrink = f64::from(SIDE_PX) / f64::from(full.width_px.max(full.height_px));
    let side = |full_px: u32| (f64::from(full_px) * shrink).ceil().max(1.0) as u64;
    // Whether anything is seen at all does not need detail, and a small image is drawn fast.
    let small = full.scaled(side(full.width_px), side(full.height_px))?;
    Ok(View::new(small, *world_from_rig * camera.rig_from_camera))
}
