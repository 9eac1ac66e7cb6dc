//! An observation: one buffer that goes to the socket as it is.
//!
//! ```text
//! | header | ego.history_xyz, ego.history_rot | depth, opacity, normals per image | colour per image | colour
//! of earlier frames |
//! ```
//!
//! The renderer writes depth, opacity and raw colour where they stay; JPEGs and PNGs, whose length
//! is known last, are appended. The header's room is reserved for `server`, which knows the wire.
//! Floats come before bytes, so that every float tensor starts at a multiple of 4.

use std::collections::BTreeMap;
use std::mem;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use crate::limits;
use wildcity_render::{Backend, Frame as RenderFrame, MAX_VIEWS, Target, View};
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::FieldMask;
use wildcity_scene::rig::{Rig, RigCamera};
use wildcity_scene::{RenderProfile, Scene};
use wildcity_twin::residency::Viewpoint;

use super::buffer::ObservationBuffer;
use super::encode::{EncodedImage, Encoding, encode};
use super::frame_history::{FrameHistory, PastFrame};
use super::observation::{
    DType, ImageInfo, Observation, PastImageInfo, ResidencyStats, Tensor, TensorKind, Timings,
};
use super::schedule::Schedule;
use super::trust::{TrainingCoverage, Trust};
use crate::engine::{AnswerBudget, Scratch};
use crate::episode::{EgoHistory, Episode};
use crate::error::SessionError;
use crate::options::PixelMaps;

/// The length of the header, little-endian, stands before it.
pub const HEADER_PREFIX_BYTES: usize = 8;

/// Room for what the header says once: names of at most 64 bytes, hashes of 64, the ego's 15
/// numbers of at most 24 digits, 16 stages of 60 bytes: below 2 kB.
const HEADER_BASE_BYTES: usize = 4096;

/// Room for what the header says per image: four tensors of at most 190 bytes, and 16 numbers of
/// at most 24 digits, two names and a hash with their escaped keys, below 1,900 bytes; a lens of 12
/// numbers and a windshield of 42, with their keys below 1,600.
const HEADER_IMAGE_BYTES: usize = 3584;

/// Images of one answer at most, of as many poses or frames.
const IMAGES: usize = limits::OBSERVE_POSES * Rig::MAX_CAMERAS;
const _: () = assert!(limits::BUNDLE_FRAMES <= limits::OBSERVE_POSES);

// A client accepts the longest header, and the renderer draws every rig in one frame.
const _: () = assert!(
    HEADER_BASE_BYTES + IMAGES * HEADER_IMAGE_BYTES <= limits::OBSERVATION_HEADER_BYTES as usize
);
const _: () = assert!(Rig::MAX_CAMERAS <= MAX_VIEWS);

/// What every observation of a session looks like.
#[derive(Debug)]
pub(crate) struct ObservationLayout {
    cameras: Vec<RigCamera>,
    /// The share of each image that its lens sees, where that is not all.
    seen: Vec<Option<f64>>,
    encoding: Encoding,
    maps: PixelMaps,
    schedule: Schedule,
}

/// What is drawn at once: cameras at one place.
#[derive(Clone, Debug)]
pub(crate) struct RigCapture {
    /// Where the rig stands.
    pub(crate) world_from_rig: Pose,
    /// When, in microseconds since the episode's start.
    pub(crate) time_us: i64,
    /// Indices of the cameras; there may be none.
    pub(crate) cameras: Vec<usize>,
    /// Whether its images are the observation's; else they are only kept for a bundle.
    pub(crate) shown: bool,
}

/// A finished observation, and what it leaves for later ones.
pub(crate) struct RenderedObservation {
    pub(crate) frame: Observation,
    pub(crate) album: FrameHistory,
    /// What was drawn, in order, the hashes of its images, and how far they may be believed.
    pub(crate) shots: Vec<RigCapture>,
    pub(crate) hashes: Vec<blake3::Hash>,
    trusts: Vec<Option<Trust>>,
}

