//! Images of a version from any views, without an episode: for programs that simulate elsewhere and
//! only render here.

use std::sync::Arc;
use std::time::Duration;

use glam::DVec3;
use tokio::time::Instant;

use wildcity_render::lidar::{LidarView, Sweep};
use wildcity_render::{Frame, MAX_VIEWS, Target, View};
use wildcity_scene::RenderProfile;
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::appearance::Appearance;
use wildcity_scene::geometry::Pose;
use wildcity_twin::residency::{FrameBytes, Reservation, Resident, ResidentActor, RigExtent};

use crate::blocking::run_blocking;
use crate::engine::Engine;
use crate::engine::devices::DeviceSlot;
use crate::engine::render_queue::FrameCost;
use crate::error::SessionError;
use crate::observe::encode::{ImageEncoding, encode};
use crate::pin::pin;
use crate::scenario::assets::{FrameDetail, Placement};
use crate::viewpoint::{lidar_viewpoint, viewpoints};

/// Bytes of a pixel of a still: the pixels, and a copy that is encoded.
const STILL_PIXEL_BYTES: u64 = 6;

/// Bytes of a beam: range, intensity and instance, and then a point of an answer, twice.
const SWEEP_BEAM_BYTES: u64 = 10 + 32;

/// One image to render.
#[derive(Clone, Debug)]
pub struct Still {
    pub view: View,
    pub appearance: Appearance,
    /// How the image is encoded.
    pub encoding: ImageEncoding,
}

/// A moving object in the twin, in images of one time.
#[derive(Clone, Debug)]
pub struct StillActor {
    /// Asset that it is drawn from.
    pub asset: Arc<ResidentActor>,
    /// Its pose where the exposures end: its origin is on the ground under its middle, x points
    /// forward.
    pub world_from_actor: Pose,
    /// Its pose where the exposures begin.
    pub world_from_actor_at_start: Pose,
}

/// Views that one request renders.
#[derive(Clone, Copy, Debug)]
pub struct StillViews<'a> {
    pub images: &'a [View],
    pub sweep: Option<&'a LidarView>,
}

/// A version that images are rendered of, and the memory for its worst frame.
#[derive(Debug)]
pub struct Stills {
    engine: Arc<Engine>,
    reservation: Reservation,
    profile: RenderProfile,
    /// The device that draws its frames, as of a session.
    slot: DeviceSlot,
}

impl Stills {
    /// Reserves the memory for the worst frame of views as these, wherever in the twin they are.
    ///
    /// # Errors
    /// The version's sky cannot be baked, or too little memory is left.
    pub async fn open(
        engine: Arc<Engine>,
        resident: Arc<Resident>,
        views: StillViews<'_>,
    ) -> Result<Self, SessionError> {
        let profile = resident.version.manifest.profile;
        Engine::bake_sky(resident.clone(), profile).await?;
        let frame = frame_bytes(&engine, views, &profile);
        let scenes = Engine::scene_bytes(resident.clone(), extent(views), profile, true).await?;
        let reservation = resident.reserve_scenes(scenes, frame)?;
        let slot = engine.place_session();
        Ok(Self { engine, reservation, profile, slot })
    }

    /// Whether the reserved memory is enough for these views.
    pub async fn covers(&self, views: StillViews<'_>) -> Result<bool, SessionError> {
        let resident = self.reservation.resident().clone();
        let scenes = Engine::scene_bytes(resident, extent(views), self.profile, true).await?;
        let frame = frame_bytes(&self.engine, views, &self.profile);
        Ok(self.reservation.covers(scenes, frame))
    }

    /// Renders images, and returns a JPEG or PNG file, or raw pixels, for each. More than
    /// [`MAX_VIEWS`] are rendered in several frames, each scheduled among the frames of all
    /// sessions. All of them show `actors`, at most [`PlacedChunk::MAX_ACTORS`].
    ///
    /// # Errors
    /// Names what was not ready within `max_wait`, or what the backend refuses.
    pub async fn render(
        &self,
        stills: Vec<Still>,
        actors: &[StillActor],
        max_wait: Duration,
    ) -> Result<Vec<Vec<u8>>, SessionError> {
        let most = PlacedChunk::MAX_ACTORS;
        if actors.len() > most {
            let must = format!("{}; at most {most} are accepted", actors.len());
            return Err(SessionError::OutOfRange { field: "actors", must });
        }
        // One deadline for all frames together.
        let deadline = Instant::now() + max_wait;
        let mut images = Vec::with_capacity(stills.len());
        // With memory for one view at a time, each image is a frame of its own.
        for part in stills.chunks(MAX_VIEWS.min(self.reservation.views_at_once())) {
            images.append(&mut self.render_frame(part.to_vec(), actors, deadline).await?);
        }
        Ok(images)
    }

    /// Casts a sweep, which shows `actors` as images do.
    ///
    /// # Errors
    /// As [`Stills::render`].
    pub async fn sweep(
        &self,
        view: LidarView,
        actors: &[StillActor],
        max_wait: Duration,
    ) -> Result<Sweep, SessionError> {
        let deadline = Instant::now() + max_wait;
        let beams = view.lidar.beams() as u64;
        let _share = self.engine.answer_budget().reserve(SWEEP_BEAM_BYTES * beams)?;
        let resident = self.reservation.resident().clone();
        let profile = self.profile;
        let viewpoints = vec![lidar_viewpoint(&view)];
        // The poses of the actors at the start are given.
        let detail = FrameDetail { viewpoints: &viewpoints, exposures_us: &[0], profile: &profile };
        let placed = detail.placed(placements(actors, 1));
        let mut scene = pin(resident, profile, deadline, viewpoints).await?;
        scene.place(placed);
        let work = move |_: &mut _, backend: &dyn wildcity_render::Backend| {
            backend.sweep(&scene, &profile, &view)
        };
        // A beam counts as a sample of an image does.
        let cost = FrameCost { session: self.slot.number(), samples: beams };
        let (sweep, _queued) = self.engine.run(cost, deadline, work).await?;
        Ok(sweep?)
    }

