//! Renders small images before and after a proposed change, and compares them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use tokio::time::Instant;

use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::{Frame, Target, View};
use wildcity_scene::chunk::cell_at;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Chunk, Gaussians, RenderProfile, Rig, Scene};
use wildcity_session::{Engine, FrameCost, PUSHES, SessionError, viewpoints};
use wildcity_twin::residency::{SectionRef, demand};
use wildcity_twin::store::{Catalog, StoreError, Version};

use crate::blocking::run_blocking;
use crate::error::PushError;
use crate::limits;

/// One pose, before and after the change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PsnrPreview {
    /// Where the rig is.
    pub world_from_rig: Pose,
    /// PSNR between the images before and after, all cameras together, in dB; infinite if they are equal.
    pub psnr_db: f64,
}

/// A change that a push proposes: a version with other Gaussians in some of its cells.
pub(crate) struct ProposedChange {
    /// The version as it is.
    pub(crate) before: Arc<Version>,
    /// The new Gaussians of the replaced cells.
    pub(crate) gaussians: Arc<Gaussians>,
    /// The replaced cells.
    pub(crate) cells: BTreeSet<[i32; 2]>,
    /// The render profile after the change.
    pub(crate) profile: RenderProfile,
}

/// Sections that were read for earlier poses, by chunk and section.
type LoadedSections = BTreeMap<SectionRef, Arc<Chunk>>;

/// Renders small images of a version before and after a proposed change, and compares them. The frames wait
/// in the render queue with those of the sessions, until the deadline. It may be later than that of a step, because no
/// agent waits for them. Without `poses`, the images are taken from some poses along the first trajectory, near the
/// change. Calls `progress` with the number of poses that are done and the
/// number of all poses.
///
/// # Errors
/// The version cannot be read, or the backend refuses a frame.
pub(crate) async fn preview_psnr(
    engine: &Arc<Engine>,
    change: ProposedChange,
    poses: Option<Vec<Pose>>,
    deadline: Instant,
    progress: &(dyn Fn(u64, u64) + Sync),
) -> Result<Vec<PsnrPreview>, PushError> {
    let poses = poses.unwrap_or_else(|| preview_poses(&change));
    let manifest = &change.before.manifest;
    let rig = manifest.rig.clone().or_else(|| Rig::preset(wildcity_session::limits::RIG));
    let cameras: Option<Vec<RigCamera>> =
        rig.iter().flat_map(|rig| rig.cameras.iter().map(scaled_down)).collect();
    let cameras = cameras.unwrap_or_default();
    if poses.is_empty() || cameras.is_empty() {
        return Ok(Vec::new());
    }

    let gaussians = change.gaussians.clone();
    let mut new_scene = run_blocking(move || Ok(Scene::from_gaussians(&gaussians))).await?;
    let resident = engine.open_version(manifest.twin.clone(), Some(change.before.number)).await?;
    for profile in [manifest.profile, change.profile] {
        Engine::bake_sky(resident.clone(), profile).await?;
    }

    let mut loaded = LoadedSections::new();
    let mut previews = Vec::new();
    let total = poses.len() as u64;
    for (done, world_from_rig) in (0..).zip(poses) {
        progress(done, total);
        let views = View::of_rig(&cameras, world_from_rig);

        // Read both scenes on a blocking thread, which gets the new Gaussians and the sections read so far.
        let scenes = {
            let mut reader = SceneReader {
                catalog: engine.catalog().clone(),
                version: change.before.clone(),
                profile: change.profile,
                loaded,
            };
            let views = views.clone();
            let cells = change.cells.clone();
            let sky = resident.sky().cloned();
            run_blocking(move || {
                let before = reader.read(&BTreeSet::new(), &views)?;
                let after = merged(reader.read(&cells, &views)?, &new_scene);
                Ok(BothScenes {
                    before: Scene { sky: sky.clone(), ..before },
                    after: Scene { sky, ..after },
                    new_scene,
                    loaded: reader.loaded,
                })
            })
            .await?
        };
        new_scene = scenes.new_scene;
        loaded = scenes.loaded;

        let before =
            render_small(engine, scenes.before, manifest.profile, views.clone(), deadline).await?;
        let after = render_small(engine, scenes.after, change.profile, views, deadline).await?;
        let psnr_db = psnr_db_u8(before.iter().zip(&after));
        previews.push(PsnrPreview { world_from_rig, psnr_db });
    }
    Ok(previews)
}

