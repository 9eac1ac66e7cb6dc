//! One step of the linear single-track model: speed, steering, lateral velocity, yaw rate, and the
//! pose.

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::collocation::{INTEGRALS, NODES, POINTS, solve};
use super::constant_speed::{ConstantSpeed, Steering};
use super::speed::{Drive, Phase};
use super::vehicle::{LateralDynamics, Vehicle};

/// The state of a car in the plane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SingleTrackState {
    /// Position of the middle of the rear axle, in metres.
    pub position_m: DVec2,
    /// Heading, in radians from the x axis, positive to the left.
    pub yaw_rad: f64,
    /// Speed along the car, in m/s; below 0 backwards.
    pub speed_m_s: f64,
    /// Lateral velocity of the centre of gravity, in m/s, to the left.
    pub lateral_m_s: f64,
    /// Yaw rate, in rad/s, to the left.
    pub yaw_rate_rad_s: f64,
    /// Angle of the front wheels, in radians, to the left.
    pub steering_rad: f64,
    /// Acceleration that the drive delivers, in m/s².
    pub acceleration_m_s2: f64,
}

/// Setpoints of steering and drive, constant over a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Setpoint {
    /// Acceleration along the car, in m/s².
    pub acceleration_m_s2: f64,
    /// Angle of the front wheels, in radians.
    pub steering_rad: f64,
}

/// Ratio of the lengths of consecutive intervals. A transient that decays at a rate λ has fallen to
/// `e^(-2 x)` of its initial value when an interval is x / λ long, and collocation at five points
/// has an error of at most 7e-9 of that value (at x = 5).
const GROWTH: f64 = 1.5;

/// Largest length of an interval, as a fraction of the lag: over such an interval, a polynomial
/// approximates the exponential of the lag with a relative error of 1e-15.
const MAX_INTERVAL_LAGS: f64 = 0.25;

/// Below this speed, in m/s, intervals do not become shorter. There, the lateral velocity after a
/// change of steering is at most `v² δ' / 178²` = 3e-9 m/s, and lasts for 6 µs.
const MIN_INTERVAL_SPEED_M_S: f64 = 1e-3;

impl SingleTrackState {
    /// This state relative to the pose of another state.
    #[must_use]
    pub(super) fn relative_to(&self, other: &Self) -> Self {
        Self {
            position_m: DVec2::from_angle(-other.yaw_rad)
                .rotate(self.position_m - other.position_m),
            yaw_rad: self.yaw_rad - other.yaw_rad,
            ..*self
        }
    }

    /// The state after a step of `step_s` seconds. The speed stays within `bounds_m_s` (smallest
    /// and largest, in m/s), which must contain 0.
    ///
    /// Exact at constant speed. While speed changes, lateral velocity and yaw rate are collocated
    /// in intervals, with an error below 1e-9 (m, rad, m/s) for a step of 0.1 s at every speed. The
    /// pose is integrated in both cases by the quadrature of the same nodes, which is exact to
    /// degree 8 and has the same error.
    #[must_use]
    pub fn after(
        &self,
        car: &Vehicle,
        setpoint: Setpoint,
        step_s: f64,
        bounds_m_s: [f64; 2],
    ) -> Self {
        let tyres = car.tyres();
        let drive = Drive {
            speed_m_s: self.speed_m_s,
            acceleration_m_s2: self.acceleration_m_s2,
            target_m_s2: setpoint.acceleration_m_s2,
            lag_s: car.lag_s,
        };
        let steering = Steering {
            angle_rad: self.steering_rad,
            target_rad: setpoint.steering_rad,
            lag_s: car.lag_s,
        };
        // Speed does not depend on lateral motion, so it is solved for the whole step first. Each
        // phase then has a known speed.
        let (phases, acceleration_m_s2) = drive.phases(step_s, bounds_m_s);
        let mut next = *self;
        let mut begun_s = 0.0;
        for phase in &phases {
            // From the start of the step and not from phase to phase, so that rounding does not add
            // up.
            let angle_rad = steering.after(begun_s);
            next = next.after_phase(car, &tyres, phase, Steering { angle_rad, ..steering });
            begun_s += phase.duration_s;
        }
        Self { steering_rad: steering.after(step_s), acceleration_m_s2, ..next }
    }

