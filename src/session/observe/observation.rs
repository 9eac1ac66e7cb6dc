//! The parts of an observation, before `server` writes its header.

use std::ops::Range;
use std::time::Duration;

use super::buffer::ObservationBuffer;
use super::trust::Trust;
use crate::repair::status::ImageRepair;
use crate::sensors::ImageSensor;

/// An observation with all of its tensors, which only lacks the header of an answer.
#[derive(Debug)]
pub struct Observation {
    /// The bytes of all tensors, behind the bytes reserved for the header.
    pub buffer: ObservationBuffer,
    /// Where the tensors are in the buffer, in order and without gaps.
    pub tensors: Vec<Tensor>,
    /// The images, pose by pose, camera by camera.
    pub images: Vec<ImageInfo>,
    /// The sweeps of the LiDARs, in the order of the rig.
    pub sweeps: Vec<SweepInfo>,
    /// Earlier frames of the same cameras, camera by camera, the newest first.
    pub history: Vec<PastImageInfo>,
    /// BLAKE3 of the hashes of the images and then of the sweeps, 32 bytes each, in order.
    pub frame_hash: blake3::Hash,
    /// How many poses of the ego history were driven.
    pub history_count: usize,
    /// How long its parts took.
    pub timings: Timings,
    /// Memory of the twins, and the loads for this observation.
    pub residency: ResidencyStats,
}

/// Memory of the twins, and the loads for an observation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ResidencyStats {
    /// Bytes of Gaussians in memory, of all twins.
    pub held_bytes: u64,
    /// The most bytes of Gaussians that may be in memory.
    pub limit_bytes: u64,
    /// Number of sections that were not in memory when they were requested.
    pub waited_for: usize,
    /// How long the request waited for them.
    pub waited: Duration,
}

/// One image of an [`Observation`].
#[derive(Clone, Debug, PartialEq)]
pub struct ImageInfo {
    /// Index of the camera among [`crate::Session::cameras`].
    pub camera: usize,
    /// Index of the pose among those of the request.
    pub pose: usize,
    /// When it was taken by the camera's clock, in microseconds since the episode's start.
    pub time_us: i64,
    /// BLAKE3 of the pixels, `[height, width, 3]`.
    pub hash: blake3::Hash,
    /// Its trust, if the session's images come with one.
    pub trust: Option<Trust>,
    /// Result of the repair, if the session asked for repair.
    pub repair: Option<ImageRepair>,
    /// Effects of its camera on it, if the session asked for effects of this camera.
    pub sensor: Option<ImageSensor>,
}

/// One sweep of an [`Observation`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SweepInfo {
    /// Index of the LiDAR among [`crate::Session::lidars`].
    pub lidar: usize,
    /// When its last column was fired, in microseconds since the episode's start.
    pub time_us: i64,
    /// BLAKE3 of positions, intensities, rows, columns and instances, in this order.
    pub hash: blake3::Hash,
    /// Number of points: one for each beam that has a return.
    pub returns: usize,
}

/// One earlier image of an [`Observation`].
#[derive(Clone, Debug, PartialEq)]
pub struct PastImageInfo {
    /// Index of the camera among [`crate::Session::cameras`].
    pub camera: usize,
    /// Age in frames of this camera: 1 is the second newest frame.
    pub back: usize,
    /// When it was taken by the camera's clock, in microseconds since the episode's start.
    pub time_us: i64,
    /// BLAKE3 of the pixels, `[height, width, 3]`.
    pub hash: blake3::Hash,
    /// Its trust, if the session's images come with one.
    pub trust: Option<Trust>,
    /// Result of the repair, if the session asked for repair.
    pub repair: Option<ImageRepair>,
    /// Effects of its camera on it, if the session asked for effects of this camera.
    pub sensor: Option<ImageSensor>,
}

/// One tensor of an [`Observation`].
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Kind of its contents.
    pub kind: TensorKind,
    /// Type of its elements.
    pub dtype: DType,
    /// Its shape, row-major.
    pub shape: Vec<usize>,
    /// Its bytes, counted from the end of the header.
    pub bytes: Range<usize>,
}

/// Contents of a tensor; images by their index in [`Observation::images`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TensorKind {
    /// Positions of the ego history, in metres: `[16, 3]`.
    HistoryXyz,
    /// Rotations of the ego history: `[16, 3, 3]`.
    HistoryRotation,
    /// Specific force and angular velocity of each step: `[n, 6]`.
    Imu,
    /// Speed of the wheels of each step: `[n]`.
    WheelSpeed,
    /// Positions of a sweep's returns in the rig's axes, in metres: `[n, 3]`. Sweeps by their index
    /// in [`Observation::sweeps`].
    Points(usize),
    /// Intensity of each return: `[n]`.
    Intensity(usize),
    /// The row of each return's beam: `[n]`.
    Rows(usize),
    /// The column of each return's beam: `[n]`.
    Columns(usize),
    /// Whose Gaussian each return is from: `[n]`.
    PointInstances(usize),
    /// The class of that Gaussian: `[n]`.
    PointClasses(usize),
    /// Expected camera z in metres: `[height, width]`.
    Depth(usize),
    /// Accumulated opacity: `[height, width]`.
    Opacity(usize),
    /// Unit normals in the camera's axes: `[height, width, 3]`.
    Normals(usize),
    /// Whose Gaussian each pixel shows: `[height, width]`.
    Instances(usize),
    /// The class of the Gaussian that each pixel shows: `[height, width]`.
    Semantics(usize),
    /// Colour: `[height, width, 3]` pixels, or the `[n]` bytes of a file.
    Rgb(usize),
    /// Colour of an earlier image, by its index in [`Observation::history`]; shape as
    /// [`Self::Rgb`].
    PastRgb(usize),
}

/// Type of a tensor's elements.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DType {
    /// 32-bit float, little-endian.
    F32,
    U8,
    /// 16-bit unsigned integer, little-endian.
    U16,
}

/// How long the parts of an observation took.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Timings {
    /// Time in the render queue.
    pub queue: Duration,
    /// Rendering, including the encoding that ran at the same time.
    pub render: Duration,
    /// Encoding and hashing, summed over all threads.
    pub encode: Duration,
    /// Repair, of all images.
    pub repair: Duration,
    /// Wall time per render stage, in milliseconds, in the order of the stages.
    pub stages_ms: Vec<(&'static str, f64)>,
}

impl DType {
    /// Bytes of one element.
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::U8 => 1,
            Self::U16 => 2,
        }
    }
}
