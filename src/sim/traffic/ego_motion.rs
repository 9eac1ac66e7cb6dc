//! The ego's motion during one step of the traffic.

use super::state::EgoState;
use crate::limits;
use crate::{DynamicsModel, Ego};

/// The ego's motion during one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgoMotion {
    /// At the start of the step.
    pub from: EgoState,
    /// At the end of the step.
    pub to: EgoState,
    /// Whether the velocities of both states belong to the motion between them. Then the position
    /// is the cubic with these ends. Otherwise, as for a teleport, it changes linearly.
    pub smooth: bool,
}

impl EgoMotion {
    /// The motion of an ego from a state to its present one.
    pub fn new(from: EgoState, to: &Ego) -> Self {
        let smooth = to.dynamics().model != DynamicsModel::Teleport;
        Self { from, to: EgoState::new(to), smooth }
    }

    /// An ego that stands.
    pub fn standing(state: EgoState) -> Self {
        Self { from: state, to: state, smooth: false }
    }

    /// Length of the straight line between its ends over the time of a step of `dt_us`, in m/s.
    pub fn mean_speed_mps(&self, dt_us: i64) -> f64 {
        let way_m = self.from.world_from_rig.position_m.distance(self.to.world_from_rig.position_m);
        way_m / (dt_us as f64 * 1e-6)
    }

    /// The ends of the sub-steps of a step of `dt_us`, above 0: the time since the start of the
    /// step, in microseconds, and the ego then.
    pub fn sub_steps(&self, dt_us: i64) -> impl Iterator<Item = (i64, EgoState)> {
        // At least one sub-step, so that the end of the step is always reached.
        let count = dt_us.max(1).unsigned_abs().div_ceil(limits::SUB_STEP_US.unsigned_abs()) as i64;
        (1..=count).map(move |sub_step| {
            // i128, since the product may overflow i64.
            let since_us = (i128::from(dt_us) * i128::from(sub_step) / i128::from(count)) as i64;
            (since_us, self.at(since_us, dt_us))
        })
    }

    /// The ego at a time of a step of `dt_us`.
    pub fn at(&self, since_us: i64, dt_us: i64) -> EgoState {
        // Exact for an ego that stands: interpolation could round.
        if since_us <= 0 || self.from == self.to {
            return self.from;
        }
        if since_us >= dt_us {
            return self.to;
        }
        // Both ends are excluded above, so that 0 < t < 1.
        let t = since_us as f64 / dt_us as f64;
        let from = &self.from;
        let to = &self.to;
        let mut pose = from.world_from_rig.interpolate(&to.world_from_rig, t);
        if self.smooth {
            let dt_s = dt_us as f64 * 1e-6;
            // Hermite's cubic: the ends' positions and velocities. On an arc its error is
            // (v dt)⁴ κ³ / 384: 0.1 mm at 10 m/s, 0.5 s and 0.05 1/m.
            pose.position_m =
                (1.0 + 2.0 * t) * (1.0 - t) * (1.0 - t) * from.world_from_rig.position_m
                    + t * t * (3.0 - 2.0 * t) * to.world_from_rig.position_m
                    + dt_s * t * (1.0 - t) * (1.0 - t) * from.velocity_mps
                    - dt_s * t * t * (1.0 - t) * to.velocity_mps;
        }
        // A teleport has one velocity, the mean over the step, so nothing is interpolated.
        let velocity_mps =
            if self.smooth { from.velocity_mps.lerp(to.velocity_mps, t) } else { to.velocity_mps };
        let yaw_rate_radps = if self.smooth {
            from.yaw_rate_radps + t * (to.yaw_rate_radps - from.yaw_rate_radps)
        } else {
            to.yaw_rate_radps
        };
        EgoState { world_from_rig: pose, velocity_mps, yaw_rate_radps }
    }
}
