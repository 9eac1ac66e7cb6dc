//! Renders small images before and after a proposed change, and compares them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use tokio::time::Instant;

use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::{Frame, RenderError, Target, View};
use wildcity_scene::chunk::cell_at;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Chunk, Gaussians, RenderProfile, Rig, Scene, Selection, Sky, ViewSet};
use wildcity_session::{Engine, FrameCost, PUSHES, SessionError, viewpoints};
use wildcity_twin::residency::{BlockIndex, SectionRef, Viewpoint};
use wildcity_twin::store::{Catalog, StoreError, Version};

use crate::blocking::run_blocking;
use crate::error::PushError;
use crate::limits;

/// One pose, before and after the change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PsnrPreview {
    /// Where the rig is.
    pub world_from_rig: Pose,
    /// PSNR between the images before and after, all cameras together, in dB; infinite if they are
    /// equal.
    pub psnr_db: f64,
}

/// A change that a push proposes: a version with other Gaussians in some of its cells.
pub(crate) struct ProposedChange {
    /// The version as it is.
    pub(crate) before: Arc<Version>,
    /// The new Gaussians of the replaced cells.
    pub(crate) gaussians: Arc<Gaussians>,
    pub(crate) cells: BTreeSet<[i32; 2]>,
    /// The render profile after the change.
    pub(crate) profile: RenderProfile,
}

/// Renders small images of a version before and after a proposed change, and compares them. The
/// frames wait in the render queue with those of the sessions, until the deadline. It may be later
/// than that of a step, because no agent waits for them. Without `poses`, the images are taken from
/// some poses along the trajectories, near the change. Poses from which no Gaussian is seen are
/// left out. Calls `progress` with the number of poses that are done and the number of all poses.
///
/// The replaced cells are compared in full detail, so that levels of detail are no difference.
/// Rounding by the record format is one: the new Gaussians are not stored yet.
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
    // Sessions draw a twin without a rig with the same preset.
    let rig = manifest.rig.clone().or_else(|| Rig::preset(wildcity_session::limits::RIG));
    // One camera that cannot be scaled leaves no preview: an image of the other cameras would have
    // another PSNR.
    let cameras: Option<Vec<RigCamera>> =
        rig.iter().flat_map(|rig| rig.cameras.iter().map(scaled_down)).collect();
    let cameras = cameras.unwrap_or_default();
    if poses.is_empty() || cameras.is_empty() {
        return Ok(Vec::new());
    }

    let resident = engine.open_version(manifest.twin.clone(), Some(change.before.number)).await?;
    // A profile says how exact the sky's map is. Baking takes long, so it is done before a frame is
    // queued.
    for profile in [manifest.profile, change.profile] {
        Engine::bake_sky(resident.clone(), profile).await?;
    }

    let gaussians = change.gaussians.clone();
    let mut reader = SceneReader {
        catalog: engine.catalog().clone(),
        index: BlockIndex::new(&change.before.manifest),
        version: change.before.clone(),
        profile: change.profile,
        replaced: change.cells,
        new: run_blocking(move || Ok(Scene::from_gaussians(&gaussians))).await?,
        sky: resident.sky().cloned(),
        loaded: BTreeMap::new(),
    };
    // Poses are rendered one after the other, so that no more than one small frame of a push waits
    // in the queue beside those of the agents.
    let mut previews = Vec::new();
    let total = poses.len() as u64;
    for (done, world_from_rig) in (0..).zip(poses) {
        progress(done, total);
        let views = View::from_rig(&cameras, world_from_rig);
        let viewpoints = viewpoints(&views);
        let scenes;
        // A blocking thread has the reader while it reads.
        (reader, scenes) = run_blocking(move || {
            let scenes = reader.scenes(&viewpoints)?;
            Ok((reader, scenes))
        })
        .await?;
        let BothScenes { before, after } = scenes;
        let before =
            render_small(engine, before, manifest.profile, views.clone(), deadline).await?;
        let after = render_small(engine, after, change.profile, views, deadline).await?;
        // Two images of nothing but sky are equal and would say that the change is harmless.
        if before.sees_any || after.sees_any {
            let psnr_db = psnr_db_u8(before.rgb8.iter().zip(&after.rgb8));
            previews.push(PsnrPreview { world_from_rig, psnr_db });
        }
    }
    Ok(previews)
}

