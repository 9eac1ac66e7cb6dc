//! A plane of the ground, onto which poses are placed.

use glam::{DMat3, DQuat, DVec3};

use crate::limits;
use wildcity_scene::geometry::Pose;

/// A plane through a point, with unit normal `up`.
pub(crate) struct Plane {
    pub(crate) point_m: DVec3,
    pub(crate) up: DVec3,
}

impl Plane {
    /// The pose on the plane with the same heading, moved vertically; `None` if the plane is too
    /// steep to be a ground, or the pose points along its normal.
    pub(crate) fn place(&self, world_from_rig: Pose) -> Option<Pose> {
        let Self { point_m, up } = *self;
        // A drive that is tilted by more than 45 degrees does not define a ground.
        if up.z < limits::GROUND_UP {
            return None;
        }
        let mut position_m = world_from_rig.position_m;
        let aside_m = position_m - point_m;
        // Vertical move: n · (p - p0) = 0 solved for z. `up.z` is at least 0.7 here.
        position_m.z = point_m.z - (aside_m.x * up.x + aside_m.y * up.y) / up.z;
        let forward = (world_from_rig.rotation * DVec3::X).reject_from_normalized(up);
        // A rig that points along the normal has no heading.
        if forward.length() < limits::GROUND_HEADING {
            return None;
        }
        let forward = forward.normalize();
        // Columns x, y, z of the rotation: y is z × x, so that the axes are right-handed.
        let rotation = DQuat::from_mat3(&DMat3::from_cols(forward, up.cross(forward), up));
        Some(Pose { position_m, rotation: rotation.normalize() })
    }
}