    fn after_phase(
        mut self,
        car: &Vehicle,
        tyres: &LateralDynamics,
        phase: &Phase,
        steering: Steering,
    ) -> Self {
        // The fastest decay at speed v is 438 / v; the first interval is one of its time constants.
        let fastest_1_s =
            tyres.stiffness_m_s2() / phase.drive.speed_m_s.abs().max(MIN_INTERVAL_SPEED_M_S);
        let longest_s = MAX_INTERVAL_LAGS * car.lag_s;
        let mut begun_s = 0.0;
        let mut piece_s = (1.0 / fastest_1_s).min(longest_s);
        while begun_s < phase.duration_s {
            let left_s = phase.duration_s - begun_s;
            // Extend the last interval instead of adding one that only covers a rounding error.
            let last = left_s <= 1.01 * piece_s;
            let end_s = if last { phase.duration_s } else { begun_s + piece_s };
            let angle_rad = steering.after(begun_s);
            let sideways = DVec2::new(self.lateral_m_s, self.yaw_rate_rad_s);
            let steering = Steering { angle_rad, ..steering };
            let piece = Piece { begun_s, length_s: end_s - begun_s, steering, sideways };
            self.drive(car, &piece.points(tyres, phase), piece.length_s);
            begun_s = end_s;
            piece_s = (GROWTH * piece_s).min(longest_s);
        }
        // The exact bound of the phase, without the rounding of the nodes.
        self.speed_m_s = phase.end_m_s;
        if self.speed_m_s == 0.0 {
            // At v = 0 the equation is G z = 0.
            self.lateral_m_s = 0.0;
            self.yaw_rate_rad_s = 0.0;
        }
        self
    }

    /// Integrates the pose over an interval whose nodes are known.
    fn drive(&mut self, car: &Vehicle, points: &[Point; POINTS], length_s: f64) {
        let mut way_m = DVec2::ZERO;
        for (point, weight) in points.iter().zip(INTEGRALS[POINTS - 1]) {
            // Velocity of the rear axle, because the position is that of the rear axle.
            let rear_m_s = point.sideways.x - car.rear_to_cg_m * point.sideways.y;
            let heading = DVec2::from_angle(self.yaw_rad + point.turned_rad);
            way_m += weight * heading.rotate(DVec2::new(point.speed_m_s, rear_m_s));
        }
        // The last node is at 1, the end of the interval, so the end state needs no extrapolation.
        let end = points[POINTS - 1];
        self.position_m += length_s * way_m;
        self.yaw_rad += end.turned_rad;
        self.lateral_m_s = end.sideways.x;
        self.yaw_rate_rad_s = end.sideways.y;
    }
}

/// One integration interval of a phase.
struct Piece {
    /// Start within the phase, in seconds.
    begun_s: f64,
    length_s: f64,
    /// Steering at the start of the interval.
    steering: Steering,
    /// Lateral velocity (m/s) and yaw rate (rad/s) at the start of the interval.
    sideways: DVec2,
}

/// The state at a node of an interval.
#[derive(Clone, Copy)]
struct Point {
    speed_m_s: f64,
    sideways: DVec2,
    turned_rad: f64,
}

impl Piece {
    fn points(&self, tyres: &LateralDynamics, phase: &Phase) -> [Point; POINTS] {
        let Self { begun_s, length_s, steering, sideways } = *self;
        if phase.held {
            let speed_m_s = phase.drive.speed_m_s;
            let held = ConstantSpeed::new(tyres, speed_m_s, steering, sideways);
            // The closed form gives the state at any time; the nodes are needed only for the
            // quadrature of the pose.
            return NODES.map(|node| {
                let (sideways, turned_rad) = held.after(node * length_s);
                Point { speed_m_s, sideways, turned_rad }
            });
        }
        let mut speeds = NODES.map(|node| phase.drive.speed_after(begun_s + node * length_s));
        // At the end of the phase the speed is exactly a bound or 0. A rounding error of the other
        // sign would break the equation, which needs speeds of one sign.
        if begun_s + length_s >= phase.duration_s {
            speeds[POINTS - 1] = phase.end_m_s;
        }
        let angles_rad = NODES.map(|node| steering.after(node * length_s));
        let states = solve(tyres, length_s, &speeds, &angles_rad, sideways);
        std::array::from_fn(|point| {
            // The change of heading at a node is the integral of the yaw rate up to it.
            let weighed = INTEGRALS[point].iter().zip(&states).map(|(w, z)| w * z.y);
            Point {
                speed_m_s: speeds[point],
                sideways: states[point],
                turned_rad: length_s * weighed.sum::<f64>(),
            }
        })
    }
}
