//! Builds an observation: lays out its buffer, renders into it, and appends the encoded images.

pub(crate) mod finish;
mod needed_maps;
mod plan;
pub(crate) mod repair;

use std::mem;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use tracing::{Span, debug_span};

use wildcity_render::{Backend, Frame, FrameStats, Target};

use super::buffer::ObservationBuffer;
use super::encode::{AppliedEffects, EncodedImage, ImageEncoding, encode, hashed};
use super::layout::{EffectSeed, ObservationLayout, RigCapture};
use super::observation::{ResidencyStats, SweepInfo, Timings};
use super::point_cloud::PointCloud;
use super::trust::TrainingCoverage;
use crate::engine::answer_budget::AnswerBudget;
use crate::engine::render_queue::Scratch;
use crate::episode::{EgoHistory, Episode};
use crate::error::SessionError;
use crate::repair::status::ImageRepair;
use crate::sensors::pixels::PixelEffects;

use self::needed_maps::NeededMaps;
use self::plan::BufferPlan;
use self::repair::{Finished, ObservationRepair, RenderedCapture};

/// An observation that is being built: one capture after the other is rendered, then `finish`
/// closes it.
pub(crate) struct ObservationBuilder {
    layout: Arc<ObservationLayout>,
    budget: AnswerBudget,
    /// Poses where the twin was recorded, if images come with their trust or may be repaired.
    coverage: Option<Arc<TrainingCoverage>>,
    /// Set if images may be repaired.
    repair: Option<ObservationRepair>,
    buffer: ObservationBuffer,
    history_count: usize,
    /// Seed and start time from which the sensor effects are derived.
    effect_seed: EffectSeed,
    /// Number of samples of the inertial measurement unit and of the wheels; `None` without.
    motion_samples: [Option<usize>; 2],
    /// The sweeps, whose points the buffer has already.
    sweeps: Vec<SweepInfo>,
    /// Where the next capture goes in the buffer.
    plan: BufferPlan,
    captures: Vec<RigCapture>,
    /// The images of all captures so far: capture by capture, and in each in the order of its
    /// cameras.
    encoded: Vec<EncodedImage>,
    timings: Timings,
    residency: ResidencyStats,
}

impl ObservationBuilder {
    /// Reserves the buffer of an observation and writes the ego history into it.
    pub(crate) fn new(
        layout: Arc<ObservationLayout>,
        budget: &AnswerBudget,
        coverage: Option<Arc<TrainingCoverage>>,
        episode: &Episode,
        captures: &[RigCapture],
        sweeps: &[PointCloud],
    ) -> Result<Self, SessionError> {
        // Only `observe` can ask for more than `open` has checked.
        // Refused before memory is reserved, with the limit of pixels and not that of the budget.
        layout.check_size("poses", captures.iter().filter(|capture| capture.shown).count())?;
        let EgoHistory { xyz_m, rotation, count } = episode.history();
        let history: [&[u8]; 2] = [bytemuck::bytes_of(&xyz_m), bytemuck::bytes_of(&rotation)];
        let mut history = history.concat();
        let motion_samples = if captures.iter().any(|capture| capture.has_sensor_effects) {
            add_motion(&mut history, &layout, episode)
        } else {
            [None; 2]
        };

        for sweep in sweeps {
            sweep.float_bytes().into_iter().for_each(|bytes| history.extend_from_slice(bytes));
        }
        let header = layout.header_bytes(captures);
        let maps_at = header + history.len();
        let ids: Vec<u8> =
            sweeps.iter().flat_map(PointCloud::id_bytes).flatten().copied().collect();
        let classes: Vec<u8> = sweeps.iter().flat_map(PointCloud::class_bytes).collect();
        let sweep_bytes = [ids.len(), classes.len()];
        let plan = BufferPlan::new(layout.clone(), captures, maps_at, sweep_bytes);
        let mut buffer = ObservationBuffer::new(budget, plan.end(), header)?;
        buffer.bytes_mut()[header..maps_at].copy_from_slice(&history);
        buffer.bytes_mut()[plan.sweep_ids_at()..][..ids.len()].copy_from_slice(&ids);
        buffer.bytes_mut()[plan.sweep_classes_at()..][..classes.len()].copy_from_slice(&classes);
        let sweep_info = |sweep: &PointCloud| SweepInfo {
            lidar: sweep.lidar,
            time_us: sweep.time_us,
            hash: sweep.hash,
            returns: sweep.points_m.len(),
        };

        let images = captures.iter().map(|capture| capture.cameras.len()).sum();
        Ok(Self {
            layout,
            budget: budget.clone(),
            coverage,
            repair: None,
            buffer,
            history_count: count,
            effect_seed: EffectSeed::from_episode(episode),
            motion_samples,
            sweeps: sweeps.iter().map(sweep_info).collect(),
            plan,
            captures: Vec::with_capacity(captures.len()),
            encoded: Vec::with_capacity(images),
            timings: Timings::default(),
            residency: ResidencyStats::default(),
        })
    }

