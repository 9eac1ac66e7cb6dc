//! Builds an observation: lays out its buffer, renders into it, and appends the encoded images.

pub(crate) mod finish;
pub(crate) mod repair;

use std::mem;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use tracing::{Span, debug_span};

use wildcity_render::{Backend, Frame, FrameStats, Target};

use super::buffer::ObservationBuffer;
use super::encode::{AppliedEffects, EncodedImage, ImageEncoding, PixelMaps, encode, hashed};
use super::layout::{EffectSeed, InPlaceBytes, ObservationLayout, RigCapture};
use super::observation::{ResidencyStats, Timings};
use super::trust::TrainingCoverage;
use crate::engine::answer_budget::AnswerBudget;
use crate::engine::render_queue::Scratch;
use crate::episode::{EgoHistory, Episode};
use crate::error::SessionError;
use crate::repair::session_repair::SessionRepair;
use crate::repair::status::ImageRepair;
use crate::sensors::pixels::PixelEffects;

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
    /// Where the next shown image's floats go, in bytes from the buffer's start.
    floats_at: usize,
    /// Where the next shown image's instances go, in bytes from the buffer's start.
    instances_at: usize,
    /// Where the next shown image's raw pixels go, in bytes from the buffer's start.
    raw_at: usize,
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

        // | header | ego history, motion | floats of all captures | instances of all | raw pixels of all |
        let header = layout.header_bytes(captures);
        let floats_at = header + history.len();
        let in_place = captures.iter().map(|capture| layout.in_place_bytes(capture));
        // Each kind of all captures together, so that a kind is one block of the buffer.
        let all = in_place.fold(InPlaceBytes::default(), |sum, one| InPlaceBytes {
            floats: sum.floats + one.floats,
            instances: sum.instances + one.instances,
            raw: sum.raw + one.raw,
        });
        let instances_at = floats_at + all.floats;
        let raw_at = instances_at + all.instances;
        let mut buffer = ObservationBuffer::new(budget, raw_at + all.raw, header)?;
        buffer.bytes_mut()[header..floats_at].copy_from_slice(&history);

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
            floats_at,
            instances_at,
            raw_at,
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

        // Maps that the observation does not hold, but that are needed: trust is computed from
        // opacity, normals are computed from depth, and a repair model may need each of them.
        let PixelMaps { depth, opacity, normals, .. } = layout.maps();
        let model_needs = |needs: fn(&SessionRepair) -> bool| {
            filter.as_ref().is_some_and(|filter| needs(&filter.session))
        };
        let needs_opacity = coverage.is_some() && !(opacity && capture.shown);
        let uses_depth = (normals && capture.shown) || model_needs(SessionRepair::needs_depth);
        let needs_depth = uses_depth && !(depth && capture.shown);
        let needs_normals =
            model_needs(SessionRepair::needs_normals) && !(normals && capture.shown);
        // In floats a pixel: opacity and depth take one each, a normal three.
        let extra_values =
            u64::from(needs_opacity) + u64::from(needs_depth) + 3 * u64::from(needs_normals);
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
        let _share = self.budget.reserve(4 * pixels * extra_values + copied)?;

        // Where the renderer writes.
        // Before `targets` moves `raw_at` on, and borrows the buffer.
        let raw_at =
            if filter.is_some() || has_effects { self.raw_places(capture) } else { Vec::new() };
        let mut targets = self.targets(capture, scratch.images.for_views(frame.views, 3));
        if needs_opacity {
            for (target, map) in targets.iter_mut().zip(scratch.opacity.for_views(frame.views, 1)) {
                target.opacity = Some(map);
            }
        }
        if needs_depth {
            for (target, map) in targets.iter_mut().zip(scratch.depth_m.for_views(frame.views, 1)) {
                target.depth_m = Some(map);
            }
        }
        if needs_normals {
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
            let repair = filter.as_ref().zip(trust);
            let repair = repair.map(|(filter, trust)| filter.finished(index, trust.value, target));
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
        let mut repairs = Vec::new();
        for (view, (slot, &camera)) in slots.into_iter().zip(&capture.cameras).enumerate() {
            let never = || (Err("it was never finished".to_owned()), None);
            let (image, repair) = slot.into_inner().unwrap_or_else(never);
            repairs.extend(repair);
            let mut image = image.map_err(|reason| {
                let camera = layout.cameras()[camera].name.clone();
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
        // All trusts of the capture are known now, and the selection depends on all of them.
        if let (Some(repair), Some(filter)) = (&mut self.repair, &filter) {
            let rendered =
                RenderedCapture { finished: repairs, views: frame.views, raw_at: &raw_at, first };
            repair.decide(capture, filter, rendered);
        }
        Ok(())
    }

    /// Whether the buffer holds the pixels of a capture as they are, so that the renderer writes
    /// them there.
    fn holds_pixels(&self, capture: &RigCapture) -> bool {
        self.layout.encoding() == ImageEncoding::Raw && capture.shown
    }

    /// Where the pixels of each view of a capture are in the buffer, if the observation holds them
    /// there.
    fn raw_places(&self, capture: &RigCapture) -> Vec<Option<usize>> {
        let holds_pixels = self.holds_pixels(capture);
        // Places of views that are not held are counted as well, but not returned.
        let mut next = self.raw_at;
        let place = |camera: &usize| {
            let at = next;
            next += 3 * self.layout.cameras()[*camera].camera.pixels();
            holds_pixels.then_some(at)
        };
        capture.cameras.iter().map(place).collect()
    }

    /// Targets of a capture's images: the buffer for maps and pixels that the observation contains
    /// as rendered, and `images` for pixels that are encoded first.
    fn targets<'a>(
        &'a mut self,
        capture: &RigCapture,
        mut images: impl Iterator<Item = &'a mut [u8]>,
    ) -> Vec<Target<'a>> {
        let holds_pixels = self.holds_pixels(capture);
        let layout = &self.layout;
        let floats_at = self.floats_at;
        let instances_at = self.instances_at;
        let raw_at = self.raw_at;
        let own = layout.in_place_bytes(capture);
        // Moved on by the whole capture, so that the next one begins behind it.
        self.floats_at += own.floats;
        self.instances_at += own.instances;
        self.raw_at += own.raw;
        // Disjoint slices for each target: threads can write all of them at once.
        let (maps_part, raw_part) = self.buffer.bytes_mut().split_at_mut(raw_at);
        let (float_part, instances_part) = maps_part.split_at_mut(instances_at);
        let mut float_part = &mut float_part[floats_at..floats_at + own.floats];
        let mut instances_part = &mut instances_part[..own.instances];
        let mut raw_part = &mut raw_part[..own.raw];

        let mut targets = Vec::with_capacity(capture.cameras.len());
        for &camera in &capture.cameras {
            let camera = &layout.cameras()[camera];
            let pixels = camera.camera.pixels();
            let mut map = |held: bool, values: usize| {
                let bytes = 4 * pixels * values;
                (held && capture.shown).then(|| as_floats(split_off_front(&mut float_part, bytes)))
            };
            // In the order of the tensors.
            let PixelMaps { depth, opacity, normals, instances } = layout.maps();
            let depth_m = map(depth, 1);
            let opacity = map(opacity, 1);
            let normals = map(normals, 3);
            let instances = (instances && capture.shown)
                .then(|| as_ids(split_off_front(&mut instances_part, 2 * pixels)));
            let rgb8 = if holds_pixels {
                split_off_front(&mut raw_part, 3 * pixels)
            } else {
                // There is one for each camera; the backend would refuse an empty one.
                images.next().unwrap_or_default()
            };
            targets.push(Target {
                rgba: None,
                rgb8: Some(rgb8),
                depth_m,
                opacity,
                normals,
                instances,
                appearance: Some(&camera.appearance),
            });
        }
        targets
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

/// Splits the first bytes off a slice.
fn split_off_front<'a>(rest: &mut &'a mut [u8], bytes: usize) -> &'a mut [u8] {
    // The slice is taken out first, because a borrow through `rest` would not live as long as the
    // parts.
    let (front, others) = mem::take(rest).split_at_mut(bytes);
    *rest = others;
    front
}

/// The bytes as floats. They are aligned: the buffer's address is a multiple of 8, and the header's
/// room, the ego history and the maps before them are multiples of 4 bytes.
fn as_floats(bytes: &mut [u8]) -> &mut [f32] {
    bytemuck::cast_slice_mut(bytes)
}

/// The bytes as instances. They are aligned: all bytes before them are of floats, and of other
/// instances.
fn as_ids(bytes: &mut [u8]) -> &mut [u16] {
    bytemuck::cast_slice_mut(bytes)
}