impl RenderedObservation {
    /// How far each of its images may be believed, those for later observations included, as far as that
    /// was asked for.
    pub(crate) fn trusts(&self) -> impl Iterator<Item = f64> {
        self.trusts.iter().flatten().map(|trust| trust.value)
    }
}

/// A frame in the making.
pub(crate) struct ObservationBuilder {
    layout: Arc<ObservationLayout>,
    answers: AnswerBudget,
    buffer: ObservationBuffer,
    history_count: usize,
    /// Where the next shown image's floats and raw pixels go, from the buffer's start.
    floats_at: usize,
    raw_at: usize,
    trained: Option<Arc<TrainingCoverage>>,
    shots: Vec<RigCapture>,
    /// Of all shots so far, camera by camera.
    drawn: Vec<EncodedImage>,
    timings: Timings,
    residency: ResidencyStats,
}

impl ObservationLayout {
    /// # Errors
    /// The quality is not one, or the images of one observation are too large.
    pub(crate) fn new(
        cameras: Vec<RigCamera>,
        encoding: Encoding,
        maps: PixelMaps,
        schedule: Schedule,
    ) -> Result<Self, SessionError> {
        if let Encoding::Jpeg(quality) = encoding
            && !(1..=100).contains(&quality)
        {
            let must = format!("{quality}; 1 to 100 are accepted");
            return Err(SessionError::OutOfRange { field: "outputs.quality", must });
        }
        let seen = |RigCamera { camera, .. }: &RigCamera| {
            FieldMask::of(camera).map(|field| field.visible_share(camera))
        };
        let seen = cameras.iter().map(seen).collect();
        let layout = Self { cameras, seen, encoding, maps, schedule };
        layout.check_size(layout.schedule.frames())?;
        Ok(layout)
    }

    pub(crate) fn cameras(&self) -> &[RigCamera] {
        &self.cameras
    }

    /// The share of a camera's image that its lens sees, where that is not all.
    pub(crate) fn visible_share(&self, camera: usize) -> Option<f64> {
        self.seen[camera]
    }

    pub(crate) fn encoding(&self) -> Encoding {
        self.encoding
    }

    pub(crate) fn maps(&self) -> PixelMaps {
        self.maps
    }

    pub(crate) fn schedule(&self) -> &Schedule {
        &self.schedule
    }

    /// What is drawn for an observation at the end of an episode, beside what an album has: the frames
    /// that it shows or a later one will, those of one time together, the last those of now.
    pub(crate) fn shots(&self, episode: &Episode, album: &FrameHistory) -> Vec<RigCapture> {
        let now_us = episode.time_us();
        let mut times = BTreeMap::from([(now_us, Vec::new())]);
        for camera in 0..self.cameras.len() {
            for time_us in self.schedule.wanted(camera, now_us) {
                if time_us >= episode.begin_us() && album.find(camera, time_us).is_none() {
                    times.entry(time_us).or_default().push(camera);
                }
            }
        }
        let shot = |(time_us, cameras)| RigCapture {
            world_from_rig: episode.at(time_us),
            time_us,
            cameras,
            shown: time_us == now_us && self.schedule.decides(now_us),
        };
        times.into_iter().map(shot).collect()
    }

    /// All cameras from poses that the ego need not be at.
    pub(crate) fn looks(&self, episode: &Episode, poses: Vec<Pose>) -> Vec<RigCapture> {
        let cameras: Vec<usize> = (0..self.cameras.len()).collect();
        let shot = |world_from_rig| RigCapture {
            world_from_rig,
            time_us: episode.time_us(),
            cameras: cameras.clone(),
            shown: true,
        };
        poses.into_iter().map(shot).collect()
    }

    /// The views of a shot. Those of a warm-up are as of a vehicle that stood while they were exposed.
    pub(crate) fn views(&self, episode: &Episode, shot: &RigCapture) -> Vec<View> {
        let moves = shot.time_us == episode.time_us();
        episode.views((&self.cameras, &shot.cameras), shot.world_from_rig, moves)
    }

