//! What a push changes of the picture, before anybody sees it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use tokio::time::Instant;

use crate::limits;
use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::{Frame, Target, View};
use wildcity_scene::chunk::cell_at;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Chunk, Gaussians, Manifest, RenderProfile, Rig, Scene};
use wildcity_twin::residency::{SectionRef, demand};
use wildcity_twin::store::{Catalog, Version};

use crate::engine::Engine;
use crate::error::SessionError;
use crate::observe::builder::viewpoints;

/// One pose, before and after.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PsnrPreview {
    /// Where the rig stands.
    pub world_from_rig: Pose,
    /// How alike the images of all cameras are together, in dB; infinite if they are equal.
    pub psnr_db: f64,
}

/// A version as it would be with other cells.
pub struct ProposedChange {
    /// As it is.
    pub before: Arc<Version>,
    /// What lies in the replaced cells instead.
    pub gaussians: Arc<Gaussians>,
    /// The cells whose own Gaussians go.
    pub cells: BTreeSet<[i32; 2]>,
    /// How it would be rendered.
    pub profile: RenderProfile,
}

impl Engine {
    /// Draws small images of a version and of what it would become, each in its turn among the
    /// sessions' frames. Without `poses`, some along the first trajectory, near what changes.
    ///
    /// # Errors
    /// What is there cannot be read, or the backend refuses a frame.
    pub async fn preview_psnr(
        self: &Arc<Self>,
        changed: ProposedChange,
        poses: Option<Vec<Pose>>,
        progress: &(dyn Fn(u64, u64) + Sync),
    ) -> Result<Vec<PsnrPreview>, SessionError> {
        let poses = poses.unwrap_or_else(|| stations(&changed));
        let manifest = &changed.before.manifest;
        let rig = manifest.rig.clone().or_else(|| Rig::preset(limits::RIG));
        let cameras: Vec<_> = rig.iter().flat_map(|rig| rig.cameras.iter().map(small)).collect();
        let cameras = cameras.into_iter().collect::<Option<Vec<_>>>().unwrap_or_default();
        if poses.is_empty() || cameras.is_empty() {
            return Ok(Vec::new());
        }
        let gaussians = changed.gaussians.clone();
        let new = tokio::task::spawn_blocking(move || Scene::from_gaussians(&gaussians)).await;
        let mut new = new.map_err(|_| SessionError::Crashed)?;
        let twin = manifest.twin.clone();
        let resident = self.resident(twin, Some(changed.before.number)).await?;
        for profile in [manifest.profile, changed.profile] {
            Self::bake(resident.clone(), profile).await?;
        }
        let (mut loaded, mut golden) = (BTreeMap::new(), Vec::new());
        let total = poses.len() as u64;
        for (done, world_from_rig) in (0..).zip(poses) {
            progress(done, total);
            let views = View::of_rig(&cameras, world_from_rig);
            let catalog = self.catalog().clone();
            let [before, keeping] =
                [BTreeSet::new(), changed.cells.clone()].map(|without| (without, views.clone()));
            let (version, profile) = (changed.before.clone(), changed.profile);
            let sky = resident.sky().cloned();
            let scenes = tokio::task::spawn_blocking(move || {
                let [before, mut after] = [before, keeping].map(|(without, views)| {
                    let scene =
                        scene(&catalog, &version, &profile, (&without, &views), &mut loaded);
                    scene.map(|scene| Scene { sky: sky.clone(), ..scene })
                });
                if let Ok(after) = &mut after {
                    after.chunks.extend(new.chunks.iter().cloned());
                    after.chunks.sort_by_key(|chunk| {
                        let [x, y] = chunk.cell();
                        [y, x]
                    });
                }
                (before, after, new, loaded)
            });
            let (before, after, kept, kept_loaded) =
                scenes.await.map_err(|_| SessionError::Crashed)?;
            (new, loaded) = (kept, kept_loaded);
            let was = self.draw(before?, manifest.profile, views.clone()).await?;
            let will_be = self.draw(after?, changed.profile, views).await?;
            let psnr_db = psnr_db_u8(was.iter().zip(&will_be));
            golden.push(PsnrPreview { world_from_rig, psnr_db });
        }
        Ok(golden)
    }

    /// The colours of all views, one after the other.
    async fn draw(
        &self,
        scene: Scene,
        profile: RenderProfile,
        views: Vec<View>,
    ) -> Result<Vec<u8>, SessionError> {
        let deadline = Instant::now() + self.step_timeout();
        let drawn = self.run(deadline, move |_, backend| {
            let mut images: Vec<_> =
                views.iter().map(|view| vec![0; 3 * view.camera.pixels()]).collect();
            let mut targets: Vec<_> = images
                .iter_mut()
                .map(|rgb8| Target { rgb8: Some(rgb8), ..Target::default() })
                .collect();
            let frame = Frame { scene: &scene, profile: &profile, views: &views };
            backend.render(&frame, &mut targets, &|_, _| {}).map(|_| images.concat())
        });
        Ok(drawn.await?.0?)
    }
}

/// What a frame draws of a version, without some of its cells. What was loaded for frames before is
/// not loaded again.
fn scene(
    catalog: &Catalog,
    version: &Version,
    profile: &RenderProfile,
    (without, views): (&BTreeSet<[i32; 2]>, &[View]),
    loaded: &mut BTreeMap<(usize, usize), Arc<Chunk>>,
) -> Result<Scene, SessionError> {
    let chunks = &version.manifest.chunks;
    let mut scene = Scene::default();
    for SectionRef { chunk, section } in demand(&version.manifest, &viewpoints(views), profile) {
        let entry = &chunks[chunk];
        if without.contains(&entry.cell) {
            continue;
        }
        if let Some(known) = loaded.get(&(chunk, section)) {
            scene.chunks.push(known.clone());
            continue;
        }
        let read = Arc::new(catalog.section(version, entry, &entry.sections[section])?);
        loaded.insert((chunk, section), read.clone());
        scene.chunks.push(read);
    }
    Ok(scene)
}

/// Poses along the first trajectory: spread over where it crosses what changes, or over all of it.
fn stations(changed: &ProposedChange) -> Vec<Pose> {
    let Manifest { trajectories, .. } = &changed.before.manifest;
    let Some(log) = trajectories.first() else { return Vec::new() };
    let changes = |pose: &&Pose| changed.cells.contains(&cell_at(&pose.position_m.to_array()));
    let keyframes: Vec<Pose> = log.keyframes.iter().map(|key| key.world_from_rig).collect();
    let near: Vec<&Pose> = keyframes.iter().filter(changes).collect();
    let from = if near.is_empty() { keyframes.iter().collect() } else { near };
    let count = limits::PREVIEW_POSES.min(from.len());
    // The middles of as many equal parts.
    (0..count).map(|k| *from[(2 * k + 1) * from.len() / (2 * count)]).collect()
}

/// A camera with the same field of view, and fewer pixels.
fn small(camera: &RigCamera) -> Option<RigCamera> {
    let Camera { width_px, height_px, .. } = camera.camera;
    let scale = f64::from(limits::PREVIEW_SIDE_PX) / f64::from(width_px.max(height_px));
    if scale >= 1.0 {
        return Some(camera.clone());
    }
    let side = |px: u32| (f64::from(px) * scale).round().max(1.0) as u64;
    let small = camera.camera.scaled(side(width_px), side(height_px)).ok()?;
    Some(RigCamera { camera: small, ..camera.clone() })
}
