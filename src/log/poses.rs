//! The poses of the rig along a log, and those between two of them.

use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;

use crate::limits::LARGEST_GAP_US;

/// The poses of a log in memory, in order of time: at least one.
#[derive(Clone, Debug, PartialEq)]
pub struct Poses {
    keyframes: Vec<Keyframe>,
}

impl Poses {
    /// Poses in strictly increasing order of time.
    pub(crate) fn new(keyframes: Vec<Keyframe>) -> Self {
        Self { keyframes }
    }

    /// The poses as they were recorded.
    pub fn keyframes(&self) -> &[Keyframe] {
        &self.keyframes
    }

    /// The times of the first and the last pose, in microseconds.
    pub fn span_us(&self) -> [i64; 2] {
        let keys = &self.keyframes;
        [keys[0].time_us, keys[keys.len() - 1].time_us]
    }

    /// The pose at a time in microseconds: linear in position, spherical in rotation. `None` before
    /// the first pose, after the last one, and between two that are more than [`LARGEST_GAP_US`]
    /// apart.
    pub fn at(&self, time_us: i64) -> Option<Pose> {
        let after = self.keyframes.partition_point(|key| key.time_us <= time_us);
        let before = &self.keyframes[after.checked_sub(1)?];
        if before.time_us == time_us {
            return Some(before.world_from_rig);
        }
        let next = self.keyframes.get(after)?;
        // Unsigned: the times of a file are any 64-bit numbers.
        let gap_us = next.time_us.abs_diff(before.time_us);
        if gap_us > LARGEST_GAP_US.unsigned_abs() {
            return None;
        }
        let share = time_us.abs_diff(before.time_us) as f64 / gap_us as f64;
        Some(before.world_from_rig.interpolate(&next.world_from_rig, share))
    }

    /// The poses as a drive of a twin.
    pub fn into_trajectory(self, name: impl Into<String>) -> Trajectory {
        Trajectory { name: name.into(), keyframes: self.keyframes }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    #[test]
    fn a_pose_is_between_two_near_ones() {
        let key = |time_us: i64, x_m: f64, yaw_rad: f64| Keyframe {
            time_us,
            world_from_rig: Pose {
                position_m: x_m * DVec3::X,
                rotation: DQuat::from_rotation_z(yaw_rad),
            },
        };
        let poses = Poses::new(vec![
            key(-100_000, 0.0, 0.0),
            key(100_000, 2.0, 0.4),
            key(300_001, 9.0, 0.0),
        ]);
        let pose = poses.at(-50_000).unwrap();
        assert!((pose.position_m.x - 0.5).abs() < 1e-12, "{pose:?}");
        assert!((pose.rotation.to_scaled_axis().z - 0.1).abs() < 1e-12, "{pose:?}");
        // On a pose none beside it is needed.
        assert_eq!(poses.at(300_001), Some(poses.keyframes()[2].world_from_rig));
        assert_eq!(poses.at(100_001), None, "a gap of 200,001 microseconds");
        assert_eq!([poses.at(-100_001), poses.at(300_002)], [None, None]);
        assert_eq!(poses.at(i64::MIN), None);
        assert_eq!(poses.span_us(), [-100_000, 300_001]);
    }
}