    /// Enables the repair of images.
    #[must_use]
    pub(crate) fn with_repair(self, repair: Option<ObservationRepair>) -> Self {
        Self { repair, ..self }
    }

    /// Renders the views of a capture that has cameras; captures come in order. Runs on a render
    /// thread.
    pub(crate) fn render(
        &mut self,
        capture: &RigCapture,
        frame: &Frame<'_>,
        backend: &dyn Backend,
        scratch: &mut Scratch,
    ) -> Result<(), SessionError> {
        let layout = self.layout.clone();
        let coverage = self.coverage.clone();

        let pixels: u64 = frame.views.iter().map(|view| view.camera.pixels() as u64).sum();
        // Its memory is reserved before the frame is rendered: to refuse it afterwards would waste
        // the frame.
        let filter = match &mut self.repair {
            Some(repair) => Some(repair.candidate_filter(&self.budget, capture, pixels)?),
            None => None,
        };
        let reports_trust = filter.as_ref().is_none_or(|filter| filter.session.reports_trust);

        let session = filter.as_ref().map(|filter| &*filter.session);
        let needed = NeededMaps::new(layout.maps(), capture.shown, coverage.is_some(), session);
        // Noise and the like are computed on copies.
        let effect_seed = self.effect_seed;
        let effects = |camera: &usize| {
            if capture.has_sensor_effects {
                layout.pixel_effects(*camera, effect_seed, capture.time_us)
            } else {
                None
            }
        };
        let effects: Vec<Option<PixelEffects>> = capture.cameras.iter().map(effects).collect();
        let has_effects = effects.iter().any(Option::is_some);
        let copied = 3 * pixels * u64::from(has_effects);
        // Returned when the capture is rendered.
        let _share = self.budget.reserve(4 * pixels * needed.values() + copied)?;

        // Before `targets` moves the plan on, and borrows the buffer.
        let is_changed = filter.is_some() || has_effects;
        let raw_at = if is_changed { self.plan.raw_places(capture) } else { Vec::new() };
        let images = scratch.images.for_views(frame.views, 3);
        let mut targets = self.plan.targets(self.buffer.bytes_mut(), capture, images);
        if needed.opacity {
            for (target, map) in targets.iter_mut().zip(scratch.opacity.for_views(frame.views, 1)) {
                target.opacity = Some(map);
            }
        }
        if needed.depth {
            for (target, map) in targets.iter_mut().zip(scratch.depth_m.for_views(frame.views, 1)) {
                target.depth_m = Some(map);
            }
        }
        if needed.normals {
            for (target, map) in targets.iter_mut().zip(scratch.normals.for_views(frame.views, 3)) {
                target.normals = Some(map);
            }
        }

        // Each image is encoded as soon as it is complete, while others are still rendered; one
        // that may be repaired is copied instead.
        // A slot for each view, which the backend's threads fill in any order without a lock.
        let slots: Vec<OnceLock<FinishedView>> =
            frame.views.iter().map(|_| OnceLock::new()).collect();
        let rendering = Span::current();
        let in_parallel = backend.has_idle_cores();
        let finished = |index: usize, target: &Target<'_>| {
            let camera = capture.cameras[index];
            let name = &*layout.cameras()[camera].name;
            let _encoding = debug_span!(parent: &rendering, "encode", camera = name).entered();
            let pixels = target.rgb8.as_deref().unwrap_or_default();
            let trust = coverage.as_ref().map(|coverage| {
                let opacity = target.opacity.as_deref().unwrap_or_default();
                coverage.trust(&capture.world_from_rig, &frame.views[index], opacity)
            });
            let repair = filter
                .as_ref()
                .zip(trust)
                .map(|(filter, trust)| filter.finished(index, trust.value, target));
            let mut image = match &repair {
                // Encoding waits for the repair; the hash of the rendered pixels is needed in any
                // case.
                Some(Finished { candidate: Some(_), .. }) => Ok(hashed(pixels)),
                _ => {
                    let is_later = layout.is_shown_later(capture, camera);
                    let image = ImageToEncode { camera, pixels, is_shown_later: is_later };
                    encoded(&layout, image, effects[index].as_ref(), in_parallel)
                }
            };
            if let Ok(image) = &mut image {
                image.trust = trust.filter(|_| reports_trust);
                // A record compares what was rendered, before any effect.
                let rendered_hash = image.effects.map_or(image.hash, |effects| effects.clean_hash);
                image.repair = repair.is_some().then(|| ImageRepair::kept(rendered_hash));
            }
            // Setting fails only if the backend finishes a view twice, which it does not.
            let _ = slots[index].set((image, repair));
        };
        let started = Instant::now();
        let stats = backend.render(frame, &mut targets, &finished)?;
        self.timings.render += started.elapsed();
        self.add_stages(stats);

