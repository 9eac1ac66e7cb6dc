//! Arrivals: an actor that is at its place when another is at its own.

use glam::DVec3;

use super::distance::Place;
use super::lead::LeadCandidate;
use crate::limits;

/// Slower than this, the other does not arrive, in m/s.
const STANDS_MPS: f64 = 0.01;

/// The other passes its place within this distance to the side, in metres: about one and a half
/// lanes.
const ASIDE_M: f64 = 5.0;

/// Drives so that it is at a place when another body is at its own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArriveTogether {
    /// Its own place: the nearest on its course counts.
    pub at_m: DVec3,
    /// Index of the other actor; `None` for the ego.
    pub of: Option<usize>,
    pub of_at_m: DVec3,
    /// From the middle of the own box forward to its reference point, in metres.
    pub ahead_m: f64,
    /// From the middle of the other's box forward to its reference point, in metres.
    pub to_ahead_m: f64,
    /// The speed with which it arrives. Without it, it changes its speed at a constant rate.
    pub speed: Option<FinalSpeed>,
    /// So far before its place it has that speed, in metres.
    pub steady_m: f64,
    /// It is there within this distance, in metres.
    pub within_m: f64,
    /// The other is there within this distance, in metres.
    pub of_within_m: f64,
}

/// The speed of an arrival.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FinalSpeed {
    Absolute(f64),
    /// That of the other times a factor, and more by some m/s.
    Relative {
        factor: f64,
        /// More than that, in m/s.
        delta_mps: f64,
    },
}

/// What is left of both ways.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Rest {
    /// The own way, in metres.
    way_m: f64,
    /// The other's time, in seconds; endless if it stands.
    time_s: f64,
    /// The speed of the arrival, in m/s, if it is given.
    speed_mps: Option<f64>,
    is_other_there: bool,
}

impl ArriveTogether {
    /// What is left; `None` if the other is absent.
    fn rest(&self, place: &Place<'_>, bodies: &[LeadCandidate]) -> Option<Rest> {
        let body = LeadCandidate::find(bodies, self.of)?;
        let other_mps = body.velocity_mps.length();
        let way_m = self.of_at_m - (body.center_m + self.to_ahead_m * body.forward());
        let to = DVec3::new(way_m.x, way_m.y, 0.0);
        // Way to the place in the axes of the other: ahead of it, and to the side.
        let ahead_m = to.dot(body.forward());
        // Pythagoras; the maximum catches a negative rounding error.
        let aside_m = (to.length_squared() - ahead_m * ahead_m).max(0.0).sqrt();
        let is_before_it = aside_m < ASIDE_M;
        // On a straight line the way ahead counts, whatever the offset; around bends, the straight
        // distance.
        let other_m = if is_before_it { ahead_m.max(0.0) } else { to.length() };
        let is_other_there =
            to.length() <= self.of_within_m || (is_before_it && ahead_m <= 0.0 && ahead_m > -50.0);
        let time_s = if other_mps < STANDS_MPS { f64::INFINITY } else { other_m / other_mps };
        let aim_mps = self.speed.map(|speed| match speed {
            FinalSpeed::Absolute(speed_mps) => speed_mps,
            FinalSpeed::Relative { factor, delta_mps } => factor * other_mps + delta_mps,
        });
        let speed_mps = aim_mps.map(|mps| mps.clamp(0.0, limits::ACTOR_SPEED_M_S));
        let own_m = place.course.nearest(self.at_m).station_m - self.ahead_m;
        Some(Rest { way_m: own_m - place.station_m, time_s, speed_mps, is_other_there })
    }

    /// The acceleration for the next sub-step, in m/s².
    pub(super) fn acceleration_mps2(
        &self,
        place: &Place<'_>,
        duration_s: f64,
        bodies: &[LeadCandidate],
    ) -> f64 {
        // Nothing to arrive with: the speed stays.
        let Some(rest) = self.rest(place, bodies) else { return 0.0 };
        let most_mps2 = limits::ACTOR_ACCELERATION_M_S2;
        let constant_mps2 = |speed_mps: f64| (speed_mps - place.speed_mps) / duration_s;
        let acceleration_mps2 = match rest.speed_mps {
            Some(speed_mps) if self.steady_m > 0.0 && speed_mps > 0.0 => {
                let way_m = rest.way_m - self.steady_m;
                // The last metres take `steady / v` at the final speed; the cubic ends where they
                // begin.
                let time_s = rest.time_s - self.steady_m / speed_mps;
                if way_m <= 0.0 || time_s <= duration_s {
                    constant_mps2(speed_mps)
                } else {
                    towards_mps2([way_m, time_s], [place.speed_mps, speed_mps], duration_s)
                }
            }
            Some(speed_mps) => {
                towards_mps2([rest.way_m, rest.time_s], [place.speed_mps, speed_mps], duration_s)
            }
            None => {
                // Mean speed `way / time` of a constant rate is that of both ends:
                // `v1 = 2 s / t - v0`.
                let speed_mps = (2.0 * rest.way_m / rest.time_s - place.speed_mps).max(0.0);
                towards_mps2([rest.way_m, rest.time_s], [place.speed_mps, speed_mps], duration_s)
            }
        };
        acceleration_mps2.clamp(-most_mps2, most_mps2)
    }

