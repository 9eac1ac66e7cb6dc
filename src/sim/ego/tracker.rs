//! From where an agent wants to be to what the car is told.

use glam::DVec2;

use crate::limits;

use super::Action;
use super::path::{ReferenceState, ReferenceTrajectory, wrapped};
use super::single_track::SingleTrackState;
use super::vehicle::Vehicle;

/// How stiffly the car is pulled along the path, in 1/s: an error of place and speed decays as
/// `(1 + 2 t) e^(-2 t)`. Ten times slower than the drive's lag allows before it swings.
const PULL_1_S: f64 = 2.0;

/// An error across the path decays over this many seconds of way, ...
const REACH_S: f64 = 0.6;

/// ... and over no less than this, in metres, where the car hardly moves.
const REACH_M: f64 = 4.0;

/// Below this speed, in m/s, a path that turns is taken to be noise and not a curve.
const TURNS_M_S: f64 = 0.1;

/// Acceleration and curvature for a car at a time of the path, in seconds. What comes late by `lag_s` is
/// asked for as much earlier.
///
/// Linear in the errors, with what the path itself needs ahead of them: along it
/// `a = a* + 4 (v* - v) + 4 Δs`, across it `κ = κ* + Δy / l² + 2 Δψ / l`, whose errors decay as
/// `(1 + s / l) e^(-s / l)` over the way s; Δψ is to where the car goes, not to where it heads. Both are cut to
/// what an action may be.
pub(super) fn track(
    reference: &ReferenceTrajectory,
    time_s: f64,
    lag_s: f64,
    car: &SingleTrackState,
) -> Action {
    let (now, soon) = (reference.at(time_s), reference.at(time_s + lag_s));
    let ahead_m = DVec2::from_angle(-now.yaw_rad).rotate(now.position_m - car.position_m);
    let off_rad = wrapped(now.yaw_rad - car.yaw_rad - drift_rad(car));
    let acceleration_m_s2 = soon.acceleration_m_s2
        + 2.0 * PULL_1_S * (now.speed_m_s - car.speed_m_s)
        + PULL_1_S * PULL_1_S * ahead_m.x;
    let reach_m = (REACH_S * car.speed_m_s.abs()).max(REACH_M);
    // Backwards, turning left moves the rear to the right.
    let curvature_1_m = curvature(&soon)
        + ahead_m.y / (reach_m * reach_m)
        + 2.0 * off_rad / reach_m * direction(car.speed_m_s, now.speed_m_s);
    let (most_m_s2, most_1_m) = (limits::EGO_ACCELERATION_M_S2, limits::EGO_CURVATURE_1_M);
    Action {
        acceleration_m_s2: acceleration_m_s2.clamp(-most_m_s2, most_m_s2),
        curvature_1_m: curvature_1_m.clamp(-most_1_m, most_1_m),
    }
}

fn curvature(wanted: &ReferenceState) -> f64 {
    if wanted.speed_m_s.abs() < TURNS_M_S { 0.0 } else { wanted.yaw_rate_rad_s / wanted.speed_m_s }
}

/// By how much the car moves to the left of its heading, in radians: in a turn its rear axle slips.
fn drift_rad(car: &SingleTrackState) -> f64 {
    let rear_m_s = car.lateral_m_s - Vehicle::DEFAULT.rear_to_cg_m * car.yaw_rate_rad_s;
    if car.speed_m_s.abs() < TURNS_M_S { 0.0 } else { (rear_m_s / car.speed_m_s).atan() }
}

/// Which way the car goes; at rest, which way it is to go.
fn direction(speed_m_s: f64, wanted_m_s: f64) -> f64 {
    let speed_m_s = if speed_m_s == 0.0 { wanted_m_s } else { speed_m_s };
    if speed_m_s < 0.0 { -1.0 } else { 1.0 }
}
