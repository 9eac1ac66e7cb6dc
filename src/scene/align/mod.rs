//! Putting a capture on the ground: x and y level, z up, the ground at z = 0, metres.

mod cameras;
mod capture;
mod ground;
mod path;
mod plane;

use std::str::FromStr;

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::geometry::{Pose, PoseError};
use crate::trajectory::Keyframe;
use crate::{Gaussians, Trajectory};

pub use cameras::{CamerasError, CaptureCameras};
pub use capture::{
    CaptureOptions, CapturedDrive, CapturedDriveError, DEFAULT_FPS, PosedImage, captured_drive,
};
pub use ground::{
    GroundError, GroundSearch, SceneExtent, find_ground, find_ground_below, scene_extent,
};
pub use path::{DEFAULT_SPEED_M_S, PathError, drive_through};
pub use plane::GroundPlane;

/// A change of a twin's axes and unit: `p_new = metres_per_unit * (new_from_old * p_old)`.
///
/// JSON: `{"new_from_old": {"xyz", "q"}, "metres_per_unit": 1.0}`; as an option of a version's
/// provenance the eight numbers x, y, z, w, x, y, z of the pose and the scale, separated by commas.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Alignment {
    /// The rotation and the move, in the old unit.
    pub new_from_old: Pose,
    /// Size of the old unit, in metres.
    pub metres_per_unit: f64,
}

/// Why an alignment was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AlignmentError {
    /// The scale is out of range.
    #[error("a scale of {0:?}; from 1e-6 to 1e6 metres per unit are accepted")]
    Scale(f64),
    /// Two points that give the scale are the same, or a distance is not positive.
    #[error(
        "two points that are {length:?} apart cannot be {distance_m:?} m apart: choose two different points, and \
         give the distance in metres"
    )]
    Points {
        /// Distance of the points, in the old unit.
        length: f64,
        /// The distance that they should have.
        distance_m: f64,
    },
    /// The three points lie on one line.
    #[error("the three points of the ground lie on one line: choose points that span a triangle")]
    OnLine,
    /// The rotation and the move are out of range.
    #[error("the move of the alignment, in the old unit: {0}")]
    Pose(PoseError),
    #[error("{0:?} is not an alignment: expected eight numbers, separated by commas")]
    Text(String),
}

impl Alignment {
    /// The alignment that leaves axes and unit as they are.
    pub const IDENTITY: Self = Self { new_from_old: Pose::IDENTITY, metres_per_unit: 1.0 };

    /// Puts a plane at z = 0 with the shortest rotation, which keeps headings as far as possible.
    /// The foot of the old origin on the plane becomes the new origin.
    pub fn onto(ground: &GroundPlane) -> Self {
        let up = ground.up;
        // Upside down, the shortest rotation is not unique: half a turn about x.
        // The rotation from up to z is about their cross product, which vanishes near -z.
        let is_upside_down = up.z < -1.0 + 1e-9;
        let rotation = if is_upside_down {
            DQuat::from_rotation_x(std::f64::consts::PI)
        } else {
            DQuat::from_rotation_arc(up, DVec3::Z)
        };
        let foot = up * up.dot(ground.point);
        // The foot p0 becomes the origin: R p0 + t = 0.
        let new_from_old = Pose { position_m: -(rotation * foot), rotation };
        Self { new_from_old, ..Self::IDENTITY }
    }

    /// These axes with a different unit.
    ///
    /// # Errors
    /// [`AlignmentError::Scale`].
    pub fn scaled(self, metres_per_unit: f64) -> Result<Self, AlignmentError> {
        if !(1e-6..=1e6).contains(&metres_per_unit) {
            return Err(AlignmentError::Scale(metres_per_unit));
        }
        Ok(Self { metres_per_unit, ..self })
    }

