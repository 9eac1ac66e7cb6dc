//! Recorded trajectories: timed poses of the rig along a drive.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::geometry::Pose;

use super::rig::is_name;

/// One recorded pose of the rig, with its time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Keyframe {
    /// Time since the trajectory's start, in microseconds.
    pub time_us: i64,
    /// Pose of the rig in the world.
    pub world_from_rig: Pose,
}

/// A recorded drive: keyframes in order of time.
///
/// ```
/// use glam::DVec3;
/// use wildcity_scene::Trajectory;
/// use wildcity_scene::geometry::Pose;
/// use wildcity_scene::trajectory::Keyframe;
///
/// let keyframe = |seconds: i64| Keyframe {
///     time_us: seconds * 1_000_000,
///     world_from_rig: Pose { position_m: 10.0 * seconds as f64 * DVec3::X, ..Pose::IDENTITY },
/// };
/// let drive = Trajectory { name: "log".into(), keyframes: (0..=3).map(keyframe).collect() };
/// drive.check()?;
/// assert_eq!(drive.length_m(), 30.0);
/// assert_eq!(drive.at_station(12.0).position_m, DVec3::new(12.0, 0.0, 0.0));
/// # Ok::<(), wildcity_scene::trajectory::TrajectoryError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trajectory {
    /// Name within the twin, `[a-z0-9._-]+`.
    pub name: String,
    /// At least one keyframe, with strictly increasing times.
    pub keyframes: Vec<Keyframe>,
}

/// Why a trajectory was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TrajectoryError {
    /// A name is empty, too long, or has other characters than `[a-z0-9._-]`.
    #[error(
        "{name:?} is not a name of a trajectory: a name has 1 to 64 of a-z 0-9 . _ - and does not start with ."
    )]
    Name { name: String },
    /// There are no keyframes.
    #[error("trajectory {name:?} has no keyframes")]
    Empty { name: String },
    /// Times do not increase strictly.
    #[error("keyframes[{index}].time_us is {time_us}, not after the one before it ({before_us})")]
    Time {
        /// Index of the keyframe.
        index: usize,
        /// Its time, in microseconds.
        time_us: i64,
        /// Time of the previous keyframe, in microseconds.
        before_us: i64,
    },
}

impl Trajectory {
    /// Checks name, number and times of the keyframes.
    ///
    /// # Errors
    /// The name is invalid, there are no keyframes, or times do not increase; then the error names
    /// the first keyframe out of order.
    pub fn check(&self) -> Result<(), TrajectoryError> {
        if !is_name(&self.name) {
            return Err(TrajectoryError::Name { name: self.name.clone() });
        }
        if self.keyframes.is_empty() {
            return Err(TrajectoryError::Empty { name: self.name.clone() });
        }
        for (before, pair) in self.keyframes.windows(2).enumerate() {
            if pair[1].time_us <= pair[0].time_us {
                return Err(TrajectoryError::Time {
                    index: before + 1,
                    time_us: pair[1].time_us,
                    before_us: pair[0].time_us,
                });
            }
        }
        Ok(())
    }

    /// Length of the polyline through the keyframes, in metres.
    pub fn length_m(&self) -> f64 {
        self.keyframes.windows(2).map(|pair| segment_m(&pair[0], &pair[1])).sum()
    }

    /// The place of the polyline through the keyframes that is nearest to a point, in metres; the
    /// first of equally near ones.
    pub fn nearest(&self, point_m: DVec3) -> NearestPlace {
        let position_m = |at: usize| self.keyframes[at].world_from_rig.position_m;
        let mut start_m = 0.0;
        let mut nearest =
            NearestPlace { station_m: 0.0, distance_m: position_m(0).distance(point_m) };
        for (from, pair) in self.keyframes.windows(2).enumerate() {
            let along_m = position_m(from + 1) - position_m(from);
            let length_m = segment_m(&pair[0], &pair[1]);
            // A standing vehicle makes segments without a length, which would divide by 0. Their
            // place is the end of the segment before.
            if length_m > 0.0 {
                // Foot of the perpendicular, as a share of the segment.
                let foot = (point_m - position_m(from)).dot(along_m) / along_m.length_squared();
                let share = foot.clamp(0.0, 1.0);
                let distance_m = (position_m(from) + share * along_m).distance(point_m);
                // Strictly nearer, so that the first of equal places stays.
                if distance_m < nearest.distance_m {
                    nearest = NearestPlace { station_m: start_m + share * length_m, distance_m };
                }
            }
            start_m += length_m;
        }
        nearest
    }

