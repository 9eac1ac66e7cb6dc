//! An attacker that plans its way towards the ego, after HUGSIM (hyzhou404/HUGSIM@62c690d,
//! `agent_controller.py`).
//!
//! Every few ticks of 0.25 s the attacker considers 150 cubic splines of 2 s: five offsets to the
//! side, ten accelerations, and three headings at the end. Those that no vehicle could drive are
//! dropped. The cost of one is the least distance to the predicted ego, plus 0.1 for each neighbour
//! that comes nearer than 2 m. One of the best is sampled. HUGSIM predicts the ego at 0.25 s a
//! point and the attacker at 0.1 s a point; here both are predicted at the same times.

use glam::DVec2;

/// Points of a plan after its start, 0.1 s apart: 2 s.
pub const PLAN_POINTS: usize = 20;
/// Time between two points, in seconds.
const POINT_S: f64 = 0.1;
/// Duration of a plan, in seconds.
const PLAN_S: f64 = 2.0;
/// Offsets of the end to the left, in metres.
const OFFSETS_M: [f64; 5] = [-3.0, -1.5, 0.0, 1.5, 3.0];
/// Number of accelerations, and their range in m/s².
const ACCELERATIONS: u8 = 10;
const ACCELERATIONS_MPS2: [f64; 2] = [-2.0, 5.0];
/// Headings at the end relative to the direction towards it, in radians: 30° to either side.
const HEADINGS_RAD: [f64; 3] = [-std::f64::consts::FRAC_PI_6, 0.0, std::f64::consts::FRAC_PI_6];
/// Limits of a drivable motion: accelerations (m/s²), speeds (m/s), largest yaw rate (rad/s).
const DRIVABLE_MPS2: [f64; 2] = [-6.0, 5.0];
const DRIVABLE_MPS: [f64; 2] = [-2.0, 50.0];
const DRIVABLE_RADPS: f64 = 8.0;
/// A neighbour that comes nearer than this counts, in metres.
const NEIGHBOUR_M: f64 = 2.0;
/// Cost of such a neighbour, in metres.
const NEIGHBOUR_COST_M: f64 = 0.1;
/// Above the rounding of a squared distance, in m².
const SLACK_M: f64 = 1e-6;

/// Settings of an attacker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attack {
    /// Time between two plans, in microseconds: 3 ticks of 0.25 s in HUGSIM's fast mode, 10 in its
    /// slow mode.
    pub plan_us: i64,
    /// Number of best plans from which one is sampled: 1, 2 and 10 in HUGSIM's modes.
    pub best: usize,
}

/// A cubic spline in the plane, in the axes of the attacker at the start of the plan: x ahead, y to
/// the left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spline {
    /// Speed at the start, in m/s.
    begin_mps: f64,
    end_m: DVec2,
    end_mps: DVec2,
}

impl Spline {
    /// A plan without a turn or a change of speed.
    pub fn straight(speed_mps: f64) -> Self {
        Self {
            begin_mps: speed_mps,
            end_m: DVec2::new(speed_mps * PLAN_S, 0.0),
            end_mps: DVec2::new(speed_mps, 0.0),
        }
    }

    /// Position in metres at a time in seconds; beyond the end it goes straight on.
    pub fn position_m(&self, time_s: f64) -> DVec2 {
        if time_s >= PLAN_S {
            return self.end_m + (time_s - PLAN_S) * self.end_mps;
        }
        // Hermite's basis; tangents are velocities times the duration.
        let t = time_s / PLAN_S;
        let tangent = DVec2::new(self.begin_mps * PLAN_S, 0.0);
        (t * t * t - 2.0 * t * t + t) * tangent
            + (3.0 * t * t - 2.0 * t * t * t) * self.end_m
            + (t * t * t - t * t) * PLAN_S * self.end_mps
    }

    /// Velocity in m/s at a time in seconds.
    pub fn velocity_mps(&self, time_s: f64) -> DVec2 {
        if time_s >= PLAN_S {
            return self.end_mps;
        }
        // The derivative of the polynomial above with respect to time: each derivative of a basis
        // function divided by the duration.
        let t = time_s / PLAN_S;
        let begin = DVec2::new(self.begin_mps, 0.0);
        (3.0 * t * t - 4.0 * t + 1.0) * begin
            + (6.0 * t - 6.0 * t * t) / PLAN_S * self.end_m
            + (3.0 * t * t - 2.0 * t) * self.end_mps
    }

    /// The points of the plan, without its start.
    pub fn points_m(&self) -> [DVec2; PLAN_POINTS] {
        // The start is common to all plans and would add the same distance to each.
        std::array::from_fn(|at| self.position_m((at + 1) as f64 * POINT_S))
    }

    /// Whether a vehicle could drive it: speeds along its heading, accelerations and yaw rates
    /// between points.
    fn is_drivable(&self) -> bool {
        // 21 velocities give 20 differences, one for each piece of 0.1 s.
        let velocities: [DVec2; PLAN_POINTS + 1] =
            std::array::from_fn(|at| self.velocity_mps(at as f64 * POINT_S));
        velocities.windows(2).all(|pair| {
            let before = pair[0];
            let after = pair[1];
            // Below 0.1 m/s the direction of the velocity is no heading.
            // Both must be fast enough: the angle between them needs two directions.
            let turn_rad = if before.length().min(after.length()) < 0.1 {
                0.0
            } else {
                before.angle_to(after)
            };
            // Along x, since a plan begins along x and turns by less than a right angle.
            let speed_mps = after.length().copysign(after.x);
            let acceleration = (speed_mps - before.length().copysign(before.x)) / POINT_S;
            (DRIVABLE_MPS2[0]..=DRIVABLE_MPS2[1]).contains(&acceleration)
                && (DRIVABLE_MPS[0]..DRIVABLE_MPS[1]).contains(&speed_mps)
                && (turn_rad / POINT_S).abs() <= DRIVABLE_RADPS
        })
    }
}

