//! An observation: one buffer that goes to the socket as it is.
//!
//! ```text
//! | header | ego.history_xyz, ego.history_rot | depth, opacity per image | colour per image |
//! ```
//!
//! The renderer writes depth, opacity and raw colour where they stay; JPEGs and PNGs, whose length
//! is known last, are appended. The header's room is reserved for `server`, which knows the wire.
//! Floats come before bytes, so that every float tensor starts at a multiple of 4.

use std::mem;
use std::ops::Range;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use crate::config;
use crate::geometry::camera::Field;
use crate::render::{Backend, Frame as RenderFrame, MAX_VIEWS, Target, View};
use crate::residency::Eye;
use crate::scene::rig::{Rig, RigCamera};
use crate::scene::{RenderProfile, Scene};

use super::buffer::Buffer;
use super::encode::{Drawn, Encoding, encode};
use super::engine::{Answers, Scratch};
use super::{Episode, History, SessionError};

/// The length of the header, little-endian, stands before it.
pub const HEADER_PREFIX_BYTES: usize = 8;

/// Room for what the header says once: names of at most 64 bytes, hashes of 64, the ego's 15
/// numbers of at most 24 digits, 16 stages of 60 bytes: below 2 kB.
const HEADER_BASE_BYTES: usize = 4096;

/// Room for what the header says per image: three tensors of at most 190 bytes, and 12 numbers of
/// at most 24 digits, two names and a hash with their escaped keys, below 1,400 bytes; a lens of 12
/// numbers and a windshield of 42, with their keys below 1,600.
const HEADER_IMAGE_BYTES: usize = 3072;

/// Images of one answer at most.
const IMAGES: usize = config::OBSERVE_POSES * Rig::MAX_CAMERAS;

// A client accepts the longest header, and the renderer draws every rig in one frame.
const _: () = assert!(
    HEADER_BASE_BYTES + IMAGES * HEADER_IMAGE_BYTES <= config::OBSERVATION_HEADER_BYTES as usize
);
const _: () = assert!(Rig::MAX_CAMERAS <= MAX_VIEWS);

/// What every observation of a session looks like.
#[derive(Debug)]
pub(super) struct Layout {
    cameras: Vec<RigCamera>,
    /// The share of each image that its lens sees, where that is not all.
    seen: Vec<Option<f64>>,
    encoding: Encoding,
    depth: bool,
    opacity: bool,
}

/// A finished observation.
#[derive(Debug)]
pub struct Frame {
    /// The bytes of all tensors, behind the reserved header.
    pub buffer: Buffer,
    /// What is where in the buffer, in order and without gaps.
    pub tensors: Vec<Tensor>,
    /// The images, pose by pose, camera by camera.
    pub images: Vec<Image>,
    /// BLAKE3 of the images' hashes, 32 bytes each, in order.
    pub frame_hash: blake3::Hash,
    /// How many poses of the ego history were driven.
    pub history_count: usize,
    /// What it cost.
    pub timings: Timings,
    /// What of it had to be loaded.
    pub residency: Residency,
}

/// Memory behind an observation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Residency {
    /// Bytes of Gaussians in memory, of all twins.
    pub held_bytes: u64,
    /// Bytes that there may be.
    pub limit_bytes: u64,
    /// Sections that were not in memory when it was asked for.
    pub waited_for: usize,
    /// How long it took until they were.
    pub waited: Duration,
}

/// One image of a [`Frame`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Image {
    /// Index of the camera among [`super::Session::cameras`].
    pub camera: usize,
    /// Which of the request's poses.
    pub pose: usize,
    /// BLAKE3 of the pixels, `[height, width, 3]`.
    pub hash: blake3::Hash,
}

/// One tensor of a [`Frame`].
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// What it holds.
    pub kind: TensorKind,
    /// Type of its elements.
    pub dtype: DType,
    /// Its shape, row-major.
    pub shape: Vec<usize>,
    /// Where its bytes are, from the end of the header.
    pub bytes: Range<usize>,
}

/// What a tensor holds; images by their index in [`Frame::images`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TensorKind {
    /// Positions of the ego history, in metres: `[16, 3]`.
    HistoryXyz,
    /// Rotations of the ego history: `[16, 3, 3]`.
    HistoryRotation,
    /// Expected camera z in metres: `[height, width]`.
    Depth(usize),
    /// Accumulated opacity: `[height, width]`.
    Opacity(usize),
    /// Colour: `[height, width, 3]`, or the `[n]` bytes of a file.
    Rgb(usize),
}

/// Type of a tensor's elements.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DType {
    /// 32-bit float, little-endian.
    F32,
    /// Byte.
    U8,
}

/// What an observation cost.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Timings {
    /// Waiting for other sessions' frames.
    pub queue: Duration,
    /// Rendering, with the encoding that ran beside it.
    pub render: Duration,
    /// CPU time of encoding and hashing.
    pub encode: Duration,
    /// Wall time per render stage, in milliseconds, in the order of the chain.
    pub stages_ms: Vec<(&'static str, f64)>,
}