    fn check_size(&self, times: usize) -> Result<(), SessionError> {
        let pixels: u64 = self.cameras.iter().map(|camera| camera.camera.pixels() as u64).sum();
        let pixel_bytes = 3 + 4 * self.maps.values() as u64;
        let room_bytes = limits::OBSERVATION_BYTES as u64 - limits::OBSERVATION_HEADER_BYTES;
        let limit = limits::ANSWER_PIXELS.min(room_bytes / pixel_bytes);
        let pixels = pixels * times as u64;
        if pixels > limit {
            return Err(SessionError::AnswerTooLarge { pixels, limit });
        }
        Ok(())
    }

    /// Bytes of the floats of a shot's images, and of their pixels where they are in the buffer.
    fn bytes_of(&self, shot: &RigCapture) -> (usize, usize) {
        if !shot.shown {
            return (0, 0);
        }
        let cameras = shot.cameras.iter().map(|&camera| self.cameras[camera].camera.pixels());
        let pixels: usize = cameras.sum();
        (
            4 * pixels * self.maps.values(),
            if self.encoding == Encoding::Raw { 3 * pixels } else { 0 },
        )
    }
}

impl ObservationBuilder {
    /// Reserves the buffer of an observation and writes the ego history into it.
    pub(crate) fn new(
        layout: Arc<ObservationLayout>,
        answers: &AnswerBudget,
        episode: &Episode,
        shots: &[RigCapture],
    ) -> Result<Self, SessionError> {
        layout.check_size(shots.iter().filter(|shot| shot.shown).count())?;
        let images = shots.iter().map(|shot| shot.cameras.len()).sum::<usize>();
        // Of a bundle, more is shown than is drawn.
        let named = images.max(layout.schedule.frames() * layout.cameras.len());
        let header = HEADER_BASE_BYTES + named * HEADER_IMAGE_BYTES;
        let bytes = shots.iter().map(|shot| layout.bytes_of(shot));
        let (floats, raw) = bytes.fold((0, 0), |sum, shot| (sum.0 + shot.0, sum.1 + shot.1));
        let EgoHistory { xyz_m, rotation, count } = episode.history();
        let history: [&[u8]; 2] = [bytemuck::bytes_of(&xyz_m), bytemuck::bytes_of(&rotation)];
        let history = history.concat();
        let floats_at = header + history.len();
        let mut buffer = ObservationBuffer::zeroed(answers, floats_at + floats + raw, header)?;
        buffer.bytes_mut()[header..floats_at].copy_from_slice(&history);
        Ok(Self {
            layout,
            answers: answers.clone(),
            buffer,
            history_count: count,
            floats_at,
            raw_at: floats_at + floats,
            trained: None,
            shots: Vec::with_capacity(shots.len()),
            drawn: Vec::with_capacity(images),
            timings: Timings::default(),
            residency: ResidencyStats::default(),
        })
    }

