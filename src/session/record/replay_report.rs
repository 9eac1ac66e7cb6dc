//! Results and errors of a replay.

use std::io;
use std::path::PathBuf;

use glam::Vec3;
use wildcity_episode::{ReadError, SweepPoint};
use wildcity_render::RenderError;
use wildcity_render::lidar::LidarView;
use wildcity_repair::RepairError;
use wildcity_scene::rig::{RigCamera, RigError, RigLidar};
use wildcity_twin::residency::ResidencyError;

use super::ego_replay::DivergedStep;
use super::format::FrameRequest;
use crate::error::SessionError;
use crate::observe::point_cloud::PointCloud;

/// The result of a replay.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplayReport {
    /// Number of images that were rendered again.
    pub images: u64,
    /// Number of LiDAR sweeps that were cast again.
    pub sweeps: u64,
    /// Differences from the time of recording, which may explain differing images.
    pub changes: Vec<ProvenanceChange>,
    /// The first step at which the command leads to a pose that differs from the recorded one.
    pub diverged: Option<DivergedStep>,
    /// The first image or sweep that differs.
    pub difference: Option<ImageDifference>,
    /// The first other value of the record that does not follow from the rest of it.
    pub wrong_value: Option<WrongValue>,
    /// Images that a model had repaired.
    pub repaired: RepairedImages,
}

/// Images that a model had repaired. Their rendered pixels and the decision are compared in any
/// case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RepairedImages {
    /// Repaired again, and compared.
    pub compared: u64,
    /// Not repaired again: the recorded model was not given, or does not repeat its bytes.
    pub not_compared: u64,
}

/// A value of the record, other than poses and images, that differs from the computed value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrongValue {
    /// Line of the episode's file, from 1.
    pub line: usize,
    /// The field: `step`, `time_us`, `frame_hash`, `repairs`, `sensors`, `sweeps`, or one of the
    /// end: `outcome`, `steps`, `distance_m` ..
    pub field: &'static str,
    pub recorded: String,
    pub now: String,
}

/// Where a replay stops.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReplayUntil {
    /// At the episode's end, whatever differs.
    End,
    /// At the first image that differs, or the first step that diverges.
    FirstDifference,
}

/// A difference between what recorded the episode and what replays it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProvenanceChange {
    /// `build`, `backend`, `backend detail`, `version hash`, `profile hash`, `repair hash` or
    /// `repair`.
    pub what: &'static str,
    pub recorded: String,
    /// As it is now.
    pub now: String,
}

/// An image or a sweep that differs from the recorded one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImageDifference {
    /// Line of the episode's file, from 1.
    pub line: usize,
    /// Which request was answered.
    pub request: FrameRequest,
    pub step: u64,
    /// Index of the pose among those of the record; 0 but for `observe`, or for frames of a
    /// warm-up.
    pub pose: usize,
    /// The camera or the LiDAR.
    pub sensor: Sensor,
    pub recorded: String,
    pub now: String,
}

/// A sensor of the rig, by its name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sensor {
    Camera(String),
    Lidar(String),
}

impl std::fmt::Display for Sensor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Camera(name) => write!(f, "camera {name:?}"),
            Self::Lidar(name) => write!(f, "LiDAR {name:?}"),
        }
    }
}

/// An image that was rendered again.
#[derive(Clone, Copy, Debug)]
pub struct ReplayedImage<'a> {
    /// Index of its record in [`RecordedEpisode::frames`](crate::RecordedEpisode::frames).
    pub frame: usize,
    /// Which request was answered.
    pub request: FrameRequest,
    pub step: u64,
    /// Index of the pose among those of the record.
    pub pose: usize,
    pub camera: &'a RigCamera,
    /// The pixels, `[height, width, 3]`.
    pub rgb8: &'a [u8],
}

/// A sweep that was cast again.
#[derive(Clone, Copy, Debug)]
pub struct ReplayedSweep<'a> {
    /// Index of its LiDAR in the rig.
    pub lidar: usize,
    /// The sweep's time, in microseconds since the episode's start.
    pub time_us: i64,
    pub(crate) mounted: &'a RigLidar,
    pub(crate) view: &'a LidarView,
    pub(crate) cloud: &'a PointCloud,
}

