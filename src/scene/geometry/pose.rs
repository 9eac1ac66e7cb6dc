//! Rigid transforms.

use std::ops::Mul;

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// A rigid transform `a_from_b`: the pose of frame `b` in frame `a`.
///
/// JSON: `{"xyz": [m, m, m], "q": [w, x, y, z]}`. Poses from untrusted input are built with
/// [`Pose::checked`], which guarantees finite values and a unit quaternion.
///
/// ```
/// use glam::DVec3;
/// use wildcity_scene::geometry::Pose;
///
/// // 10 m east of the origin, turned a quarter to the left: its forward axis (x) points north (y).
/// let half_turn = std::f64::consts::FRAC_1_SQRT_2;
/// let world_from_rig = Pose::checked([10.0, 0.0, 0.0], [half_turn, 0.0, 0.0, half_turn])?;
/// let ahead_m = world_from_rig.transform_point(DVec3::X);
/// assert!((ahead_m - DVec3::new(10.0, 1.0, 0.0)).length() < 1e-12);
///
/// let back_m = world_from_rig.inverse().transform_point(ahead_m);
/// assert!((back_m - DVec3::X).length() < 1e-12);
/// # Ok::<(), wildcity_scene::geometry::PoseError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Origin of `b`, in metres along the axes of `a`.
    pub position_m: DVec3,
    /// Rotation that takes directions in `b` to directions in `a`; a unit quaternion.
    pub rotation: DQuat,
}

/// Why [`Pose::checked`] refused a pose.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PoseError {
    /// A component is NaN or infinite.
    #[error("{field} is {value:?}; a pose needs finite numbers")]
    NotFinite {
        /// The component, such as `xyz[0]` or `q[3]`.
        field: &'static str,
        value: f64,
    },
    /// The norm of the quaternion differs from one by more than [`Pose::MAX_NORM_ERROR`].
    #[error("q has length {length:?}; a rotation needs a unit quaternion (w, x, y, z)")]
    NotARotation {
        /// Euclidean norm of (w, x, y, z).
        length: f64,
    },
    /// A coordinate exceeds [`Pose::MAX_COORDINATE_M`].
    #[error("{field} is {value:?} m; at most {limit_m:?} m from the twin's origin is accepted")]
    TooFar {
        /// The component, such as `xyz[0]`.
        field: &'static str,
        /// The refused value, in metres.
        value: f64,
        /// The largest accepted magnitude, in metres.
        limit_m: f64,
    },
}

impl PoseError {
    /// The component at fault, by its name on the wire.
    pub fn field(&self) -> &'static str {
        match self {
            Self::NotFinite { field, .. } | Self::TooFar { field, .. } => field,
            Self::NotARotation { .. } => "q",
        }
    }
}

impl Pose {
    /// The pose of a frame in itself.
    pub const IDENTITY: Self = Self { position_m: DVec3::ZERO, rotation: DQuat::IDENTITY };

    /// Largest accepted magnitude of a coordinate, in metres. A city spans 1e5 m; UTM northings
    /// reach 1e7 m.
    pub const MAX_COORDINATE_M: f64 = 1e8;

    /// A quaternion whose norm differs from one by at most this is normalised; otherwise it is
    /// refused.
    pub const MAX_NORM_ERROR: f64 = 1e-3;

    /// A pose from untrusted input: position in metres, quaternion as (w, x, y, z).
    ///
    /// # Errors
    /// Names the first component that is not finite, too far away, or not a rotation.
    pub fn checked(xyz_m: [f64; 3], q_wxyz: [f64; 4]) -> Result<Self, PoseError> {
        for (field, value) in ["xyz[0]", "xyz[1]", "xyz[2]"].into_iter().zip(xyz_m) {
            if !value.is_finite() {
                return Err(PoseError::NotFinite { field, value });
            }
            if value.abs() > Self::MAX_COORDINATE_M {
                return Err(PoseError::TooFar { field, value, limit_m: Self::MAX_COORDINATE_M });
            }
        }
        for (field, value) in ["q[0]", "q[1]", "q[2]", "q[3]"].into_iter().zip(q_wxyz) {
            if !value.is_finite() {
                return Err(PoseError::NotFinite { field, value });
            }
        }
        let [w, x, y, z] = q_wxyz;
        let rotation = DQuat::from_xyzw(x, y, z, w);
        let length = rotation.length();
        // A length of NaN cannot occur, since components are finite, but an infinite one can: it
        // fails the comparison.
        let is_rotation = (length - 1.0).abs() <= Self::MAX_NORM_ERROR;
        if !is_rotation {
            return Err(PoseError::NotARotation { length });
        }
        // Normalising twice can change the last bits. A quaternion that is already unit is
        // therefore kept, so that a pose that is written and read again is bit-identical.
        let is_unit = (rotation.length_squared() - 1.0).abs() <= 8.0 * f64::EPSILON;
        let rotation = if is_unit { rotation } else { rotation.normalize() };
        Ok(Self { position_m: DVec3::from_array(xyz_m), rotation })
    }