    /// Checks that an alignment, for example a product of two, can be stored and read again.
    ///
    /// # Errors
    /// [`AlignmentError::Scale`], [`AlignmentError::Pose`].
    pub fn check(&self) -> Result<(), AlignmentError> {
        let Pose { position_m, .. } = self.new_from_old;
        let pose = Pose::checked(position_m.to_array(), self.new_from_old.q_wxyz());
        pose.map_err(AlignmentError::Pose)?;
        self.scaled(self.metres_per_unit).map(|_| ())
    }

    /// A point in the new axes, in metres.
    pub fn point_m(&self, old: DVec3) -> DVec3 {
        self.metres_per_unit * self.new_from_old.transform_point(old)
    }

    /// A pose in the new axes.
    pub fn pose(&self, old: &Pose) -> Pose {
        let mut new = self.new_from_old * *old;
        new.position_m *= self.metres_per_unit;
        new
    }

    /// Turns, moves and scales Gaussians with their colours.
    pub fn apply(&self, gaussians: &mut Gaussians) {
        // A rotation by the identity would still round quaternions and colours; bytes of an
        // unchanged scene stay the same.
        if self.new_from_old != Pose::IDENTITY {
            gaussians.transform(&self.new_from_old);
        }
        gaussians.scale(self.metres_per_unit);
    }

    /// Turns, moves and scales the poses of a drive. Its times stay.
    pub fn drive(&self, old: &Trajectory) -> Trajectory {
        let keyframe = |keyframe: &Keyframe| Keyframe {
            time_us: keyframe.time_us,
            world_from_rig: self.pose(&keyframe.world_from_rig),
        };
        let keyframes = old.keyframes.iter().map(keyframe).collect();
        Trajectory { name: old.name.clone(), keyframes }
    }

    /// Directions in the new axes as directions in the old ones.
    pub fn old_from_new(&self) -> DMat3 {
        self.new_from_old.rotation_matrix().transpose()
    }

    /// The alignment that applies `first` and then this one.
    pub fn after(&self, first: &Self) -> Self {
        // s2 (T2 (s1 (T1 p))) = s1 s2 (T2' (T1 p)), where T2' moves by 1 / s1 of what T2 moves.
        let mut second = self.new_from_old;
        second.position_m /= first.metres_per_unit;
        Self {
            new_from_old: second * first.new_from_old,
            metres_per_unit: self.metres_per_unit * first.metres_per_unit,
        }
    }
}

/// The plane of three points; its upper side is that of the fourth, such as the camera that saw the
/// three.
///
/// # Errors
/// [`AlignmentError::OnLine`].
pub fn plane_through([a, b, c]: [DVec3; 3], above: DVec3) -> Result<GroundPlane, AlignmentError> {
    let normal = (b - a).cross(c - a);
    // Twice the area against the square of the longest side: 0 on a line.
    let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
    let is_triangle = normal.length() > 1e-3 * longest && longest.is_finite();
    if !is_triangle {
        return Err(AlignmentError::OnLine);
    }
    let normal = normal.normalize();
    let up = if normal.dot(above - a) < 0.0 { -normal } else { normal };
    Ok(GroundPlane { point: a, up })
}

/// Metres per unit, by two points of known distance.
///
/// # Errors
/// [`AlignmentError::Points`], [`AlignmentError::Scale`].
pub fn scale_from_points(points: [DVec3; 2], distance_m: f64) -> Result<f64, AlignmentError> {
    let length = points[0].distance(points[1]);
    let is_usable = length > 0.0 && length.is_finite() && distance_m > 0.0;
    if !is_usable {
        return Err(AlignmentError::Points { length, distance_m });
    }
    let scale = distance_m / length;
    Alignment::IDENTITY.scaled(scale).map(|_| scale)
}

impl std::fmt::Display for Alignment {
    /// The text that [`Alignment::from_str`] reads.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [x, y, z] = self.new_from_old.position_m.to_array();
        let [qw, qx, qy, qz] = self.new_from_old.q_wxyz();
        let scale = self.metres_per_unit;
        write!(f, "{x},{y},{z},{qw},{qx},{qy},{qz},{scale}")
    }
}

impl FromStr for Alignment {
    type Err = AlignmentError;