/// What all views of a pose show.
struct SmallImages {
    /// Their RGB pixels, one view after the other.
    rgb8: Vec<u8>,
    /// Whether any pixel shows a Gaussian.
    sees_any: bool,
}

/// Renders the small images of all views as one frame, in turn with the frames of sessions.
async fn render_small(
    engine: &Engine,
    scene: Scene,
    profile: RenderProfile,
    views: Vec<View>,
    deadline: Instant,
) -> Result<SmallImages, PushError> {
    // The queue divides the renderer by samples, and all pushes count as one session.
    let cost = FrameCost::new(PUSHES, &views, &profile);
    let rendered = engine.run(cost, deadline, move |_, backend| {
        let pixels = || views.iter().map(|view| view.camera.pixels());
        let mut images: Vec<_> = pixels().map(|pixels| vec![0; 3 * pixels]).collect();
        // The opacity is the only output that distinguishes a Gaussian from the sky behind it.
        let mut opacities: Vec<_> = pixels().map(|pixels| vec![0.0; pixels]).collect();
        let mut targets: Vec<_> = images
            .iter_mut()
            .zip(&mut opacities)
            .map(|(rgb8, opacity)| Target {
                rgb8: Some(rgb8),
                opacity: Some(opacity),
                ..Target::default()
            })
            .collect();
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        backend.render(&frame, &mut targets, &|_, _| {})?;
        let sees_any = opacities.iter().flatten().any(|&opacity| opacity > 0.0);
        Ok(SmallImages { rgb8: images.concat(), sees_any })
    });
    let (images, _queued) = rendered.await?;
    Ok(images.map_err(|error: RenderError| SessionError::from(error))?)
}

/// The scenes before and after the change, as they are seen from one pose.
struct BothScenes {
    before: Scene,
    after: Scene,
}

/// Chunks, and the views that draw each.
type SeenChunks = Vec<(Arc<Chunk>, ViewSet)>;

/// Reads the scenes before and after a change.
struct SceneReader {
    catalog: Catalog,
    index: BlockIndex,
    /// The version before the change.
    version: Arc<Version>,
    profile: RenderProfile,
    replaced: BTreeSet<[i32; 2]>,
    /// What they have after the change.
    new: Scene,
    sky: Option<Arc<Sky>>,
    /// Sections that were read for earlier poses.
    loaded: BTreeMap<SectionRef, Arc<Chunk>>,
}

impl SceneReader {
    /// Both scenes, as far as they are seen from some viewpoints.
    fn scenes(&mut self, viewpoints: &[Viewpoint]) -> Result<BothScenes, PushError> {
        let manifest = &self.version.manifest;
        let selected =
            self.index.select(manifest, viewpoints, &self.profile).map_err(SessionError::from)?;
        let is_kept =
            |section: &SectionRef| !self.replaced.contains(&manifest.chunks[section.chunk].cell);
        let sections = selected.iter().filter(|(section, _)| is_kept(section)).collect();
        let kept = self.read(sections)?;
        let old = self.read(self.replaced_in_full_detail())?;
        let new = self.new.chunks.iter().map(|chunk| (chunk.clone(), ViewSet::ALL)).collect();
        // Both scenes share the chunks of `kept` by reference, so the second one costs no memory.
        let with = |cells: SeenChunks| {
            scene([kept.clone(), cells].concat(), viewpoints.len(), self.sky.clone())
        };
        Ok(BothScenes { before: with(old), after: with(new) })
    }