    /// Renders a shot that has cameras; shots come in order.
    pub(crate) fn draw(
        &mut self,
        scene: &Scene,
        profile: &RenderProfile,
        backend: &dyn Backend,
        (shot, views): (&RigCapture, &[View]),
        scratch: &mut Scratch,
    ) -> Result<(), SessionError> {
        let layout = self.layout.clone();
        scratch.resize_with(scratch.len().max(views.len()), Vec::new);

        let trained = self.trained.clone();
        // Seen by nobody else: coverage is a part of trust, and normals are computed of depth.
        let PixelMaps { depth, opacity, normals } = layout.maps;
        let wanted =
            [trained.is_some() && !(opacity && shot.shown), normals && !depth && shot.shown];
        let pixels: u64 = views.iter().map(|view| view.camera.pixels() as u64).sum();
        let images = wanted.iter().filter(|wanted| **wanted).count() as u64;
        let _hold = self.answers.hold(4 * pixels * images)?;
        let [mut coverage, mut depths_m] = wanted.map(|wanted| -> Vec<Vec<f32>> {
            let drawn = if wanted { views } else { &[] };
            drawn.iter().map(|view| vec![0.0; view.camera.pixels()]).collect()
        });
        let mut targets = self.targets(shot, scratch);
        for (target, opacity) in targets.iter_mut().zip(&mut coverage) {
            target.opacity = Some(opacity);
        }
        for (target, depth_m) in targets.iter_mut().zip(&mut depths_m) {
            target.depth_m = Some(depth_m);
        }
        let slots: Vec<OnceLock<Result<EncodedImage, String>>> =
            views.iter().map(|_| OnceLock::new()).collect();
        let finished = |view: usize, target: &Target<'_>| {
            let index = shot.cameras[view];
            let camera = &layout.cameras[index].camera;
            let pixels = target.rgb8.as_deref().unwrap_or_default();
            let mut drawn = encode(pixels, camera.width_px, camera.height_px, layout.encoding);
            if let Ok(drawn) = &mut drawn
                && layout.encoding == Encoding::Raw
                && layout.outlives(shot, index)
            {
                drawn.file = pixels.to_vec();
            }
            if let (Ok(drawn), Some(trained)) = (&mut drawn, &trained) {
                let opacity = target.opacity.as_deref().unwrap_or_default();
                drawn.trust = Some(trained.trust(&shot.world_from_rig, &views[view], opacity));
            }
            // A backend calls this once per view.
            let _ = slots[view].set(drawn);
        };
        let started = Instant::now();
        let frame = RenderFrame { scene, profile, views };
        let stats = backend.render(&frame, &mut targets, &finished)?;
        self.timings.render += started.elapsed();
        for (stage, ms) in stats.stages_ms {
            match self.timings.stages_ms.iter_mut().find(|(name, _)| *name == stage) {
                Some((_, sum)) => *sum += ms,
                None => self.timings.stages_ms.push((stage, ms)),
            }
        }
        for (slot, &camera) in slots.into_iter().zip(&shot.cameras) {
            let drawn = slot.into_inner().unwrap_or_else(|| Err("it was never finished".into()));
            let drawn = drawn.map_err(|reason| {
                let camera = layout.cameras[camera].name.clone();
                SessionError::Encode { camera, reason }
            })?;
            self.timings.encode += drawn.took;
            self.drawn.push(drawn);
        }
        Ok(())
    }

    /// Where the renderer puts a shot's images.
    fn targets<'a>(&'a mut self, shot: &RigCapture, scratch: &'a mut Scratch) -> Vec<Target<'a>> {
        let layout = &self.layout;
        let (floats, raw) = layout.bytes_of(shot);
        let (floats_at, raw_at) = (self.floats_at, self.raw_at);
        (self.floats_at, self.raw_at) = (floats_at + floats, raw_at + raw);
        let (float_part, raw_part) = self.buffer.bytes_mut().split_at_mut(raw_at);
        let mut float_part = &mut float_part[floats_at..floats_at + floats];
        let mut raw_part = &mut raw_part[..raw];
        let mut targets = Vec::with_capacity(shot.cameras.len());
        for (&camera, scratch) in shot.cameras.iter().zip(scratch) {
            let pixels = layout.cameras[camera].camera.pixels();
            let mut floats = |wanted: bool, values: usize| {
                let bytes = 4 * pixels * values;
                (wanted && shot.shown).then(|| floats_of(take(&mut float_part, bytes)))
            };
            let PixelMaps { depth, opacity, normals } = layout.maps;
            let (depth_m, opacity) = (floats(depth, 1), floats(opacity, 1));
            let normals = floats(normals, 3);
            let rgb8 = if layout.encoding == Encoding::Raw && shot.shown {
                take(&mut raw_part, 3 * pixels)
            } else {
                if scratch.len() < 3 * pixels {
                    scratch.resize(3 * pixels, 0);
                }
                &mut scratch[..3 * pixels]
            };
            let appearance = Some(&layout.cameras[camera].appearance);
            let rgb8 = Some(rgb8);
            let rgba = None;
            targets.push(Target { rgba, rgb8, depth_m, opacity, normals, appearance });
        }
        targets
    }

    /// Says of the images how far they may be believed.
    pub(crate) fn judge(&mut self, trained: Option<Arc<TrainingCoverage>>) {
        self.trained = trained;
    }

    pub(crate) fn add_shot(&mut self, shot: RigCapture) {
        self.shots.push(shot);
    }

    pub(crate) fn add_queue_time(&mut self, queued: Duration) {
        self.timings.queue += queued;
    }

    pub(crate) fn add_waiting(&mut self, waited_for: usize, waited: Duration) {
        self.residency.waited_for += waited_for;
        self.residency.waited += waited;
    }

    /// Appends what was encoded, and what an album still has of a bundle, and names every tensor. The
    /// album is that of all frames before; a look without one is `None` of it, and shows no bundle.
    pub(crate) fn finish(
        mut self,
        album: Option<FrameHistory>,
        held_bytes: u64,
        limit_bytes: u64,
    ) -> Result<RenderedObservation, SessionError> {
        let layout = self.layout;
        let mut drawn = self.drawn;
        let (mut taken, mut images, mut shown_files) = (Vec::new(), Vec::new(), Vec::new());
        let mut pose = 0;
        for shot in &self.shots {
            for &camera in &shot.cameras {
                let (index, time_us) = (taken.len(), shot.time_us);
                if shot.shown {
                    let EncodedImage { hash, trust, .. } = drawn[index];
                    images.push(ImageInfo { camera, pose, time_us, hash, trust });
                    shown_files.push(index);
                }
                taken.push((shot, camera));
            }
            pose += usize::from(shot.shown);
        }
        let appended: Vec<&[u8]> = match layout.encoding {
            Encoding::Raw => Vec::new(),
            Encoding::Jpeg(_) | Encoding::Png => {
                shown_files.iter().map(|&index| &drawn[index].file[..]).collect()
            }
        };
        self.buffer.append(&self.answers, &appended)?;

        let mut tensors = Tensors { list: Vec::new(), end: 0 };
        let poses = limits::HISTORY_POSES;
        tensors.push(TensorKind::HistoryXyz, DType::F32, vec![poses, 3]);
        tensors.push(TensorKind::HistoryRotation, DType::F32, vec![poses, 3, 3]);
        for (index, image) in images.iter().enumerate() {
            let [height, width] = size(&layout.cameras[image.camera]);
            if layout.maps.depth {
                tensors.push(TensorKind::Depth(index), DType::F32, vec![height, width]);
            }
            if layout.maps.opacity {
                tensors.push(TensorKind::Opacity(index), DType::F32, vec![height, width]);
            }
            if layout.maps.normals {
                tensors.push(TensorKind::Normals(index), DType::F32, vec![height, width, 3]);
            }
        }
        for (index, (image, &file)) in images.iter().zip(&shown_files).enumerate() {
            let shape = layout.shape(image.camera, drawn[file].file.len());
            tensors.push(TensorKind::Rgb(index), DType::U8, shape);
        }

        let bundled = album.is_some();
        let (mut album, mut history) = (album.unwrap_or_default(), Vec::new());
        if bundled && let Some(now_us) = self.shots.last().map(|shot| shot.time_us) {
            for (index, &(shot, camera)) in taken.iter().enumerate() {
                if layout.outlives(shot, camera) {
                    let EncodedImage { hash, trust, file, .. } = &mut drawn[index];
                    let (known, file) = ((*hash, *trust), mem::take(file));
                    album.add(&self.answers, (camera, shot.time_us), known, file)?;
                }
            }
            if layout.schedule.decides(now_us) {
                let earlier = layout.earlier(&album, now_us);
                let parts: Vec<&[u8]> = earlier.iter().map(|(_, shown)| &shown.bytes[..]).collect();
                self.buffer.append(&self.answers, &parts)?;
                for (index, (back, shown)) in earlier.iter().enumerate() {
                    let PastFrame { camera, time_us, hash, trust, bytes, .. } = &***shown;
                    let (camera, time_us, hash, trust) = (*camera, *time_us, *hash, *trust);
                    let shape = layout.shape(camera, bytes.len());
                    tensors.push(TensorKind::PastRgb(index), DType::U8, shape);
                    history.push(PastImageInfo { camera, back: *back, time_us, hash, trust });
                }
            }
            album.forget(&layout.schedule, now_us);
        }
        let hashes = drawn.iter().map(|drawn| drawn.hash).collect();
        let trusts = drawn.iter().map(|drawn| drawn.trust).collect();
        let frame_hash = frame_hash(images.iter().map(|image| image.hash));
        let frame = Observation {
            buffer: self.buffer,
            tensors: tensors.list,
            images,
            history,
            frame_hash,
            history_count: self.history_count,
            timings: self.timings,
            residency: ResidencyStats { held_bytes, limit_bytes, ..self.residency },
        };
        Ok(RenderedObservation { frame, album, shots: self.shots, hashes, trusts })
    }
}

