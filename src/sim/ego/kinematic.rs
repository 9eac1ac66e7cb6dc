//! One step of the kinematic model: an exact circular arc.

use glam::DVec2;

use super::Action;
use super::single_track::SingleTrackState;
use super::speed::Drive;
use super::vehicle::Vehicle;

/// The state after a step of constant acceleration and curvature, which apply without lag. The
/// speed stays within `bounds_m_s`, which must contain 0. The car rolls without slip.
pub(super) fn rolled(
    from: &SingleTrackState,
    car: &Vehicle,
    action: Action,
    step_s: f64,
    bounds_m_s: [f64; 2],
) -> SingleTrackState {
    let Action { acceleration_m_s2, curvature_1_m } = action;
    // A drive that already delivers its setpoint is not affected by the lag.
    let drive = Drive {
        speed_m_s: from.speed_m_s,
        acceleration_m_s2,
        target_m_s2: acceleration_m_s2,
        lag_s: car.lag_s,
    };
    let (phases, _) = drive.phases(step_s, bounds_m_s);
    let mean = |from_m_s: f64, to_m_s: f64| 0.5 * (from_m_s + to_m_s);
    let length_m: f64 = phases
        .iter()
        .map(|phase| phase.duration_s * mean(phase.drive.speed_m_s, phase.end_m_s))
        .sum();
    let speed_m_s = phases.last().map_or(from.speed_m_s, |phase| phase.end_m_s);
    let (way_m, turned_rad) = arc(length_m, curvature_1_m);
    let yaw_rate_rad_s = speed_m_s * curvature_1_m;
    SingleTrackState {
        position_m: from.position_m + DVec2::from_angle(from.yaw_rad).rotate(way_m),
        yaw_rad: from.yaw_rad + turned_rad,
        speed_m_s,
        // As in the dynamic model: the rear axle rolls without slip, so the centre of gravity moves
        // sideways by yaw rate times distance.
        lateral_m_s: yaw_rate_rad_s * car.rear_to_cg_m,
        yaw_rate_rad_s,
        steering_rad: (curvature_1_m * car.wheelbase_m).atan(),
        acceleration_m_s2,
    }
}

/// Displacement along an arc in the frame of its start (metres, x forward and y left), and the
/// change of heading, in radians: `(sin(κ s) / κ, (1 - cos(κ s)) / κ)`, computed as a chord at half
/// the angle, which avoids 0 / 0.
pub(super) fn arc(length_m: f64, curvature_1_m: f64) -> (DVec2, f64) {
    let half = 0.5 * length_m * curvature_1_m;
    let chord_m = if half.abs() < 1e-4 {
        // sin h / h = 1 - h²/6 with an error below 1e-18.
        length_m * (1.0 - half * half / 6.0)
    } else {
        length_m * half.sin() / half
    };
    // The chord of an arc leaves at half the angle of the turn.
    (chord_m * DVec2::from_angle(half), 2.0 * half)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arcs_are_arcs() {
        // The last length and curvature give a half angle of 9.95e-5, within the series.
        for (length_m, curvature) in [(3.0, 0.2), (-3.0, 0.2), (6.0, -1e-3), (1.0, 1.99e-4)] {
            let (way_m, turned) = arc(length_m, curvature);
            let angle: f64 = length_m * curvature;
            // 1 - cos as 2 sin², which does not cancel.
            let aside = 2.0 * (0.5 * angle).sin().powi(2) / curvature;
            assert!((way_m - DVec2::new(angle.sin() / curvature, aside)).length() < 1e-12);
            assert!((turned - angle).abs() < 1e-15);
        }
        assert_eq!(arc(2.0, 0.0), (DVec2::new(2.0, 0.0), 0.0));
        assert_eq!(arc(0.0, 0.2), (DVec2::ZERO, 0.0));
    }
}
