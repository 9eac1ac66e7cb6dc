//! A trajectory that an agent sends to be followed: timed poses, and the reference that the tracker
//! derives.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::limits;
use wildcity_scene::geometry::{Pose, PoseError};

use super::EgoError;

/// A pose at a time. In records it is a row: time, position, rotation (w, x, y, z).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(into = "Row", try_from = "RowOrNamed")]
pub struct TimedPose {
    /// Time since the step's start, in microseconds.
    pub time_us: i64,
    /// `rig(start)_from_rig`: the pose in the frame of the rig at the start of the step.
    pub start_from_rig: Pose,
}

#[derive(Serialize, Deserialize)]
struct Row(i64, [f64; 3], [f64; 4]);

/// Earlier builds wrote a name for each field: a quarter of a record with plans.
#[derive(Deserialize)]
#[serde(untagged, deny_unknown_fields)]
enum RowOrNamed {
    Row(Row),
    Named { time_us: i64, start_from_rig: Pose },
}

impl From<TimedPose> for Row {
    fn from(timed: TimedPose) -> Self {
        let TimedPose { time_us, start_from_rig } = timed;
        Self(time_us, start_from_rig.position_m.to_array(), start_from_rig.q_wxyz())
    }
}

impl TryFrom<RowOrNamed> for TimedPose {
    type Error = PoseError;

    fn try_from(read: RowOrNamed) -> Result<Self, PoseError> {
        Ok(match read {
            RowOrNamed::Row(Row(time_us, xyz_m, q_wxyz)) => {
                Self { time_us, start_from_rig: Pose::checked(xyz_m, q_wxyz)? }
            }
            RowOrNamed::Named { time_us, start_from_rig } => Self { time_us, start_from_rig },
        })
    }
}

/// 1 to [`limits::PATH_POSES`] poses in order of time. The trajectory starts at time 0 at the pose
/// of the rig.
#[derive(Clone, Debug, PartialEq)]
pub struct Path {
    poses: Vec<TimedPose>,
}

/// The reference at a time, in the plane of the rig at the start of the step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ReferenceState {
    pub(super) position_m: DVec2,
    pub(super) yaw_rad: f64,
    /// Speed along the heading, in m/s; below 0 backwards.
    pub(super) speed_m_s: f64,
    /// Acceleration along the heading, in m/s².
    pub(super) acceleration_m_s2: f64,
    /// Yaw rate, in rad/s.
    pub(super) yaw_rate_rad_s: f64,
}

/// The poses of a path projected to the plane, with speeds, accelerations and yaw rates from finite
/// differences.
#[derive(Debug)]
pub(super) struct ReferenceTrajectory {
    /// Times in seconds, and the reference then.
    knots: Vec<(f64, ReferenceState)>,
}

impl Path {
    /// A path from untrusted input.
    ///
    /// # Errors
    /// There are no poses or too many, or their times do not increase strictly from above 0 to at
    /// most [`limits::PATH_US`].
    pub fn checked(poses: Vec<TimedPose>) -> Result<Self, EgoError> {
        if !(1..=limits::PATH_POSES).contains(&poses.len()) {
            return Err(EgoError::PathCount { count: poses.len(), limit: limits::PATH_POSES });
        }
        let mut before_us = 0;
        for (index, pose) in poses.iter().enumerate() {
            let time_us = pose.time_us;
            // This form also refuses a negative time, since the first bound is 0.
            if time_us <= before_us || time_us > limits::PATH_US {
                let limit_us = limits::PATH_US;
                return Err(EgoError::PathTime { index, time_us, before_us, limit_us });
            }
            before_us = time_us;
        }
        Ok(Self { poses })
    }

    /// The poses relative to the start, by rising time.
    pub fn poses(&self) -> &[TimedPose] {
        &self.poses
    }

    /// Time of the last pose, in microseconds.
    pub fn end_us(&self) -> i64 {
        self.poses.last().map_or(0, |pose| pose.time_us)
    }

    /// `rig(start)_from_rig` at a time within the path, interpolated between its poses.
    pub(super) fn at(&self, time_us: i64) -> Pose {
        let mut before = TimedPose { time_us: 0, start_from_rig: Pose::IDENTITY };
        // Linear, because a path has at most 64 poses.
        for pose in &self.poses {
            if time_us <= pose.time_us {
                let t = (time_us - before.time_us) as f64 / (pose.time_us - before.time_us) as f64;
                // An exact pose at its time: interpolation would normalise the rotation and change
                // its last bits.
                return if pose.time_us == time_us {
                    pose.start_from_rig
                } else {
                    before.start_from_rig.interpolate(&pose.start_from_rig, t)
                };
            }
            before = *pose;
        }
        // Beyond the end the last pose holds. Callers check the end of the path first.
        before.start_from_rig
    }