    /// The pose at a distance along the trajectory, in metres from its start, clamped to its ends.
    pub fn at_station(&self, station_m: f64) -> Pose {
        let mut start_m = 0.0;
        for pair in self.keyframes.windows(2) {
            // A linear walk over the segments for each call; `Route::at` searches by bisection.
            let length_m = segment_m(&pair[0], &pair[1]);
            // Segments without a length are skipped here, too.
            if length_m > 0.0 && station_m <= start_m + length_m {
                // Before the start, the first pose.
                let t = ((station_m - start_m) / length_m).max(0.0);
                return pair[0].world_from_rig.interpolate(&pair[1].world_from_rig, t);
            }
            start_m += length_m;
        }
        self.keyframes[self.keyframes.len() - 1].world_from_rig
    }
}

/// The place of a trajectory that is nearest to a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NearestPlace {
    /// From the trajectory's start, in metres.
    pub station_m: f64,
    /// From the point, in metres.
    pub distance_m: f64,
}

fn segment_m(from: &Keyframe, to: &Keyframe) -> f64 {
    from.world_from_rig.position_m.distance(to.world_from_rig.position_m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    fn straight() -> Trajectory {
        let keyframe = |i: i64| Keyframe {
            time_us: 100_000 * i,
            world_from_rig: Pose {
                position_m: DVec3::new(0.5 * i as f64, 0.0, 0.0),
                rotation: DQuat::IDENTITY,
            },
        };
        Trajectory { name: "log".into(), keyframes: (0..5).map(keyframe).collect() }
    }

    #[test]
    fn stations_interpolate_and_clamp() {
        let log = straight();
        assert_eq!(log.length_m(), 2.0);
        assert_eq!(log.at_station(0.75).position_m, DVec3::new(0.75, 0.0, 0.0));
        assert_eq!(log.at_station(-3.0).position_m, DVec3::ZERO);
        assert_eq!(log.at_station(9.0).position_m, DVec3::new(2.0, 0.0, 0.0));
    }

    #[test]
    fn the_nearest_place_is_on_a_segment() {
        let log = straight();
        let nearest = log.nearest(DVec3::new(0.75, 3.0, 4.0));
        assert_eq!(nearest, NearestPlace { station_m: 0.75, distance_m: 5.0 });
        let behind = log.nearest(DVec3::new(-2.0, 0.0, 0.0));
        assert_eq!(behind, NearestPlace { station_m: 0.0, distance_m: 2.0 });
        let ahead = log.nearest(DVec3::new(5.0, 0.0, 0.0));
        assert_eq!(ahead, NearestPlace { station_m: 2.0, distance_m: 3.0 });
        let one = Trajectory { keyframes: log.keyframes[..1].to_vec(), ..log };
        assert_eq!(one.nearest(DVec3::Y), NearestPlace { station_m: 0.0, distance_m: 1.0 });
    }

    #[test]
    fn time_must_increase() {
        let mut log = straight();
        assert_eq!(log.check(), Ok(()));
        log.keyframes[3].time_us = 200_000;
        assert!(matches!(log.check(), Err(TrajectoryError::Time { index: 3, .. })));
        assert!(matches!(
            Trajectory { name: "../log".into(), ..straight() }.check(),
            Err(TrajectoryError::Name { .. })
        ));
        log.keyframes.clear();
        assert!(matches!(log.check(), Err(TrajectoryError::Empty { .. })));
    }
}