/// The plans that a vehicle at a speed in m/s can drive, of 150.
pub fn candidates(speed_mps: f64) -> Vec<Spline> {
    let mut kept = Vec::new();
    for offset_m in OFFSETS_M {
        for step in 0..ACCELERATIONS {
            let share = f64::from(step) / f64::from(ACCELERATIONS - 1);
            let acceleration =
                ACCELERATIONS_MPS2[0] + share * (ACCELERATIONS_MPS2[1] - ACCELERATIONS_MPS2[0]);
            // `v T + a T² / 2`: the end if the plan were straight.
            let ahead_m = speed_mps * PLAN_S + 0.5 * acceleration * PLAN_S * PLAN_S;
            let end_m = DVec2::new(ahead_m, offset_m);
            let end_mps = speed_mps + acceleration * PLAN_S;
            for heading_rad in HEADINGS_RAD {
                // Relative to the direction towards the end, so that a plan to the side turns by
                // its own angle in addition.
                let direction = DVec2::from_angle(end_m.to_angle() + heading_rad);
                let spline = Spline { begin_mps: speed_mps, end_m, end_mps: end_mps * direction };
                if spline.is_drivable() {
                    kept.push(spline);
                }
            }
        }
    }
    kept
}

/// The points of a plan, or of a prediction.
pub type Points = [DVec2; PLAN_POINTS];

/// The costs of plans in metres: the least distance to the attacked body, and more for each
/// neighbour that comes near. All points are at the same times.
pub fn costs_m(plans: &[Points], attacked: &Points, neighbours: &[Points]) -> Vec<f64> {
    let hull = plan_hull(plans);
    // The times at which a neighbour may be near any plan, from which most have none.
    let near: Vec<(&Points, Vec<usize>)> = neighbours
        .iter()
        .map(|other| {
            let times = (0..PLAN_POINTS).filter(|at| {
                let [low_m, high_m] = hull[*at];
                let away_m = (low_m - other[*at]).max(other[*at] - high_m).max(DVec2::ZERO);
                away_m.length_squared() < NEIGHBOUR_M * NEIGHBOUR_M + SLACK_M
            });
            (other, times.collect())
        })
        .filter(|(_, times): &(_, Vec<usize>)| !times.is_empty())
        .collect();
    let costs = plans.iter().map(|plan| {
        // Squares, which have the same order: the root is drawn once.
        let distances = plan.iter().zip(attacked).map(|(a, b)| a.distance_squared(*b));
        let least_m = distances.fold(f64::INFINITY, f64::min).sqrt();
        // Point by point and not the nearest of all: the cost is of places at the same time.
        let comes_near = |(other, times): &&(&Points, Vec<usize>)| {
            let mut squares = times.iter().map(|at| plan[*at].distance_squared(other[*at]));
            squares.any(|square_m2| square_m2 < NEIGHBOUR_M * NEIGHBOUR_M)
        };
        least_m + NEIGHBOUR_COST_M * near.iter().filter(comes_near).count() as f64
    });
    costs.collect()
}

/// The lowest and the highest coordinates of all plans at each time.
fn plan_hull(plans: &[Points]) -> [[DVec2; 2]; PLAN_POINTS] {
    std::array::from_fn(|at| {
        let none = [DVec2::INFINITY, DVec2::NEG_INFINITY];
        plans.iter().fold(none, |[low_m, high_m], plan| [low_m.min(plan[at]), high_m.max(plan[at])])
    })
}

/// The points at which a body is predicted to be, at constant speed and yaw rate, in the same order
/// and axes as those of a plan.
pub fn predicted(at_m: DVec2, velocity_mps: DVec2, yaw_rate_radps: f64) -> [DVec2; PLAN_POINTS] {
    let mut point_m = at_m;
    let mut velocity_mps = velocity_mps;
    // Half a turn before each straight piece and half after: exact in direction, second order in
    // place.
    let half_turn = DVec2::from_angle(0.5 * yaw_rate_radps * POINT_S);
    std::array::from_fn(|_| {
        velocity_mps = half_turn.rotate(velocity_mps);
        point_m += POINT_S * velocity_mps;
        velocity_mps = half_turn.rotate(velocity_mps);
        point_m
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splines_begin_and_end_as_planned() {
        let all = candidates(8.0);
        assert!((30..=150).contains(&all.len()), "{}", all.len());
        for spline in all {
            assert_eq!(spline.position_m(0.0), DVec2::ZERO);
            assert_eq!(spline.velocity_mps(0.0), DVec2::new(8.0, 0.0));
            assert!((spline.position_m(PLAN_S) - spline.end_m).length() < 1e-12);
            let step_s = 1e-6;
            // A difference quotient with a step of 1e-6 s has an error of about a · 1e-6, and
            // rounding adds 1e-9.
            let slope = (spline.position_m(0.7 + step_s) - spline.position_m(0.7)) / step_s;
            assert!((slope - spline.velocity_mps(0.7)).length() < 1e-4, "{slope}");
        }
    }

    #[test]
    fn a_turning_body_is_predicted_on_its_circle() {
        let points = predicted(DVec2::ZERO, DVec2::new(5.0, 0.0), 0.5);
        // Radius 10 m about (0, 10).
        for point_m in points {
            assert!((point_m.distance(DVec2::new(0.0, 10.0)) - 10.0).abs() < 0.01, "{point_m}");
        }
    }
}
