//! Poses.

use serde::{Deserialize, Serialize};

/// A rigid transform: position in metres, unit quaternion (w, x, y, z).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Pose {
    /// Position, in metres.
    #[cfg_attr(feature = "schema", schemars(inner(range(min = -1e8, max = 1e8))))]
    pub xyz: [f64; 3],
    /// Unit quaternion (w, x, y, z).
    #[cfg_attr(feature = "schema", schemars(inner(range(min = -1.001, max = 1.001))))]
    pub q: [f64; 4],
}