/// A frame in the making.
pub(super) struct Assembly {
    layout: Arc<Layout>,
    answers: Answers,
    buffer: Buffer,
    history_count: usize,
    poses: usize,
    drawn: Vec<Drawn>,
    timings: Timings,
    residency: Residency,
}

impl Layout {
    /// # Errors
    /// The quality is not one.
    pub(super) fn new(
        cameras: Vec<RigCamera>,
        encoding: Encoding,
        depth: bool,
        opacity: bool,
    ) -> Result<Self, SessionError> {
        if let Encoding::Jpeg(quality) = encoding
            && !(1..=100).contains(&quality)
        {
            let must = format!("{quality}; 1 to 100 are accepted");
            return Err(SessionError::OutOfRange { field: "outputs.quality", must });
        }
        let seen = |RigCamera { camera, .. }: &RigCamera| {
            Field::of(camera).map(|field| field.share(camera))
        };
        let seen = cameras.iter().map(seen).collect();
        let layout = Self { cameras, seen, encoding, depth, opacity };
        layout.check_size(1)?;
        Ok(layout)
    }

    pub(super) fn cameras(&self) -> &[RigCamera] {
        &self.cameras
    }

    /// The share of a camera's image that its lens sees, where that is not all.
    pub(super) fn seen(&self, camera: usize) -> Option<f64> {
        self.seen[camera]
    }

    pub(super) fn encoding(&self) -> Encoding {
        self.encoding
    }

    pub(super) fn depth_and_opacity(&self) -> (bool, bool) {
        (self.depth, self.opacity)
    }

    fn check_size(&self, poses: usize) -> Result<(), SessionError> {
        let pixels: u64 = self.cameras.iter().map(|camera| camera.camera.pixels() as u64).sum();
        let (pixels, limit) = (pixels * poses as u64, config::ANSWER_PIXELS);
        if pixels > limit {
            return Err(SessionError::AnswerTooLarge { pixels, limit });
        }
        Ok(())
    }

    /// Bytes of one image's floats, and of its pixels where they are in the buffer.
    fn image_bytes(&self, camera: &RigCamera) -> (usize, usize) {
        let pixels = camera.camera.pixels();
        let floats = usize::from(self.depth) + usize::from(self.opacity);
        (4 * pixels * floats, if self.encoding == Encoding::Raw { 3 * pixels } else { 0 })
    }

    /// The same for all images of one pose.
    fn pose_bytes(&self) -> (usize, usize) {
        self.cameras.iter().fold((0, 0), |(floats, raw), camera| {
            let (more_floats, more_raw) = self.image_bytes(camera);
            (floats + more_floats, raw + more_raw)
        })
    }
}

impl Assembly {
    /// Reserves the buffer of an observation and writes the ego history into it.
    pub(super) fn new(
        layout: Arc<Layout>,
        answers: &Answers,
        episode: &Episode,
        poses: usize,
    ) -> Result<Self, SessionError> {
        layout.check_size(poses)?;
        let images = poses * layout.cameras.len();
        let header = HEADER_BASE_BYTES + images * HEADER_IMAGE_BYTES;
        let (floats, raw) = layout.pose_bytes();
        let History { xyz_m, rotation, count } = episode.history();
        let history: [&[u8]; 2] = [bytemuck::bytes_of(&xyz_m), bytemuck::bytes_of(&rotation)];
        let history = history.concat();
        let len = header + history.len() + poses * (floats + raw);
        let mut buffer = Buffer::zeroed(answers, len, header)?;
        buffer.bytes_mut()[header..header + history.len()].copy_from_slice(&history);
        Ok(Self {
            layout,
            answers: answers.clone(),
            buffer,
            history_count: count,
            poses,
            drawn: Vec::with_capacity(images),
            timings: Timings::default(),
            residency: Residency::default(),
        })
    }

    /// Renders the next pose.
    pub(super) fn draw(
        &mut self,
        scene: &Scene,
        profile: &RenderProfile,
        backend: &dyn Backend,
        views: &[View],
        scratch: &mut Scratch,
    ) -> Result<(), SessionError> {
        let layout = self.layout.clone();
        scratch.resize_with(scratch.len().max(views.len()), Vec::new);

        let mut targets = self.targets(scratch);
        let slots: Vec<OnceLock<Result<Drawn, String>>> =
            views.iter().map(|_| OnceLock::new()).collect();
        let finished = |view: usize, target: &Target<'_>| {
            let camera = &layout.cameras[view].camera;
            let pixels = target.rgb8.as_deref().unwrap_or_default();
            let drawn = encode(pixels, camera.width_px, camera.height_px, layout.encoding);
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
        for (slot, camera) in slots.into_iter().zip(&layout.cameras) {
            let drawn = slot.into_inner().unwrap_or_else(|| Err("it was never finished".into()));
            let drawn = drawn.map_err(|reason| {
                let camera = camera.name.clone();
                SessionError::Encode { camera, reason }
            })?;
            self.timings.encode += drawn.took;
            self.drawn.push(drawn);
        }
        Ok(())
    }