impl ObservationLayout {
    /// Whether a frame is looked at once more, or for the first time, beside the images of its shot.
    fn outlives(&self, shot: &RigCapture, camera: usize) -> bool {
        !shot.shown || self.schedule.kept(camera, shot.time_us, shot.time_us)
    }

    /// The frames of an album that a decision looks at beside those of its own time, camera by camera,
    /// the newest first, and how many frames ago each is.
    fn earlier<'a>(
        &self,
        album: &'a FrameHistory,
        now_us: i64,
    ) -> Vec<(usize, &'a Arc<PastFrame>)> {
        let of_camera = |camera| {
            let seen = self.schedule.seen(camera, now_us).filter(|&time_us| time_us < now_us);
            let there = seen.filter_map(move |time_us| album.find(camera, time_us));
            there.enumerate().map(|(index, shown)| (index + 1, shown))
        };
        (0..self.cameras.len()).flat_map(of_camera).collect()
    }

    /// Shape of an image's tensor that travels as so many bytes.
    fn shape(&self, camera: usize, file_bytes: usize) -> Vec<usize> {
        let [height, width] = size(&self.cameras[camera]);
        match self.encoding {
            Encoding::Raw => vec![height, width, 3],
            Encoding::Jpeg(_) | Encoding::Png => vec![file_bytes],
        }
    }
}

