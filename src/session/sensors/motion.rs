//! Samples of the inertial measurement unit and of the wheel speed sensor.
//!
//! There is a sample for each step, at its end. With the rig's rotation R (world from rig), its
//! acceleration a in world axes and gravity g = 9.80665 m/s² (ISO 80000-3), at a step of Δt:
//!
//! ```text
//! specific force    f = R⁻¹ (a + g ẑ) + σ n + β(t)      m/s², in the axes of the rig: (0, 0, g) at rest
//! angular velocity  ω = log(R₀⁻¹ R) / Δt + σ n + β(t)   rad/s, R₀ that of the previous step
//! speed             v = (1 + s) v_x + σ n               m/s along the rig, at the rear axle
//! ```
//!
//! The samples n are standard normal and independent, the biases β [drift](super::draw::drift), and
//! s is sampled once per episode. The terms are those of IEEE Std 952 (angle random walk and bias
//! instability), with a bias of a bounded variance.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use wildcity_scene::random::Random;
use wildcity_sim::Ego;

use super::draw::{drift, standard_normal};
use wildcity_options::{AxisNoise, Imu, WheelSpeed};

use super::settings::{axes, bias_period_us};

/// Standard gravity, in m/s².
const GRAVITY_M_S2: f64 = 9.806_65;

/// The motion of a step, without errors.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MotionSample {
    /// The end of the step, in microseconds since the episode's start.
    time_us: i64,
    /// In the axes of the rig, in m/s².
    specific_force: DVec3,
    /// In the axes of the rig, in rad/s.
    angular_velocity: DVec3,
    /// Along the rig, in m/s.
    speed: f64,
}

impl MotionSample {
    /// The sample of a step of `dt_us` from one state to another. At the start of an episode there
    /// is no step, and both are equal.
    pub(crate) fn new(from: &Ego, to: &Ego, dt_us: i64, time_us: i64) -> Self {
        let rig_from_world = to.world_from_rig().rotation.inverse();
        // Products of unit quaternions are only nearly of unit length.
        let turn =
            (from.world_from_rig().rotation.inverse() * to.world_from_rig().rotation).normalize();
        // The shorter of the two ways to turn.
        let turned = if turn.w < 0.0 { -turn } else { turn };
        Self {
            time_us,
            specific_force: rig_from_world * (to.acceleration_m_s2() + GRAVITY_M_S2 * DVec3::Z),
            angular_velocity: turned.to_scaled_axis() / (dt_us as f64 * 1e-6),
            speed: (rig_from_world * to.velocity_m_s()).x,
        }
    }

    /// The sample of the unit: specific force and angular velocity.
    pub(crate) fn imu(&self, imu: &Imu, seed: u64) -> [f32; 6] {
        // Each step has a time of its own, and so noise of its own.
        let mut random = Random::new(seed, "imu/noise", self.time_us as usize);
        // One stream for all axes: they are drawn in order.
        let mut axis = |index: usize| {
            let AxisNoise { noise, bias } = axes(imu)[index / 3];
            let ideal = match index {
                0..3 => self.specific_force[index],
                _ => self.angular_velocity[index - 3],
            };
            // Each name is a stream of its own. Two axes of one name would drift alike.
            let suffix = ["x", "y", "z", "r", "p", "yaw"][index];
            let name = format!("imu/bias/{suffix}");
            let drifted = drift(seed, &name, bias_period_us(imu), self.time_us);
            (ideal + noise * standard_normal(&mut random) + bias * drifted) as f32
        };
        std::array::from_fn(&mut axis)
    }

