//! Distances that an actor keeps from another along its way.

use glam::DVec3;

use super::course::Course;
use super::lead::LeadCandidate;
use crate::limits;

/// A distance is reached when less than this is missing, in metres.
const REACHED_M: f64 = 0.01;

/// Within this time the last metres are made up, in seconds: the speed of approach is what is
/// missing by this time, as long as that takes no more than the actor's braking.
const SETTLING_S: f64 = 0.5;

/// A distance from another body that an actor keeps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeepDistance {
    /// Index of the actor from which it is kept; `None` for the ego.
    pub of: Option<usize>,
    pub gap: Gap,
    /// On which side of the other the actor drives; `None` for that on which it is.
    pub side: Option<Side>,
    /// Whether the distance is between the boxes; otherwise it is between the reference points.
    pub is_free: bool,
    /// Whether the distance is along the own course; otherwise it is along the own heading.
    pub is_on_course: bool,
    /// From the middle of the own box forward to its reference point, in metres.
    pub ahead_m: f64,
    /// From the middle of the other's box forward to its reference point, in metres.
    pub to_ahead_m: f64,
    /// Whether the action is done once the distance is reached; otherwise it is kept until another
    /// action changes the speed.
    pub is_once: bool,
    /// How the actor may change its speed. Without bounds it is put at the distance at once, as
    /// fast as the other.
    pub bounds: Option<Bounds>,
}

/// A distance to another body, as a length or as a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Gap {
    Length(f64),
    /// In seconds: the way of whichever drives behind within this time.
    Headway(f64),
}

/// A side of another body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    Behind,
    Ahead,
}

/// How an actor may change its speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Largest acceleration, in m/s².
    pub acceleration_mps2: f64,
    /// Largest braking, in m/s².
    pub braking_mps2: f64,
    /// Largest speed, in m/s.
    pub speed_mps: f64,
}

/// Where an actor is.
pub(super) struct Place<'a> {
    pub(super) course: &'a Course,
    pub(super) station_m: f64,
    /// Middle of its box.
    pub(super) center_m: DVec3,
    /// The horizontal direction of its length.
    pub(super) forward: DVec3,
    pub(super) half_length_m: f64,
    pub(super) speed_mps: f64,
}

/// What is missing to a distance.
pub(super) struct Missing {
    /// So far forward, in metres.
    pub(super) way_m: f64,
    /// The other's speed in that direction, in m/s.
    pub(super) speed_mps: f64,
}

impl KeepDistance {
    /// What is missing; `None` if the other is absent. `follower_mps` is the own speed by which a
    /// headway is measured.
    fn missing(
        &self,
        place: &Place<'_>,
        follower_mps: Option<f64>,
        bodies: &[LeadCandidate],
    ) -> Option<Missing> {
        let body = LeadCandidate::find(bodies, self.of)?;
        let (ahead, way_m) = if self.is_on_course {
            // The place of the other's middle on the own course, so that bends do not shorten the
            // distance.
            let beside = place.course.nearest(body.center_m);
            let ahead = place.course.at(beside.station_m).rotation * DVec3::X;
            (ahead, beside.station_m - place.station_m)
        } else {
            (place.forward, (body.center_m - place.center_m).dot(place.forward))
        };
        // In the direction of the way: a reference point ahead of a turned body counts less.
        let shift_m = self.to_ahead_m * body.forward().dot(ahead) - self.ahead_m;
        // Between boxes the middles count, and not the reference points.
        let way_m = if self.is_free { way_m } else { way_m + shift_m };
        let other_mps = body.velocity_mps.dot(ahead);
        let is_behind = match self.side {
            Some(side) => side == Side::Behind,
            None => way_m >= 0.0,
        };
        let gap_m = match self.gap {
            Gap::Length(gap_m) => gap_m,
            Gap::Headway(headway_s) => {
                // For a jump the actor takes over the other's speed, so that speed decides on the
                // headway.
                let own_mps = follower_mps.unwrap_or(other_mps);
                headway_s * if is_behind { own_mps } else { other_mps }.max(0.0)
            }
        };
        let half_m =
            if self.is_free { place.half_length_m + body.half_extent_m(ahead) } else { 0.0 };
        // Positive `way_m` means that the other is ahead: behind it, the wanted way is positive as
        // well.
        let wanted_m = if is_behind { gap_m + half_m } else { -(gap_m + half_m) };
        Some(Missing { way_m: way_m - wanted_m, speed_mps: other_mps })
    }

