//! Recorded drives: their poses, for agents that follow them or compare themselves with them.

use serde::{Deserialize, Serialize};

use super::Pose;

/// Poses of a recorded drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Drive {
    /// Name of the trajectory.
    pub name: String,
    /// Version of the twin.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// Length of the whole trajectory, in metres.
    pub length_m: f64,
    /// The poses, in driving order.
    pub poses: Vec<DrivePose>,
}

/// A pose of a recorded drive.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct DrivePose {
    /// Distance from the start of the trajectory along its keyframes, in metres.
    pub station_m: f64,
    /// Time on the trajectory's clock, in microseconds.
    pub time_us: i64,
    /// `world_from_rig`.
    pub pose: Pose,
}