    /// The reference in the plane, from the path's own poses. The rig's present pose is added only
    /// if the path has a single pose. Otherwise a rig that lags behind would get a reference that
    /// starts fast and brakes.
    pub(super) fn reference(&self) -> ReferenceTrajectory {
        let origin = TimedPose { time_us: 0, start_from_rig: Pose::IDENTITY };
        let start = (self.poses.len() == 1).then_some(origin);
        let places: Vec<(f64, DVec2, f64)> = start
            .iter()
            .chain(&self.poses)
            .map(|pose| {
                let forward = pose.start_from_rig.rotation * DVec3::X;
                let position_m = pose.start_from_rig.position_m.truncate();
                (pose.time_us as f64 * 1e-6, position_m, forward.y.atan2(forward.x))
            })
            .collect();
        // `checked` refuses an empty path, and a single pose has the start before it: there are at
        // least two places.
        let last = places.len() - 1;
        // Central differences at each pose; one-sided at the ends.
        let moved = |k: usize| {
            let from = places[k.saturating_sub(1)];
            let to = places[(k + 1).min(last)];
            let way_m = to.1 - from.1;
            let seconds = to.0 - from.0;
            // The projection on the heading gives the sign: a way against the heading is driving
            // backwards.
            let speed_m_s = way_m.dot(DVec2::from_angle(places[k].2)) / seconds;
            (speed_m_s, wrapped(to.2 - from.2) / seconds)
        };
        let moves: Vec<(f64, f64)> = (0..places.len()).map(moved).collect();
        // Speeds are complete at this point, so accelerations are their differences, in the same
        // way.
        let knot = |k: usize| {
            let from = k.saturating_sub(1);
            let to = (k + 1).min(last);
            let (time_s, position_m, yaw_rad) = places[k];
            let (speed_m_s, yaw_rate_rad_s) = moves[k];
            let acceleration_m_s2 = (moves[to].0 - moves[from].0) / (places[to].0 - places[from].0);
            (
                time_s,
                ReferenceState {
                    position_m,
                    yaw_rad,
                    speed_m_s,
                    acceleration_m_s2,
                    yaw_rate_rad_s,
                },
            )
        };
        ReferenceTrajectory { knots: (0..places.len()).map(knot).collect() }
    }
}

impl ReferenceTrajectory {
    /// The reference at a time in seconds: interpolated; before the first pose extrapolated
    /// backwards; after the last pose that of the last.
    pub(super) fn at(&self, time_s: f64) -> ReferenceState {
        // The first knot that is not before the time. `after` is at least 1 in the next line,
        // because the knots are not empty.
        let after = self.knots.partition_point(|(knot_s, _)| *knot_s < time_s);
        let Some((to_s, to)) = self.knots.get(after) else { return self.knots[after - 1].1 };
        let Some((from_s, from)) = after.checked_sub(1).map(|before| &self.knots[before]) else {
            return to.before(to_s - time_s);
        };
        let t = (time_s - from_s) / (to_s - from_s);
        let between = |from: f64, to: f64| from + t * (to - from);
        ReferenceState {
            position_m: from.position_m.lerp(to.position_m, t),
            // The short way around: headings of neighbours may lie on both sides of ±π.
            yaw_rad: from.yaw_rad + t * wrapped(to.yaw_rad - from.yaw_rad),
            speed_m_s: between(from.speed_m_s, to.speed_m_s),
            acceleration_m_s2: between(from.acceleration_m_s2, to.acceleration_m_s2),
            yaw_rate_rad_s: between(from.yaw_rate_rad_s, to.yaw_rate_rad_s),
        }
    }
}

impl ReferenceState {
    /// Extrapolates this state to some seconds earlier, with constant acceleration and yaw rate.
    fn before(&self, seconds: f64) -> Self {
        let speed_m_s = self.speed_m_s - seconds * self.acceleration_m_s2;
        let yaw_rad = self.yaw_rad - seconds * self.yaw_rate_rad_s;
        let way_m = seconds * 0.5 * (speed_m_s + self.speed_m_s);
        // The chord of the arc has the mean of both headings, as in `kinematic::arc`.
        let between = DVec2::from_angle(0.5 * (yaw_rad + self.yaw_rad));
        Self { position_m: self.position_m - way_m * between, yaw_rad, speed_m_s, ..*self }
    }
}

/// The angle wrapped to -π to π, in radians.
pub(super) fn wrapped(angle_rad: f64) -> f64 {
    let turns = (angle_rad / std::f64::consts::TAU).round();
    angle_rad - turns * std::f64::consts::TAU
}
