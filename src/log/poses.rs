//! The poses of the rig along a log, and those between two of them.

use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::route::KEYFRAME_SPACING_M;
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
        // Times of poses strictly increase, so the gap is not 0.
        let share = time_us.abs_diff(before.time_us) as f64 / gap_us as f64;
        Some(before.world_from_rig.interpolate(&next.world_from_rig, share))
    }

    /// The poses as a drive of a twin: those that are [`KEYFRAME_SPACING_M`] or half of
    /// [`LARGEST_GAP_US`] after the one before, the first and the last. So poses between them can
    /// still be interpolated.
    pub fn drive(&self, name: impl Into<String>) -> Trajectory {
        let mut keyframes: Vec<Keyframe> = Vec::new();
        for (at, key) in self.keyframes.iter().enumerate() {
            let is_last = at + 1 == self.keyframes.len();
            let is_far = |last: &Keyframe| {
                let [from_m, to_m] = [last, key].map(|key| key.world_from_rig.position_m);
                // As `Route::subsample`: in spite of rounding.
                from_m.distance(to_m) >= 0.999 * KEYFRAME_SPACING_M
                    || key.time_us.abs_diff(last.time_us) >= LARGEST_GAP_US.unsigned_abs() / 2
            };
            if is_last || keyframes.last().is_none_or(is_far) {
                keyframes.push(*key);
            }
        }
        Trajectory { name: name.into(), keyframes }
    }
}

/// Distances along the drive.
#[derive(Clone, Debug)]
pub struct Stations<'a> {
    poses: &'a Poses,
    /// Distance of each pose from the start, in metres.
    stations_m: Vec<f64>,
}

impl<'a> Stations<'a> {
    /// Distances from the first pose.
    pub fn new(poses: &'a Poses) -> Self {
        let mut station_m = 0.0;
        let steps = poses.keyframes.windows(2).map(|pair| {
            let [from_m, to_m] = [0, 1].map(|at| pair[at].world_from_rig.position_m);
            station_m += from_m.distance(to_m);
            station_m
        });
        let stations_m = std::iter::once(0.0).chain(steps).collect();
        Self { poses, stations_m }
    }

    /// Length of the drive, in metres.
    pub fn length_m(&self) -> f64 {
        self.stations_m.last().copied().unwrap_or(0.0)
    }

    /// The distance from the start at a time, in metres; `None` where there is no pose.
    pub fn at(&self, time_us: i64) -> Option<f64> {
        // Within a gap of the poses the path is unknown, and with it the distance.
        self.poses.at(time_us)?;
        let keys = &self.poses.keyframes;
        let after = keys.partition_point(|key| key.time_us <= time_us);
        let before = after.checked_sub(1)?;
        let from_m = self.stations_m[before];
        // After the last pose `at` has returned: the time is exactly that of the last one.
        let Some(to_m) = self.stations_m.get(after) else { return Some(from_m) };
        let since_us = |until_us: i64| until_us.abs_diff(keys[before].time_us) as f64;
        let share = since_us(time_us) / since_us(keys[after].time_us);
        Some(from_m + share * (to_m - from_m))
    }

    /// The time of the first pose at a distance or later, in microseconds; `None` beyond the end.
    pub(crate) fn time_us(&self, station_m: f64) -> Option<i64> {
        let at = self.stations_m.partition_point(|other_m| *other_m < station_m);
        self.poses.keyframes.get(at).map(|key| key.time_us)
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