    fn from_str(text: &str) -> Result<Self, AlignmentError> {
        let wrong = || AlignmentError::Text(text.to_owned());
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
        let Ok(&[x, y, z, qw, qx, qy, qz, scale]) = numbers.as_deref() else {
            return Err(wrong());
        };
        let new_from_old = Pose::checked([x, y, z], [qw, qx, qy, qz]).map_err(|_| wrong())?;
        Self { new_from_old, ..Self::IDENTITY }.scaled(scale)
    }
}

/// The median; the upper one of an even number. There is at least one value.
fn median(mut values: Vec<f64>) -> f64 {
    // Selection is O(n), which matters: the heights of a scene are millions of values.
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tilted() -> GroundPlane {
        GroundPlane {
            point: DVec3::new(3.0, -1.0, 7.0),
            up: DVec3::new(0.3, -0.5, -0.8).normalize(),
        }
    }

    #[test]
    fn a_plane_is_put_at_zero_and_its_upper_side_is_up() {
        let plane = tilted();
        let alignment = Alignment::onto(&plane).scaled(2.5).unwrap();
        let side = plane.up.any_orthonormal_vector();
        let on_plane = alignment.point_m(plane.point + 4.0 * side);
        assert!(on_plane.z.abs() < 1e-12, "{on_plane}");
        let above = alignment.point_m(plane.point + 2.0 * plane.up);
        assert!((above.z - 5.0).abs() < 1e-12, "{above}");
        // The foot of the old origin is the new one.
        let foot = plane.up * plane.up.dot(plane.point);
        assert!(alignment.point_m(foot).length() < 1e-12);
        let upside_down = GroundPlane { point: DVec3::ZERO, up: -DVec3::Z };
        let turned = Alignment::onto(&upside_down).point_m(DVec3::new(1.0, 2.0, -3.0));
        assert!((turned - DVec3::new(1.0, -2.0, 3.0)).length() < 1e-12, "{turned}");
    }

    #[test]
    fn two_alignments_are_one_and_its_text_is_read_again() {
        let first = Alignment::onto(&tilted()).scaled(0.5).unwrap();
        let plane = GroundPlane {
            point: DVec3::new(0.0, 1.0, -2.0),
            up: DVec3::new(0.1, 0.2, 0.9).normalize(),
        };
        let second = Alignment::onto(&plane).scaled(3.0).unwrap();
        let p = DVec3::new(1.0, -2.0, 0.5);
        let both = second.after(&first);
        assert!((both.point_m(p) - second.point_m(first.point_m(p))).length() < 1e-12);
        assert_eq!(both.to_string().parse::<Alignment>().unwrap(), both);
        assert!("1,2,3".parse::<Alignment>().is_err());
        assert!("0,0,0,1,0,0,0,0".parse::<Alignment>().is_err());
    }

    #[test]
    fn three_points_are_a_plane_with_the_camera_above_it() {
        let points = [DVec3::Z, DVec3::new(2.0, 0.0, 1.0), DVec3::new(0.0, 2.0, 1.0)];
        for above in [4.0, -4.0] {
            let plane = plane_through(points, DVec3::new(9.0, 9.0, above)).unwrap();
            assert!((plane.up - DVec3::Z * above.signum()).length() < 1e-12, "{plane:?}");
        }
        let line = [DVec3::ZERO, DVec3::X, 3.0 * DVec3::X];
        assert_eq!(plane_through(line, DVec3::Z), Err(AlignmentError::OnLine));
    }

    #[test]
    fn the_scale_of_two_points_is_positive() {
        let points = [DVec3::ZERO, DVec3::new(0.0, 0.0, 4.0)];
        assert_eq!(scale_from_points(points, 2.0), Ok(0.5));
        assert!(matches!(scale_from_points(points, -2.0), Err(AlignmentError::Points { .. })));
        assert!(matches!(
            scale_from_points([DVec3::X; 2], 2.0),
            Err(AlignmentError::Points { .. })
        ));
        assert!(matches!(scale_from_points(points, 1e9), Err(AlignmentError::Scale(_))));
    }
}