    /// What is missing for an actor without bounds, which will be as fast as the other; `None` for
    /// others.
    pub(super) fn jump(&self, place: &Place<'_>, bodies: &[LeadCandidate]) -> Option<Missing> {
        match self.bounds {
            None => self.missing(place, None, bodies),
            Some(_) => None,
        }
    }

    /// The acceleration for the next sub-step, in m/s²: towards the other's speed and the speed of
    /// approach from which the actor can still brake within what is missing.
    pub(super) fn acceleration_mps2(
        &self,
        place: &Place<'_>,
        duration_s: f64,
        bodies: &[LeadCandidate],
    ) -> f64 {
        let missing = self.missing(place, Some(place.speed_mps), bodies);
        let Some((missing, bounds)) = missing.zip(self.bounds) else { return 0.0 };
        let Bounds { acceleration_mps2, braking_mps2, speed_mps } = bounds;
        // Too far behind, the actor approaches and must be able to brake. Too close, it falls back
        // and must be able to accelerate again.
        let most_mps2 = if missing.way_m > 0.0 { braking_mps2 } else { acceleration_mps2 };
        let approach_mps = missing.way_m.signum() * approach_mps(missing.way_m.abs(), most_mps2);
        let aim_mps = (missing.speed_mps + approach_mps).clamp(0.0, speed_mps);
        ((aim_mps - place.speed_mps) / duration_s).clamp(-braking_mps2, acceleration_mps2)
    }

    /// Whether the distance was reached, and need not be kept.
    pub(super) fn is_over(&self, place: &Place<'_>, bodies: &[LeadCandidate]) -> bool {
        let reached = || match self.bounds {
            // A jump is over as soon as it could be made.
            None => LeadCandidate::find(bodies, self.of).is_some(),
            Some(_) => self
                .missing(place, Some(place.speed_mps), bodies)
                .is_some_and(|missing| missing.way_m.abs() < REACHED_M),
        };
        self.is_once && reached()
    }
}

/// The speed of approach from which an actor reaches its place with a largest deceleration, in m/s:
/// proportional to the way at the end, and before `√(2 b (way - b τ² / 2))`, which continues it
/// with the same slope.
fn approach_mps(way_m: f64, most_mps2: f64) -> f64 {
    // At `b τ²` the straight line `way / τ` and the root have the same value and slope.
    let settling_m = most_mps2 * SETTLING_S * SETTLING_S;
    if way_m <= settling_m {
        return way_m / SETTLING_S;
    }
    (2.0 * most_mps2 * (way_m - 0.5 * settling_m)).sqrt().min(2.0 * limits::ACTOR_SPEED_M_S)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_speed_of_approach_is_that_of_braking_and_smooth() {
        let most_mps2 = 2.0;
        // Braking along the curve takes at most the given deceleration: v dv/dx.
        for way_m in [0.1, 0.4, 0.6, 3.0, 50.0] {
            let step_m = 1e-6;
            let [low, high] = [way_m - step_m, way_m + step_m].map(|m| approach_mps(m, most_mps2));
            let braking = approach_mps(way_m, most_mps2) * (high - low) / (2.0 * step_m);
            assert!(braking <= most_mps2 + 1e-6, "{way_m}: {braking}");
            let is_far = way_m > most_mps2 * SETTLING_S * SETTLING_S;
            assert!(!is_far || (braking - most_mps2).abs() < 1e-6, "{way_m}: {braking}");
        }
    }
}
