//! Recorded drives: their poses, for agents that follow them or compare themselves with them.

use serde::{Deserialize, Serialize};

use super::pose::Pose;

/// A part of a recorded drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DriveSection {
    /// Name of the trajectory.
    pub name: String,
    /// Where the part begins, in metres from the start of the trajectory. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0)))]
    pub from_m: Option<f64>,
    /// Where the part ends. If absent, or beyond the end of the trajectory, that end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0)))]
    pub to_m: Option<f64>,
    /// Distance between two poses, which are interpolated. If absent, the recorded keyframes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0)))]
    pub every_m: Option<f64>,
}

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
