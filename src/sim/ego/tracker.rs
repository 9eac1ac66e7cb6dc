//! A linear tracking controller: from a reference trajectory to acceleration and curvature.

use glam::DVec2;

use crate::limits;

use super::Action;
use super::path::{ReferenceState, ReferenceTrajectory, wrapped};
use super::single_track::SingleTrackState;
use super::vehicle::Vehicle;

/// Longitudinal gain, in 1/s: an error of position and speed decays as `(1 + 2 t) e^(-2 t)`. This
/// is ten times slower than what the drive's lag allows before the loop oscillates.
const LONGITUDINAL_GAIN_1_S: f64 = 2.0;

/// Length over which a lateral error decays, in seconds of driving at the present speed, but at
/// least [`LATERAL_DECAY_M`].
const LATERAL_DECAY_S: f64 = 0.6;

/// Smallest length over which a lateral error decays, in metres; it applies at low speed.
const LATERAL_DECAY_M: f64 = 4.0;

/// Below this speed, in m/s, changes of the reference's heading count as noise and not as a curve.
const MIN_CURVE_SPEED_M_S: f64 = 0.1;

/// Acceleration and curvature for a car at a time of the reference, in seconds. The feedforward
/// part is taken `lag_s` ahead, to compensate the actuators' lag.
///
/// Feedforward of the reference plus linear feedback. Along the path `a = a* + 4 (v* - v) + 4 Δs`;
/// across it `κ = κ* + Δy / l² + 2 Δψ / l`, whose errors decay as `(1 + s / l) e^(-s / l)` over the
/// distance s. Δψ is measured against the direction of motion and not against the heading, since
/// the car drifts. Both results are clamped to the range of an action.
pub(super) fn track(
    reference: &ReferenceTrajectory,
    time_s: f64,
    lag_s: f64,
    car: &SingleTrackState,
) -> Action {
    let now = reference.at(time_s);
    let soon = reference.at(time_s + lag_s);
    // In the axes of the reference: x is how far the reference is ahead, y how far it is to the
    // left.
    let ahead_m = DVec2::from_angle(-now.yaw_rad).rotate(now.position_m - car.position_m);
    let off_rad = wrapped(now.yaw_rad - car.yaw_rad - drift_rad(car));
    // Critically damped with gain k: `2 k` of the speed's error and `k²` of the position's.
    let acceleration_m_s2 = soon.acceleration_m_s2
        + 2.0 * LONGITUDINAL_GAIN_1_S * (now.speed_m_s - car.speed_m_s)
        + LONGITUDINAL_GAIN_1_S * LONGITUDINAL_GAIN_1_S * ahead_m.x;
    // The decay length grows with speed, so that a correction lasts a constant time; at low speed
    // it would steer too sharply.
    let decay_m = (LATERAL_DECAY_S * car.speed_m_s.abs()).max(LATERAL_DECAY_M);
    // When driving backwards, turning left moves the rear to the right.
    let curvature_1_m = curvature(&soon)
        + ahead_m.y / (decay_m * decay_m)
        + 2.0 * off_rad / decay_m * direction(car.speed_m_s, now.speed_m_s);
    // The clamp of the result and not of its parts: feedforward and feedback may cancel.
    let most_m_s2 = limits::EGO_ACCELERATION_M_S2;
    let most_1_m = limits::EGO_CURVATURE_1_M;
    Action {
        acceleration_m_s2: acceleration_m_s2.clamp(-most_m_s2, most_m_s2),
        curvature_1_m: curvature_1_m.clamp(-most_1_m, most_1_m),
    }
}

fn curvature(wanted: &ReferenceState) -> f64 {
    // Dividing by a speed near zero would turn jitter of the heading into the sharpest curve.
    if wanted.speed_m_s.abs() < MIN_CURVE_SPEED_M_S {
        0.0
    } else {
        wanted.yaw_rate_rad_s / wanted.speed_m_s
    }
}

/// Slip angle of the rear axle, in radians: direction of motion minus heading, positive to the
/// left.
fn drift_rad(car: &SingleTrackState) -> f64 {
    let rear_m_s = car.lateral_m_s - Vehicle::DEFAULT.rear_to_cg_m * car.yaw_rate_rad_s;
    // At low speed the quotient is noise as well, and a car that rolls does not drift.
    if car.speed_m_s.abs() < MIN_CURVE_SPEED_M_S { 0.0 } else { (rear_m_s / car.speed_m_s).atan() }
}

/// Direction of motion, 1 or -1; at rest that of the reference.
fn direction(speed_m_s: f64, wanted_m_s: f64) -> f64 {
    let speed_m_s = if speed_m_s == 0.0 { wanted_m_s } else { speed_m_s };
    if speed_m_s < 0.0 { -1.0 } else { 1.0 }
}
