//! Plans of the agent, as scores need them.

use std::f64::consts::TAU;

use glam::DVec2;

/// The pose of a plan at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlannedPose {
    /// The time, in microseconds since the start of the episode.
    pub time_us: i64,
    /// The rear axle, in metres.
    pub origin_m: DVec2,
    /// The heading, in radians.
    pub yaw_rad: f64,
}

/// The plan of the agent at a decision: the ego's pose at that time and future poses, in order of
/// time.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    poses: Vec<PlannedPose>,
}

impl Plan {
    /// A plan; `None` without a pose after the ego's own, or if times do not rise.
    pub fn new(poses: Vec<PlannedPose>) -> Option<Self> {
        // Rising times make the interpolation below safe: no interval has a length of 0.
        let rises = poses.windows(2).all(|pair| pair[0].time_us < pair[1].time_us);
        (poses.len() > 1 && rises).then_some(Self { poses })
    }

    /// When it was decided, in microseconds.
    pub fn decided_us(&self) -> i64 {
        self.poses[0].time_us
    }

    /// When it ends, in microseconds.
    pub fn end_us(&self) -> i64 {
        self.poses[self.poses.len() - 1].time_us
    }

    /// The poses after the first one, which is that of the decision.
    pub fn future(&self) -> &[PlannedPose] {
        &self.poses[1..]
    }

    /// The pose at a time, between two of its poses: along a line, and the shorter way round;
    /// `None` before its first and after its last.
    pub fn at(&self, time_us: i64) -> Option<PlannedPose> {
        // The first pose at or after the time.
        let after = self.poses.partition_point(|pose| pose.time_us < time_us);
        let to = self.poses.get(after)?;
        if to.time_us == time_us {
            return Some(*to);
        }
        let from = self.poses[after.checked_sub(1)?];
        let t = (time_us - from.time_us) as f64 / (to.time_us - from.time_us) as f64;
        Some(PlannedPose {
            time_us,
            origin_m: from.origin_m.lerp(to.origin_m, t),
            yaw_rad: from.yaw_rad + t * turn_rad(from.yaw_rad, to.yaw_rad),
        })
    }
}

/// The shorter turn from one heading to another, in radians.
pub(crate) fn turn_rad(from_rad: f64, to_rad: f64) -> f64 {
    let turn = to_rad - from_rad;
    // The nearest multiple of a full turn is taken out: the result is from -π to π.
    turn - TAU * (turn / TAU).round()
}
