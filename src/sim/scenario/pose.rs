//! Poses of scenario files.

use glam::DQuat;
use serde::{Deserialize, Serialize};

use wildcity_scene::geometry::Pose;

use super::error::FileError;

/// A pose: a position, and a heading or a whole rotation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct PoseSection {
    /// Position in the world, in metres.
    pub xyz: [f64; 3],
    /// Heading from the world's x axis, in radians, positive to the left. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub yaw_rad: Option<f64>,
    /// Rotation as a unit quaternion (w, x, y, z), instead of a heading.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub q: Option<[f64; 4]>,
}

/// A pose of a file, checked.
pub(super) fn pose_from(path: &str, section: &PoseSection) -> Result<Pose, FileError> {
    let refused = |field: &str, message: String| FileError::new(format!("{path}.{field}"), message);
    // A quaternion needs no range check here: `Pose::checked` refuses one that is not a rotation.
    let q_wxyz = match (section.q, section.yaw_rad) {
        (Some(_), Some(_)) => {
            return Err(refused("q", "is there beside yaw_rad; write one of them".to_owned()));
        }
        (Some(q), None) => q,
        (None, yaw_rad) => {
            let yaw_rad = yaw_rad.unwrap_or(0.0);
            // Sine and cosine of infinity are NaN. The later check would name `q`, which the file
            // does not have.
            if !yaw_rad.is_finite() {
                return Err(refused("yaw_rad", format!("{yaw_rad:?}; write a finite number")));
            }
            let rotation = DQuat::from_rotation_z(yaw_rad);
            [rotation.w, rotation.x, rotation.y, rotation.z]
        }
    };
    Pose::checked(section.xyz, q_wxyz).map_err(|error| refused(error.field(), error.to_string()))
}