    /// The sample of the wheel speed.
    pub(crate) fn wheel_speed(&self, wheels: &WheelSpeed, seed: u64) -> f32 {
        // Without the time: one value for the whole episode.
        let scale = standard_normal(&mut Random::new(seed, "wheels/scale", 0));
        let mut random = Random::new(seed, "wheels/noise", self.time_us as usize);
        let WheelSpeed { noise, scale: deviation } = wheels;
        (self.speed * (1.0 + deviation * scale) + noise * standard_normal(&mut random)) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use wildcity_scene::geometry::Pose;
    use wildcity_sim::{Command, Dynamics, DynamicsModel, Ground};

    const DT_US: i64 = 50_000;

    fn exact() -> Imu {
        Imu { accelerometer: None, gyroscope: None, bias_period_us: Some(1_000_000) }
    }

    #[test]
    fn a_car_in_a_curve_feels_gravity_and_the_centripetal_force() {
        let dynamics = Dynamics::checked(DynamicsModel::Kinematic, 10.0, false).unwrap();
        let ground = Ground::from_drives(&[]);
        let action = wildcity_sim::ego::Action::checked(0.0, 0.05).unwrap();
        let start = Pose { rotation: DQuat::from_rotation_z(0.7), ..Pose::IDENTITY };
        let mut from = Ego::new(dynamics, start);
        let rest = MotionSample::new(&from, &from, DT_US, 0);
        assert_eq!(rest.imu(&exact(), 1)[5], 0.0);
        for _ in 0..5 {
            let to = from.stepped(&Command::Action(action), DT_US, &ground).unwrap();
            let [fx, fy, fz, wx, wy, wz] = MotionSample::new(&from, &to, DT_US, 0).imu(&exact(), 1);
            // v² κ = 5 m/s² to the left, v κ = 0.5 rad/s; the mean over a step of 0.025 rad turns
            // it by half of that.
            assert!((fy - 5.0).abs() < 2e-3 && (fx - 5.0 * 0.0125).abs() < 2e-3, "{fx} {fy}");
            assert!((fz - 9.80665).abs() < 1e-5 && (wz - 0.5).abs() < 1e-6, "{fz} {wz}");
            assert!(wx.abs() < 1e-9 && wy.abs() < 1e-9);
            let speed = MotionSample::new(&from, &to, DT_US, 0)
                .wheel_speed(&WheelSpeed { noise: 0.0, scale: 0.0 }, 1);
            assert!((speed - 10.0).abs() < 1e-5, "{speed}");
            from = to;
        }
    }

    #[test]
    fn a_slope_tilts_gravity() {
        let up = Pose { rotation: DQuat::from_rotation_y(-0.1), ..Pose::IDENTITY };
        let ego = Ego::new(Dynamics::default(), up);
        let [fx, fy, fz, ..] = MotionSample::new(&ego, &ego, DT_US, 0).imu(&exact(), 1);
        // The front is up by 0.1 rad: what holds the car against gravity points forward in part.
        let expected = [9.80665 * 0.1_f64.sin(), 0.0, 9.80665 * 0.1_f64.cos()];
        for (measured, expected) in [fx, fy, fz].into_iter().zip(expected) {
            assert!((f64::from(measured) - expected).abs() < 1e-5, "{measured} {expected}");
        }
    }

    #[test]
    fn the_biases_of_all_axes_drift_apart() {
        let axis = AxisNoise { noise: 0.0, bias: 1.0 };
        let imu = Imu { accelerometer: Some(axis), gyroscope: Some(axis), ..exact() };
        let still = MotionSample {
            time_us: 2_500_000,
            specific_force: DVec3::ZERO,
            angular_velocity: DVec3::ZERO,
            speed: 0.0,
        };
        let sample = still.imu(&imu, 3);
        for (at, value) in sample.iter().enumerate() {
            assert!(!sample[..at].contains(value), "{sample:?}");
        }
    }

    #[test]
    fn errors_have_the_variance_that_was_asked_for() {
        let ego = Ego::new(Dynamics::default(), Pose::IDENTITY);
        let axis = AxisNoise { noise: 0.3, bias: 0.4 };
        let imu = Imu { accelerometer: Some(axis), gyroscope: Some(axis), ..exact() };
        let wheels = WheelSpeed { noise: 0.2, scale: 0.01 };
        let count = 10_000;
        let mut squares = [0.0; 7];
        for seed in 0..count {
            let sample = MotionSample::new(&ego, &ego, DT_US, 350_000);
            let measured = sample.imu(&imu, seed);
            for (index, (square, value)) in squares.iter_mut().zip(measured).enumerate() {
                let gravity = if index == 2 { GRAVITY_M_S2 } else { 0.0 };
                *square += (f64::from(value) - gravity).powi(2);
            }
            squares[6] += f64::from(sample.wheel_speed(&wheels, seed)).powi(2);
        }
        for (index, square) in squares.into_iter().enumerate() {
            // At rest the scale has no effect: 0.2². Noise and bias of the unit are 0.3² + 0.4².
            let expected = if index == 6 { 0.04 } else { 0.09 + 0.16 };
            // Standard error of a variance: √(2/n) = 1.4 %.
            let variance = square / count as f64;
            assert!((variance / expected - 1.0).abs() < 4.0 * 0.0142, "{index}: {variance}");
        }
    }

    #[test]
    fn the_scale_of_the_wheels_stays_for_an_episode() {
        let dynamics = Dynamics::checked(DynamicsModel::Kinematic, 20.0, false).unwrap();
        let ego = Ego::new(dynamics, Pose::IDENTITY);
        let wheels = WheelSpeed { noise: 0.0, scale: 0.05 };
        let at = |time_us: i64, seed: u64| {
            MotionSample::new(&ego, &ego, DT_US, time_us).wheel_speed(&wheels, seed)
        };
        assert_eq!(at(0, 3), at(100_000, 3));
        assert_ne!(at(0, 3), at(0, 4));
        // At most 4.3 deviations of 5 %: 20 x 0.05 x 4.3 = 4.3.
        assert!(at(0, 3) != 20.0 && (at(0, 3) - 20.0).abs() < 4.4);
    }
}