    /// All of the replaced cells before the change, as a push has them: each block at full detail.
    fn replaced_in_full_detail(&self) -> Vec<(SectionRef, ViewSet)> {
        let mut sections = Vec::new();
        for (chunk, entry) in self.version.manifest.chunks.iter().enumerate() {
            if self.replaced.contains(&entry.cell) {
                let all = (0..).zip(&entry.sections);
                // Coarser sections have the same Gaussians merged; with both, a block would be
                // drawn twice.
                let full_detail = all.filter(|(_, section)| section.is_full_detail());
                let seen =
                    full_detail.map(|(section, _)| (SectionRef { chunk, section }, ViewSet::ALL));
                sections.extend(seen);
            }
        }
        sections
    }

    /// Some sections. Those that were read before are not read again.
    fn read(&mut self, sections: Vec<(SectionRef, ViewSet)>) -> Result<SeenChunks, StoreError> {
        let manifest = &self.version.manifest;
        let mut chunks = Vec::with_capacity(sections.len());
        for (section, views) in sections {
            let chunk = &manifest.chunks[section.chunk];
            // Neighbouring poses see mostly the same sections. The map grows to what all poses of
            // one preview see, and is dropped with it.
            let read = match self.loaded.get(&section) {
                Some(known) => known.clone(),
                None => {
                    let entry = &chunk.sections[section.section];
                    let read = Arc::new(self.catalog.section(&self.version, chunk, entry)?);
                    self.loaded.insert(section, read.clone());
                    read
                }
            };
            chunks.push((read, views));
        }
        Ok(chunks)
    }
}

/// Chunks in order of their cells, for a frame of so many views.
fn scene(mut chunks: SeenChunks, views: usize, sky: Option<Arc<Sky>>) -> Scene {
    // Gaussians of equal depth are drawn in the order of the scene, so both scenes need the order
    // that a stored version has.
    chunks.sort_by_key(|(chunk, _)| {
        let [x, y] = chunk.cell();
        [y, x]
    });
    let (chunks, by_chunk) = chunks.into_iter().unzip();
    let selection = Some(Selection { views, by_chunk });
    Scene { chunks, selection, placed: Vec::new(), sky }
}

/// Poses along the trajectories: spread over the parts that lie in the replaced cells, or over all
/// of them if no part does.
fn preview_poses(change: &ProposedChange) -> Vec<Pose> {
    let drives = &change.before.manifest.trajectories;
    let keyframes = drives.iter().flat_map(|drive| &drive.keyframes);
    let poses: Vec<Pose> = keyframes.map(|key| key.world_from_rig).collect();
    let is_replaced = |pose: &&Pose| change.cells.contains(&cell_at(&pose.position_m.to_array()));
    let replaced: Vec<&Pose> = poses.iter().filter(is_replaced).collect();
    let candidates = if replaced.is_empty() { poses.iter().collect() } else { replaced };
    let count = limits::PREVIEW_DEFAULT_POSES.min(candidates.len());
    // The middles of `count` equal parts.
    (0..count).map(|k| *candidates[(2 * k + 1) * candidates.len() / (2 * count)]).collect()
}

/// The camera with the same field of view and at most `PREVIEW_SIDE_PX` per side.
fn scaled_down(camera: &RigCamera) -> Option<RigCamera> {
    // One factor for both sides keeps the field of view and the aspect ratio.
    let Camera { width_px, height_px, .. } = camera.camera;
    let scale = f64::from(limits::PREVIEW_SIDE_PX) / f64::from(width_px.max(height_px));
    if scale >= 1.0 {
        return Some(camera.clone());
    }
    // A very wide camera would round to a height of 0.
    let side = |px: u32| (f64::from(px) * scale).round().max(1.0) as u64;
    let camera_scaled = camera.camera.scaled(side(width_px), side(height_px)).ok()?;
    Some(RigCamera { camera: camera_scaled, ..camera.clone() })
}