    /// Whether one of both is there.
    pub(super) fn is_over(&self, place: &Place<'_>, bodies: &[LeadCandidate]) -> bool {
        self.rest(place, bodies)
            .is_some_and(|rest| rest.is_other_there || rest.way_m <= self.within_m)
    }
}

/// The mean acceleration of the next sub-step on the cubic that covers a way within a time, from a
/// speed to another; or that of braking to a standstill, if the cubic would lead backwards: the
/// actor waits, and starts again when there is a cubic from standstill.
fn towards_mps2([way_m, time_s]: [f64; 2], [from_mps, to_mps]: [f64; 2], duration_s: f64) -> f64 {
    // There, or too late for another sub-step: the speed stays.
    if way_m <= 0.0 || time_s <= duration_s {
        return 0.0;
    }
    // Way `v0 t + q t² + c t³` with the given way and final speed at the end. Its speed is
    // `v0 + 2 q t + 3 c t²`.
    let square = (3.0 * way_m / time_s - 2.0 * from_mps - to_mps) / time_s;
    let cube = (from_mps + to_mps - 2.0 * way_m / time_s) / (time_s * time_s);
    // The lowest speed is where `2 q + 6 c t = 0`.
    let lowest_s = -square / (3.0 * cube);
    let has_lowest = cube > 0.0 && lowest_s > 0.0 && lowest_s < time_s;
    let lowest_mps = from_mps - square * square / (3.0 * cube);
    if time_s.is_infinite() || (has_lowest && lowest_mps < -1e-6) {
        // The rest of the way, after the standstill, is as long as the same rate needs up to the
        // final speed.
        return -(from_mps * from_mps + to_mps * to_mps) / (2.0 * way_m);
    }
    // The acceleration `2 q + 6 c t` at the middle of the sub-step.
    2.0 * square + 3.0 * cube * duration_s
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The places and speeds of an actor at the ends of sub-steps of 10 ms.
    fn driven(way_m: f64, time_s: f64, from_mps: f64, to_mps: f64) -> Vec<[f64; 2]> {
        let mut at = [0.0, from_mps];
        let count = (time_s * 100.0).round() as usize;
        let states = (0..count).map(|index| {
            let left_s = time_s - index as f64 * 0.01;
            let acceleration = towards_mps2([way_m - at[0], left_s], [at[1], to_mps], 0.01);
            let [step_m, speed_mps] = super::super::idm::rolled(at[1], acceleration, 0.01);
            at = [at[0] + step_m, speed_mps];
            at
        });
        states.collect()
    }

    #[test]
    fn it_follows_the_cubic_of_its_ends() {
        let way_m = 60.0;
        let time_s = 5.0;
        let from_mps = 8.0;
        let to_mps = 14.0;
        for (index, [place_m, speed_mps]) in
            driven(way_m, time_s, from_mps, to_mps).into_iter().enumerate()
        {
            let u = (index + 1) as f64 * 0.01 / time_s;
            // Hermite's cubic.
            let expected_m = way_m * u * u * (3.0 - 2.0 * u)
                + time_s * from_mps * u * (1.0 - u) * (1.0 - u)
                - time_s * to_mps * u * u * (1.0 - u);
            assert!((place_m - expected_m).abs() < 2e-3, "{u}: {place_m} {expected_m}");
            if index + 2 == (time_s * 100.0) as usize {
                assert!((speed_mps - to_mps).abs() < 0.1, "{speed_mps}");
            }
        }
    }

    #[test]
    fn it_waits_if_it_has_more_time_than_way() {
        let states = driven(40.0, 20.0, 8.0, 6.0);
        let [end_m, end_mps] = states[states.len() - 1];
        assert!((end_m - 40.0).abs() < 0.01 && (end_mps - 6.0).abs() < 0.1, "{end_m} {end_mps}");
        assert!(states.iter().any(|state| state[1] == 0.0), "it stands in between");
        assert!(states.windows(2).all(|pair| pair[1][0] >= pair[0][0]), "never backwards");
    }

    #[test]
    fn it_brakes_while_the_other_stands() {
        // v² / (2 s) = 100 / 100, and (36 + 64) / 100 with a final speed.
        assert_eq!(towards_mps2([50.0, f64::INFINITY], [10.0, 0.0], 0.01), -1.0);
        assert_eq!(towards_mps2([50.0, f64::INFINITY], [6.0, 8.0], 0.01), -1.0);
    }
}