    /// Where the renderer puts the next pose's images.
    fn targets<'a>(&'a mut self, scratch: &'a mut Scratch) -> Vec<Target<'a>> {
        let layout = &self.layout;
        let pose = self.drawn.len() / layout.cameras.len();
        let (floats, raw) = layout.pose_bytes();
        let tail = self.buffer.bytes().len() - self.poses * (floats + raw);
        let (float_part, raw_part) =
            self.buffer.bytes_mut()[tail..].split_at_mut(self.poses * floats);
        let mut float_part = &mut float_part[pose * floats..(pose + 1) * floats];
        let mut raw_part = &mut raw_part[pose * raw..(pose + 1) * raw];
        let mut targets = Vec::with_capacity(layout.cameras.len());
        for (camera, scratch) in layout.cameras.iter().zip(scratch) {
            let pixels = camera.camera.pixels();
            let depth_m = layout.depth.then(|| floats_of(take(&mut float_part, 4 * pixels)));
            let opacity = layout.opacity.then(|| floats_of(take(&mut float_part, 4 * pixels)));
            let rgb8 = if layout.encoding == Encoding::Raw {
                take(&mut raw_part, 3 * pixels)
            } else {
                if scratch.len() < 3 * pixels {
                    scratch.resize(3 * pixels, 0);
                }
                &mut scratch[..3 * pixels]
            };
            targets.push(Target { rgba: None, rgb8: Some(rgb8), depth_m, opacity });
        }
        targets
    }

    pub(super) fn add_queue_time(&mut self, queued: Duration) {
        self.timings.queue += queued;
    }

    pub(super) fn add_waiting(&mut self, waited_for: usize, waited: Duration) {
        self.residency.waited_for += waited_for;
        self.residency.waited += waited;
    }

    /// Appends what was encoded and names every tensor.
    pub(super) fn finish(
        mut self,
        held_bytes: u64,
        limit_bytes: u64,
    ) -> Result<Frame, SessionError> {
        let layout = self.layout;
        let files: Vec<&[u8]> = self.drawn.iter().map(|drawn| &drawn.file[..]).collect();
        self.buffer.append(&self.answers, &files)?;

        let mut tensors = Tensors { list: Vec::new(), end: 0 };
        let poses = config::HISTORY_POSES;
        tensors.push(TensorKind::HistoryXyz, DType::F32, vec![poses, 3]);
        tensors.push(TensorKind::HistoryRotation, DType::F32, vec![poses, 3, 3]);
        let mut images = Vec::with_capacity(self.drawn.len());
        for (index, drawn) in self.drawn.iter().enumerate() {
            let (pose, camera) = (index / layout.cameras.len(), index % layout.cameras.len());
            images.push(Image { camera, pose, hash: drawn.hash });
            let [height, width] = size(&layout.cameras[camera]);
            if layout.depth {
                tensors.push(TensorKind::Depth(index), DType::F32, vec![height, width]);
            }
            if layout.opacity {
                tensors.push(TensorKind::Opacity(index), DType::F32, vec![height, width]);
            }
        }
        for (index, (drawn, image)) in self.drawn.iter().zip(&images).enumerate() {
            let [height, width] = size(&layout.cameras[image.camera]);
            let shape = match layout.encoding {
                Encoding::Raw => vec![height, width, 3],
                Encoding::Jpeg(_) | Encoding::Png => vec![drawn.file.len()],
            };
            tensors.push(TensorKind::Rgb(index), DType::U8, shape);
        }
        let frame_hash = frame_hash(images.iter().map(|image| image.hash));
        Ok(Frame {
            buffer: self.buffer,
            tensors: tensors.list,
            images,
            frame_hash,
            history_count: self.history_count,
            timings: self.timings,
            residency: Residency { held_bytes, limit_bytes, ..self.residency },
        })
    }
}

/// What decides how much detail the views need.
pub(crate) fn eyes(views: &[View]) -> Vec<Eye> {
    // Of a rolling shutter the end of its way: detail is chosen by distance alone, in every direction.
    let eye = |view: &View| Eye {
        position_m: view.world_from_camera.position_m,
        focal_px: view.camera.pinhole.fx.max(view.camera.pinhole.fy),
    };
    views.iter().map(eye).collect()
}

/// The hash of a frame: of its images' hashes, in order.
pub(super) fn frame_hash(images: impl Iterator<Item = blake3::Hash>) -> blake3::Hash {
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

impl DType {
    fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::U8 => 1,
        }
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
