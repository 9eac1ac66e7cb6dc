//! Parts of recorded drives.

use serde::{Deserialize, Serialize};

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