impl ReplayedSweep<'_> {
    /// Its returns, row by row.
    pub fn points(&self) -> Vec<SweepPoint> {
        let Self { mounted, view, cloud, .. } = self;
        let beams = &mounted.lidar;
        let lidar_from_rig = mounted.rig_from_lidar.inverse();
        let rig_from_world = (view.world_from_lidar * lidar_from_rig).inverse();
        // Once for each column, and not for each beam.
        let columns = (0..beams.columns()).map(|column| {
            let world_from_rig = view.world_from_lidar_at(column) * lidar_from_rig;
            (rig_from_world * world_from_rig, -(beams.age_us(column).round() as i32))
        });
        let columns: Vec<_> = columns.collect();
        let point = |at: usize| {
            let (last_from_rig, offset_us) = &columns[usize::from(cloud.columns[at])];
            let measured_m = Vec3::from_array(cloud.points_m[at]).as_dvec3();
            SweepPoint {
                xyz_m: last_from_rig.transform_point(measured_m).as_vec3().to_array(),
                intensity: cloud.intensity[at],
                offset_us: *offset_us,
                row: cloud.rows[at],
                column: cloud.columns[at],
                instance: cloud.instances[at],
                class: cloud.classes.get(at).map_or(0, |class| class.value()),
            }
        };
        (0..cloud.points_m.len()).map(point).collect()
    }
}

/// What a replay has computed again.
#[derive(Clone, Copy, Debug)]
pub enum Replayed<'a> {
    Image(ReplayedImage<'a>),
    Sweep(ReplayedSweep<'a>),
}

/// Why an episode could not be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The file cannot be read.
    #[error("cannot read {}: {cause}", path.display())]
    Read {
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    /// The file is not a record.
    #[error(transparent)]
    NoRecord(#[from] ReadError),
    /// A line is damaged, incomplete or out of place.
    #[error("{}, line {line}: {reason}", path.display())]
    Line {
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        reason: String,
    },
    /// The recorded cameras are invalid.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// A version of the twin does not exist or cannot be read.
    #[error(transparent)]
    Twin(#[from] ResidencyError),
    /// The data of a frame does not fit into memory, or could not be loaded.
    #[error("step {step}: {cause}")]
    Residency { step: u64, cause: ResidencyError },
    /// The episode's ego cannot execute a recorded command.
    #[error("step {step}: {cause}")]
    Ego { step: u64, cause: Box<SessionError> },
    /// The recorded settings of the sensors are out of range.
    #[error(transparent)]
    Sensors(Box<SessionError>),
    /// The backend refused a frame.
    #[error("step {step}: {cause}")]
    Render { step: u64, cause: RenderError },
    /// The repair model cannot be loaded.
    #[error(transparent)]
    Model(Box<RepairError>),
    /// The repair model fails on an image that it had repaired.
    #[error("step {step}, camera {camera:?}: {cause}")]
    Repair {
        step: u64,
        /// Name of the camera.
        camera: String,
        cause: Box<RepairError>,
    },
    /// The images were repaired by their trust, which needs a recorded drive.
    #[error("images were repaired by their trust, and the twin has no recorded drive any more")]
    NoDrive,
    /// The table of recorded images cannot be read, and the model compares with them.
    #[error("the recorded images of the twin cannot be read: {0}")]
    Reference(String),
    /// The caller's function failed on an image or a sweep.
    #[error("step {step}, {sensor}: {reason:#}")]
    Visit { step: u64, sensor: Sensor, reason: String },
}

impl std::fmt::Display for ImageDifference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { line, step, pose, sensor, recorded, now, request } = self;
        write!(f, "step {step}, {sensor}")?;
        if *request == FrameRequest::Observe {
            write!(f, ", pose {pose} of observe")?;
        }
        write!(f, " (line {line}): recorded {recorded}, now {now}")
    }
}

impl std::fmt::Display for WrongValue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { line, field, recorded, now } = self;
        write!(f, "{field} (line {line}): recorded {recorded}, now {now}")
    }
}