    async fn render_frame(
        &self,
        stills: Vec<Still>,
        actors: &[StillActor],
        deadline: Instant,
    ) -> Result<Vec<Vec<u8>>, SessionError> {
        let views: Vec<View> = stills.iter().map(|still| still.view).collect();
        let pixels: u64 = views.iter().map(|view| view.camera.pixels() as u64).sum();
        // Until the files are done: pixels and their copies exist at the same time.
        let _share = self.engine.answer_budget().reserve(STILL_PIXEL_BYTES * pixels)?;

        // Load before the job is queued, so that no render thread waits for a disk.
        let resident = self.reservation.resident().clone();
        let profile = self.profile;
        let viewpoints = viewpoints(&views);
        // The poses of the actors at the start are those of every view.
        let exposures_us = &vec![0; views.len()];
        let detail = FrameDetail { viewpoints: &viewpoints, exposures_us, profile: &profile };
        let placed = detail.placed(placements(actors, views.len()));
        let mut scene = pin(resident, profile, deadline, viewpoints).await?;
        scene.place(placed);
        let cost = FrameCost::new(self.slot.number(), &views, &profile);
        let work = move |_: &mut _, backend: &dyn wildcity_render::Backend| {
            // The renderer writes every pixel; zeros are only there to make the memory valid.
            let zeroed = |view: &View| vec![0; 3 * view.camera.pixels()];
            let mut images: Vec<Vec<u8>> = views.iter().map(zeroed).collect();
            let mut targets: Vec<Target<'_>> = images
                .iter_mut()
                .zip(&stills)
                .map(|(rgb8, still)| Target {
                    rgb8: Some(rgb8),
                    appearance: Some(&still.appearance),
                    ..Target::default()
                })
                .collect();
            let frame = Frame { scene: &scene, profile: &profile, views: &views };
            // All images are encoded afterwards, so that nothing happens as each is done.
            let rendered = backend.render(&frame, &mut targets, &|_, _| {});
            rendered.map(|_| (images, stills))
        };
        let (rendered, _queued) = self.engine.run(cost, deadline, work).await?;
        let (images, stills) = rendered?;
        // Off the render thread, which renders for sessions meanwhile.
        run_blocking(move || {
            let both = images.into_iter().zip(&stills).enumerate();
            both.map(|(index, (rgb8, still))| encoded(index, rgb8, still)).collect()
        })
        .await?
    }
}

fn placements(actors: &[StillActor], views: usize) -> impl Iterator<Item = Placement<'_>> {
    (0..).zip(actors).map(move |(index, actor)| Placement {
        actor: index,
        asset: actor.asset.asset(),
        world_from_actor: actor.world_from_actor,
        world_from_actor_at_start: vec![actor.world_from_actor_at_start; views],
    })
}

fn encoded(index: usize, rgb8: Vec<u8>, still: &Still) -> Result<Vec<u8>, SessionError> {
    if still.encoding == ImageEncoding::Raw {
        return Ok(rgb8);
    }
    let camera = &still.view.camera;
    encode(&rgb8, camera.width_px, camera.height_px, still.encoding, false)
        .map(|image| image.file)
        .map_err(|reason| SessionError::Encode { camera: index.to_string(), reason })
}

/// Buffers and images that a frame of stills needs in addition to its scene. More than
/// [`MAX_VIEWS`] views are rendered in several frames.
fn frame_bytes(engine: &Engine, views: StillViews<'_>, profile: &RenderProfile) -> FrameBytes {
    // Rendered one after the other, frames share the memory of the largest.
    let most = |most: FrameBytes, frame: FrameBytes| FrameBytes {
        stages: most.stages.max(frame.stages),
        beside: most.beside.max(frame.beside),
        is_large: most.is_large || frame.is_large,
        images: most.images.max(frame.images),
    };
    let images = views.images.chunks(MAX_VIEWS).map(|views| {
        let pixels: u64 = views.iter().map(|view| view.camera.pixels() as u64).sum();
        engine.frame_bytes(views, profile, 0, STILL_PIXEL_BYTES * pixels)
    });
    let sweep = views.sweep.map(|view| {
        let stages = engine.sweep_bytes(&view.lidar);
        let images = SWEEP_BEAM_BYTES * view.lidar.beams() as u64;
        // A sweep is never large, so that it may run beside a large frame.
        FrameBytes { stages, beside: stages, is_large: false, images }
    });
    images.chain(sweep).fold(FrameBytes::default(), most)
}

/// The extent of views around their middle.
fn extent(views: StillViews<'_>) -> RigExtent {
    let mut viewpoints = viewpoints(views.images);
    viewpoints.extend(views.sweep.map(lidar_viewpoint));
    // Without views, the middle is the origin and not NaN.
    let count = viewpoints.len().max(1) as f64;
    let middle_m = viewpoints.iter().map(|one| one.position_m).sum::<DVec3>() / count;
    RigExtent::new(&viewpoints, middle_m)
}
