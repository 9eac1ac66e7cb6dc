//! Poses.

use serde::{Deserialize, Serialize};

/// A rigid transform: position in metres, unit quaternion (w, x, y, z).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Pose {
    /// Position, in metres.
    pub xyz: [f64; 3],
    /// Unit quaternion (w, x, y, z).
    pub q: [f64; 4],
}
