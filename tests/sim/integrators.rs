//! The dynamic single track against an implicit solver that knows nothing of how it is integrated.

use differential_equations::prelude::*;
use glam::DVec2;
use wildcity_sim::ego::{Setpoint, SingleTrackState, Vehicle};

/// Newton's law for linear tyres, wheel by wheel, as a differential equation of
/// (x, y, yaw, speed, lateral, yaw rate, steering, acceleration).
pub(crate) struct Law {
    pub(crate) told: Setpoint,
}

impl ODE<f64, [f64; 8]> for Law {
    fn diff(&self, _: f64, state: &[f64; 8], rate: &mut [f64; 8]) {
        *rate = self.rate(state);
    }
}

impl Law {
    /// How the state changes per second.
    pub(crate) fn rate(&self, state: &[f64; 8]) -> [f64; 8] {
        let car = Vehicle::DEFAULT;
        let [_, _, yaw, speed, lateral, yaw_rate, steering, acceleration] = *state;
        let to_front_m = car.wheelbase_m - car.rear_to_cg_m;
        let slip = |velocity: f64| velocity / speed.abs();
        let front =
            -2.0 * car.front_wheel_n_rad * slip(lateral + to_front_m * yaw_rate - speed * steering);
        let rear = -2.0 * car.rear_wheel_n_rad * slip(lateral - car.rear_to_cg_m * yaw_rate);
        let rear_m_s = lateral - car.rear_to_cg_m * yaw_rate;
        [
            speed * yaw.cos() - rear_m_s * yaw.sin(),
            speed * yaw.sin() + rear_m_s * yaw.cos(),
            yaw_rate,
            acceleration,
            (front + rear) / car.mass_kg - speed * yaw_rate,
            (to_front_m * front - car.rear_to_cg_m * rear) / car.inertia_kg_m2,
            (self.told.steering_rad - steering) / car.lag_s,
            (self.told.acceleration_m_s2 - acceleration) / car.lag_s,
        ]
    }
}

/// The car after a step at one speed or another, but not through standstill, where the law divides
/// by 0.
pub(crate) fn reference(from: &SingleTrackState, told: Setpoint, step_s: f64) -> SingleTrackState {
    // Its order is 5: a thousand steps leave 1e-14. Its own control of the error, which takes a
    // relative tolerance to the power of 2/3, left 1e-7.
    let method = ImplicitRungeKutta::radau5()
        .rtol(1e-13)
        .atol(1e-18)
        .newton_tol(1e-8)
        .h_max(1e-3 * step_s)
        .max_steps(1_000_000);
    let law = Law { told };
    let solved = IVP::ode(&law, 0.0, step_s, packed(from)).method(method).solve();
    unpacked(*solved.expect("a solution").y.last().expect("an end"))
}

pub(crate) fn packed(car: &SingleTrackState) -> [f64; 8] {
    [
        car.position_m.x,
        car.position_m.y,
        car.yaw_rad,
        car.speed_m_s,
        car.lateral_m_s,
        car.yaw_rate_rad_s,
        car.steering_rad,
        car.acceleration_m_s2,
    ]
}

pub(crate) fn unpacked(state: [f64; 8]) -> SingleTrackState {
    let [x, y, yaw_rad, speed_m_s, lateral_m_s, yaw_rate_rad_s, steering_rad, acceleration_m_s2] =
        state;
    SingleTrackState {
        position_m: DVec2::new(x, y),
        yaw_rad,
        speed_m_s,
        lateral_m_s,
        yaw_rate_rad_s,
        steering_rad,
        acceleration_m_s2,
    }
}

/// The largest difference, in m, rad, m/s, rad/s.
fn difference(a: &SingleTrackState, b: &SingleTrackState) -> f64 {
    let parts = packed(a).into_iter().zip(packed(b));
    parts.fold(0.0, |worst, (a, b)| worst.max((a - b).abs()))
}

const SPEEDS_M_S: [f64; 14] =
    [0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 5.0, 10.0, 13.34, 20.0, 40.0, 60.0];

/// A second of it: steering out and back, as an agent does.
fn second(from: SingleTrackState, accelerations_m_s2: [f64; 2], bounds: [f64; 2]) -> f64 {
    let (mut car, mut worst) = (from, 0.0f64);
    for step in 0..10 {
        let steering_rad = [0.05, -0.03][step / 5];
        let told = Setpoint { acceleration_m_s2: accelerations_m_s2[step / 5], steering_rad };
        let next = car.after(&Vehicle::DEFAULT, told, 0.1, bounds);
        worst = worst.max(difference(&next, &reference(&car, told, 0.1)));
        car = next;
    }
    worst
}

#[test]
fn constant_speed_is_exact() {
    for speed_m_s in SPEEDS_M_S.into_iter().chain([-0.001, -0.1, -1.0, -5.0, -10.0]) {
        let car = SingleTrackState { speed_m_s, ..SingleTrackState::default() };
        let error = second(car, [0.0; 2], [-10.0, 60.0]);
        assert!(error < 1e-9, "{speed_m_s} m/s: {error}");
    }
}

#[test]
fn changing_speed_is_as_good() {
    let forwards = SPEEDS_M_S.map(|speed| (speed, vec![[3.0, 9.8], [0.0, 1e-6], [8.0, -6.0]]));
    let backwards = [-0.001, -0.1, -5.0].map(|speed| (speed, vec![[-2.0, -4.0]]));
    for (speed_m_s, pairs) in forwards.into_iter().chain(backwards) {
        for accelerations in pairs {
            let car = SingleTrackState { speed_m_s, ..SingleTrackState::default() };
            let error = second(car, accelerations, [-100.0, 200.0]);
            assert!(error < 1e-9, "{speed_m_s} m/s, {accelerations:?}: {error}");
        }
    }
}