        let first = self.encoded.len();
        let repairs = self.take(slots, capture, &raw_at)?;
        // All trusts of the capture are known now, and the selection depends on all of them.
        if let (Some(repair), Some(filter)) = (&mut self.repair, &filter) {
            let rendered =
                RenderedCapture { finished: repairs, views: frame.views, raw_at: &raw_at, first };
            repair.decide(capture, filter, rendered);
        }
        Ok(())
    }

    /// Takes the finished images of a capture, in the order of its cameras. Returns what the
    /// selection for repair needs of each.
    fn take(
        &mut self,
        slots: Vec<OnceLock<FinishedView>>,
        capture: &RigCapture,
        raw_at: &[Option<usize>],
    ) -> Result<Vec<Finished>, SessionError> {
        let mut repairs = Vec::new();
        for (view, (slot, &camera)) in slots.into_iter().zip(&capture.cameras).enumerate() {
            let never = || (Err("it was never finished".to_owned()), None);
            let (image, repair) = slot.into_inner().unwrap_or_else(never);
            repairs.extend(repair);
            let mut image = image.map_err(|reason| {
                let camera = self.layout.cameras()[camera].name.clone();
                SessionError::Encode { camera, reason }
            })?;
            // Effects were computed on a copy while the targets borrowed the buffer. Now it takes
            // the place of the rendered pixels.
            let changed = mem::take(&mut image.changed);
            if let (false, Some(&Some(at))) = (changed.is_empty(), raw_at.get(view)) {
                self.buffer.bytes_mut()[at..at + changed.len()].copy_from_slice(&changed);
            }
            self.timings.encode += image.took;
            self.encoded.push(image);
        }
        Ok(repairs)
    }

    fn add_stages(&mut self, stats: FrameStats) {
        // A backend has a handful of stages, and a list keeps their order.
        for (stage, ms) in stats.stages_ms {
            match self.timings.stages_ms.iter_mut().find(|(name, _)| *name == stage) {
                Some((_, sum)) => *sum += ms,
                None => self.timings.stages_ms.push((stage, ms)),
            }
        }
    }

    /// Adds a capture that was rendered, or that has no cameras; in order.
    pub(crate) fn add_capture(&mut self, capture: RigCapture) {
        self.captures.push(capture);
    }

    pub(crate) fn add_queue_time(&mut self, queued: Duration) {
        self.timings.queue += queued;
    }

    /// Adds sections that had to be loaded, and how long that took.
    pub(crate) fn add_load(&mut self, sections: usize, waited: Duration) {
        self.residency.waited_for += sections;
        self.residency.waited += waited;
    }
}

/// Result of a render thread for a view: the image, and the data that the selection needs if there
/// is one.
type FinishedView = (Result<EncodedImage, String>, Option<Finished>);

/// An image of a camera.
#[derive(Clone, Copy)]
struct ImageToEncode<'a> {
    camera: usize,
    pixels: &'a [u8],
    is_shown_later: bool,
}

/// The hash and the file of a camera's image after the effects on its pixels; for raw pixels a copy
/// if there are effects, and another copy if a later observation shows them.
fn encoded(
    layout: &ObservationLayout,
    image: ImageToEncode<'_>,
    effects: Option<&PixelEffects>,
    in_parallel: bool,
) -> Result<EncodedImage, String> {
    let ImageToEncode { camera, pixels, is_shown_later } = image;
    let [height, width] = layout.size_px(camera).map(|side| side as u32);
    let Some(effects) = effects else {
        let mut image = encode(pixels, width, height, layout.encoding(), in_parallel)?;
        if layout.encoding() == ImageEncoding::Raw && is_shown_later {
            image.file = pixels.to_vec();
        }
        return Ok(image);
    };
    let started = Instant::now();
    let clean_hash = blake3::hash(pixels);
    let mut changed = pixels.to_vec();
    effects.apply(&mut changed, width as usize);
    let took = started.elapsed();
    let mut image = encode(&changed, width, height, layout.encoding(), in_parallel)?;
    image.took += took;
    image.effects = Some(AppliedEffects { clean_hash, stops: effects.stops });
    // Raw pixels travel in the buffer. A later observation needs a copy of its own.
    if layout.encoding() == ImageEncoding::Raw {
        if is_shown_later {
            image.file.clone_from(&changed);
        }
        image.changed = changed;
    }
    Ok(image)
}

/// Appends the samples of the motion sensors of an episode: first of the inertial measurement unit,
/// then of the wheels. Returns the number of samples of each; `None` if the session does not have
/// the sensor.
fn add_motion(
    bytes: &mut Vec<u8>,
    layout: &ObservationLayout,
    episode: &Episode,
) -> [Option<usize>; 2] {
    let Some(sensors) = layout.sensors() else { return [None; 2] };
    let seed = episode.seed();
    let samples = episode.motion();
    if let Some(imu) = &sensors.imu {
        let measured = samples.iter().flat_map(|sample| sample.imu(imu, seed));
        bytes.extend(measured.flat_map(f32::to_le_bytes));
    }
    if let Some(wheels) = &sensors.wheel_speed {
        let measured = samples.iter().map(|sample| sample.wheel_speed(wheels, seed));
        bytes.extend(measured.flat_map(f32::to_le_bytes));
    }
    [sensors.imu.map(|_| samples.len()), sensors.wheel_speed.map(|_| samples.len())]
}