/// The RGB pixels of all views, one after the other.
async fn render_small(
    engine: &Engine,
    scene: Scene,
    profile: RenderProfile,
    views: Vec<View>,
    deadline: Instant,
) -> Result<Vec<u8>, PushError> {
    let pixels = views.iter().map(|view| view.camera.pixels() as u64).sum();
    let cost = FrameCost { session: PUSHES, pixels };
    let rendered = engine.run(cost, deadline, move |_, backend| {
        let mut images: Vec<_> =
            views.iter().map(|view| vec![0; 3 * view.camera.pixels()]).collect();
        let mut targets: Vec<_> = images
            .iter_mut()
            .map(|rgb8| Target { rgb8: Some(rgb8), ..Target::default() })
            .collect();
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        backend.render(&frame, &mut targets, &|_, _| {}).map(|_| images.concat())
    });
    let (pixels, _queued) = rendered.await?;
    Ok(pixels.map_err(SessionError::from)?)
}

/// The scenes before and after the change at one pose, and what the next pose reuses.
struct BothScenes {
    before: Scene,
    after: Scene,
    new_scene: Scene,
    loaded: LoadedSections,
}

/// Reads what a frame shows of a version.
struct SceneReader {
    catalog: Catalog,
    version: Arc<Version>,
    profile: RenderProfile,
    loaded: LoadedSections,
}

impl SceneReader {
    /// The part of the version that the views show, without some of its cells. Sections that were read
    /// before are not read again.
    fn read(&mut self, without: &BTreeSet<[i32; 2]>, views: &[View]) -> Result<Scene, StoreError> {
        let manifest = &self.version.manifest;
        let mut scene = Scene::default();
        for section in demand(manifest, &viewpoints(views), &self.profile) {
            let chunk = &manifest.chunks[section.chunk];
            if without.contains(&chunk.cell) {
                continue;
            }
            let read = match self.loaded.get(&section) {
                Some(known) => known.clone(),
                None => {
                    let entry = &chunk.sections[section.section];
                    let read = Arc::new(self.catalog.section(&self.version, chunk, entry)?);
                    self.loaded.insert(section, read.clone());
                    read
                }
            };
            scene.chunks.push(read);
        }
        Ok(scene)
    }
}

/// The chunks of both scenes, in order of their cells.
fn merged(mut kept: Scene, new: &Scene) -> Scene {
    kept.chunks.extend(new.chunks.iter().cloned());
    kept.chunks.sort_by_key(|chunk| {
        let [x, y] = chunk.cell();
        [y, x]
    });
    kept
}

/// Poses along the first trajectory: spread over the part that lies in the replaced cells, or over all of
/// it if no part does.
fn preview_poses(change: &ProposedChange) -> Vec<Pose> {
    let Some(drive) = change.before.manifest.trajectories.first() else { return Vec::new() };
    let poses: Vec<Pose> = drive.keyframes.iter().map(|key| key.world_from_rig).collect();
    let is_replaced = |pose: &&Pose| change.cells.contains(&cell_at(&pose.position_m.to_array()));
    let replaced: Vec<&Pose> = poses.iter().filter(is_replaced).collect();
    let candidates = if replaced.is_empty() { poses.iter().collect() } else { replaced };
    let count = limits::PREVIEW_DEFAULT_POSES.min(candidates.len());
    // The middles of `count` equal parts.
    (0..count).map(|k| *candidates[(2 * k + 1) * candidates.len() / (2 * count)]).collect()
}

/// The camera with the same field of view and at most `PREVIEW_SIDE_PX` per side.
fn scaled_down(camera: &RigCamera) -> Option<RigCamera> {
    let Camera { width_px, height_px, .. } = camera.camera;
    let scale = f64::from(limits::PREVIEW_SIDE_PX) / f64::from(width_px.max(height_px));
    if scale >= 1.0 {
        return Some(camera.clone());
    }
    let side = |px: u32| (f64::from(px) * scale).round().max(1.0) as u64;
    let camera_scaled = camera.camera.scaled(side(width_px), side(height_px)).ok()?;
    Some(RigCamera { camera: camera_scaled, ..camera.clone() })
}