    /// The inverse transform `b_from_a`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { position_m: -(rotation * self.position_m), rotation }
    }

    /// Transforms a point in `b` to `a`, in metres.
    pub fn transform_point(&self, point_m: DVec3) -> DVec3 {
        self.rotation * point_m + self.position_m
    }

    /// The rotation as a matrix; its columns are the axes of `b` in `a`.
    pub fn rotation_matrix(&self) -> DMat3 {
        DMat3::from_quat(self.rotation)
    }

    /// Interpolates to `other` by `t` in [0, 1]: positions linearly, rotations spherically (slerp).
    pub fn interpolate(&self, other: &Self, t: f64) -> Self {
        Self {
            position_m: self.position_m.lerp(other.position_m, t),
            rotation: self.rotation.slerp(other.rotation, t),
        }
    }

    /// The quaternion as (w, x, y, z).
    pub fn q_wxyz(&self) -> [f64; 4] {
        let q = self.rotation;
        [q.w, q.x, q.y, q.z]
    }
}

/// `a_from_c = a_from_b * b_from_c`.
impl Mul for Pose {
    type Output = Self;

    fn mul(self, b_from_c: Self) -> Self {
        Self {
            position_m: self.transform_point(b_from_c.position_m),
            // Products of unit quaternions drift by rounding; a chain of thousands of poses stays a
            // rotation.
            rotation: (self.rotation * b_from_c.rotation).normalize(),
        }
    }
}

impl From<Pose> for wildcity_options::Pose {
    fn from(pose: Pose) -> Self {
        Self { xyz: pose.position_m.to_array(), q: pose.q_wxyz() }
    }
}

impl From<Pose> for wildcity_options::Start {
    fn from(pose: Pose) -> Self {
        Self::Pose { pose: pose.into() }
    }
}

impl TryFrom<wildcity_options::Pose> for Pose {
    type Error = PoseError;

    fn try_from(
        wildcity_options::Pose { xyz, q }: wildcity_options::Pose,
    ) -> Result<Self, PoseError> {
        Self::checked(xyz, q)
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseFields {
    xyz: [f64; 3],
    q: [f64; 4],
}

impl Serialize for Pose {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        PoseFields { xyz: self.position_m.to_array(), q: self.q_wxyz() }.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Pose {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let PoseFields { xyz, q } = PoseFields::deserialize(deserializer)?;
        Self::checked(xyz, q).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn composition_and_inverse_agree() {
        let world_from_rig = Pose {
            position_m: DVec3::new(10.0, -4.0, 0.5),
            rotation: DQuat::from_rotation_z(FRAC_PI_2),
        };
        let rig_from_camera =
            Pose { position_m: DVec3::new(1.5, 0.0, 1.6), rotation: DQuat::from_rotation_y(0.3) };
        let point_camera = DVec3::new(0.1, -0.7, 12.0);
        let composed = (world_from_rig * rig_from_camera).transform_point(point_camera);
        let stepwise =
            world_from_rig.transform_point(rig_from_camera.transform_point(point_camera));
        assert!((composed - stepwise).length() < 1e-12);
        let back = (world_from_rig * rig_from_camera).inverse().transform_point(composed);
        assert!((back - point_camera).length() < 1e-12);
        // A quarter turn to the left takes forward (x) to left (y).
        assert!((world_from_rig.rotation * DVec3::X - DVec3::Y).length() < 1e-12);
    }

    #[test]
    fn errors_name_the_component_at_fault() {
        let unit = [1.0, 0.0, 0.0, 0.0];
        let refused = |xyz, q| Pose::checked(xyz, q).unwrap_err().field();
        assert_eq!(refused([f64::NAN, 0.0, 0.0], unit), "xyz[0]");
        assert_eq!(refused([0.0, 0.0, 1e9], unit), "xyz[2]");
        assert_eq!(refused([0.0; 3], [1.0, 0.0, f64::INFINITY, 0.0]), "q[2]");
        assert_eq!(refused([0.0; 3], [0.0; 4]), "q");
        assert_eq!(refused([0.0; 3], [0.5, 0.5, 0.5, 0.4]), "q");
    }

    #[test]
    fn reading_a_written_pose_is_bit_identical() {
        for i in 0..10_000 {
            let q = [0, 1, 2, 3].map(|k| (f64::from(i) * 0.37 + f64::from(k) * 1.1).sin());
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            // Lengths of 1 - 9e-4, 1 and 1 + 9e-4: all within the accepted error.
            let off = 1.0 + 9e-4 * f64::from(i % 3 - 1);
            let once = Pose::checked([0.0; 3], q.map(|x| x / length * off)).unwrap();
            let twice = Pose::checked([0.0; 3], once.q_wxyz()).unwrap();
            assert_eq!(once, twice, "{i}");
        }
    }

    #[test]
    fn json_is_xyz_and_wxyz() {
        let pose = Pose {
            position_m: DVec3::new(1.0, 2.0, 3.0),
            rotation: DQuat::from_xyzw(0.0, 0.0, 0.6, 0.8),
        };
        let text = serde_json::to_string(&pose).unwrap();
        assert_eq!(text, r#"{"xyz":[1.0,2.0,3.0],"q":[0.8,0.0,0.0,0.6]}"#);
        assert_eq!(serde_json::from_str::<Pose>(&text).unwrap(), pose);
        assert!(serde_json::from_str::<Pose>(r#"{"xyz":[0,0,0],"q":[0,0,0,0]}"#).is_err());
    }
}
