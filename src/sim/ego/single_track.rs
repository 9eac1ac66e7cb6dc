//! The dynamic single track over a step: speed, steering, sliding and turning, and where that leads.

use glam::DVec2;

use super::collocation::{INTEGRALS, NODES, POINTS, solve};
use super::constant_speed::{ConstantSpeed, Steering};
use super::speed::{Drive, Phase};
use super::vehicle::{LateralDynamics, Vehicle};

/// A car in the plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SingleTrackState {
    /// Where the middle of the rear axle is, in metres.
    pub position_m: DVec2,
    /// Where the car heads, in radians from the x axis, to the left.
    pub yaw_rad: f64,
    /// Speed along the car, in m/s; below 0 backwards.
    pub speed_m_s: f64,
    /// Lateral velocity of the centre of gravity, in m/s, to the left.
    pub lateral_m_s: f64,
    /// Yaw rate, in rad/s, to the left.
    pub yaw_rate_rad_s: f64,
    /// Angle of the front wheels, in radians, to the left.
    pub steering_rad: f64,
    /// What the drive gives, in m/s².
    pub acceleration_m_s2: f64,
}

/// What steering and drive are told, constant over a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Setpoint {
    /// Acceleration along the car, in m/s².
    pub acceleration_m_s2: f64,
    /// Angle of the front wheels, in radians.
    pub steering_rad: f64,
}

/// How much longer a piece is than the one before it: what decays at a rate λ has fallen to `e^(-2 x)` of
/// itself when a piece is x / λ long, and five points leave at most 7e-9 of that (x = 5).
const GROWTH: f64 = 1.5;

/// Longest piece, as a part of the lag: what lags is then a polynomial up to 1e-15 of itself.
const LONGEST_LAGS: f64 = 0.25;

/// Below this speed, in m/s, pieces get no shorter. What slides there after a change of steering is
/// `v² δ' / 178²` or 3e-9 m/s at most, for 6 µs.
const CRAWL_M_S: f64 = 1e-3;

impl SingleTrackState {
    /// The car after a step in seconds, its speed within bounds that 0 lies in (m/s).
    ///
    /// Exact at constant speed. While speed changes, sliding and turning are collocated in pieces, with
    /// an error below 1e-9 (m, rad, m/s) of a step of 0.1 s at every speed; so is, in either case, the
    /// integral of the way, whose rule is exact to degree 8.
    #[must_use]
    pub fn after(&self, car: &Vehicle, told: Setpoint, step_s: f64, bounds_m_s: [f64; 2]) -> Self {
        let tyres = car.tyres();
        let drive = Drive {
            speed_m_s: self.speed_m_s,
            acceleration_m_s2: self.acceleration_m_s2,
            target_m_s2: told.acceleration_m_s2,
            lag_s: car.lag_s,
        };
        let steering = Steering {
            angle_rad: self.steering_rad,
            target_rad: told.steering_rad,
            lag_s: car.lag_s,
        };
        let (phases, acceleration_m_s2) = drive.phases(step_s, bounds_m_s);
        let mut next = *self;
        let mut begun_s = 0.0;
        for phase in &phases {
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
        let fastest_1_s = tyres.stiffness_m_s2() / phase.drive.speed_m_s.abs().max(CRAWL_M_S);
        let longest_s = LONGEST_LAGS * car.lag_s;
        let (mut begun_s, mut piece_s) = (0.0, (1.0 / fastest_1_s).min(longest_s));
        while begun_s < phase.duration_s {
            let left_s = phase.duration_s - begun_s;
            // A last piece that is a mere rest of rounding would be as good as none.
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
        self.speed_m_s = phase.end_m_s;
        if self.speed_m_s == 0.0 {
            // What G z = 0 says.
            (self.lateral_m_s, self.yaw_rate_rad_s) = (0.0, 0.0);
        }
        self
    }

    /// Drives a piece of which the points are known.
    fn drive(&mut self, car: &Vehicle, points: &[Point; POINTS], length_s: f64) {
        let mut way_m = DVec2::ZERO;
        for (point, weight) in points.iter().zip(INTEGRALS[POINTS - 1]) {
            let rear_m_s = point.sideways.x - car.rear_to_cg_m * point.sideways.y;
            let heading = DVec2::from_angle(self.yaw_rad + point.turned_rad);
            way_m += weight * heading.rotate(DVec2::new(point.speed_m_s, rear_m_s));
        }
        let end = points[POINTS - 1];
        self.position_m += length_s * way_m;
        self.yaw_rad += end.turned_rad;
        (self.lateral_m_s, self.yaw_rate_rad_s) = (end.sideways.x, end.sideways.y);
    }
}

/// A part of a phase.
struct Piece {
    begun_s: f64,
    length_s: f64,
    steering: Steering,
    sideways: DVec2,
}

/// What is known of a moment of a piece.
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
            return NODES.map(|node| {
                let (sideways, turned_rad) = held.after(node * length_s);
                Point { speed_m_s, sideways, turned_rad }
            });
        }
        let mut speeds = NODES.map(|node| phase.drive.speed_after(begun_s + node * length_s));
        if begun_s + length_s >= phase.duration_s {
            speeds[POINTS - 1] = phase.end_m_s;
        }
        let angles_rad = NODES.map(|node| steering.after(node * length_s));
        let states = solve(tyres, length_s, &speeds, &angles_rad, sideways);
        std::array::from_fn(|point| {
            let weighed = INTEGRALS[point].iter().zip(&states).map(|(w, z)| w * z.y);
            Point {
                speed_m_s: speeds[point],
                sideways: states[point],
                turned_rad: length_s * weighed.sum::<f64>(),
            }
        })
    }
}