/// What decides how much detail the views need.
pub fn viewpoints(views: &[View]) -> Vec<Viewpoint> {
    // Of a rolling shutter the end of its way: detail is chosen by distance alone, in every direction.
    let eye = |view: &View| Viewpoint {
        position_m: view.world_from_camera.position_m,
        focal_px: view.camera.pinhole.fx.max(view.camera.pinhole.fy),
    };
    views.iter().map(eye).collect()
}

/// The hash of a frame: of its images' hashes, in order.
pub(crate) fn frame_hash(images: impl Iterator<Item = blake3::Hash>) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    for hash in images {
        hasher.update(hash.as_bytes());
    }
    hasher.finalize()
}

/// Tensors one after the other.
struct Tensors {
    list: Vec<Tensor>,
    end: usize,
}

impl Tensors {
    fn push(&mut self, kind: TensorKind, dtype: DType, shape: Vec<usize>) {
        let bytes = shape.iter().product::<usize>() * dtype.bytes();
        let start = self.end;
        self.end += bytes;
        self.list.push(Tensor { kind, dtype, shape, bytes: start..self.end });
    }
}

/// Cuts the first bytes off a slice.
fn take<'a>(rest: &mut &'a mut [u8], bytes: usize) -> &'a mut [u8] {
    let (first, others) = mem::take(rest).split_at_mut(bytes);
    *rest = others;
    first
}

/// Floats in place: the header's room, the history and other floats before them are multiples of 4
/// bytes from the start of a buffer whose address is a multiple of 8.
fn floats_of(bytes: &mut [u8]) -> &mut [f32] {
    bytemuck::cast_slice_mut(bytes)
}

fn size(camera: &RigCamera) -> [usize; 2] {
    [camera.camera.height_px as usize, camera.camera.width_px as usize]
}
