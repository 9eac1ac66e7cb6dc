//! Changes of speed that a script commands.

use super::distance::KeepDistance;
use super::lead::LeadCandidate;
use super::script::{Over, Shape};
use super::together::ArriveTogether;
use crate::limits;

/// A change of speed that is under way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum SpeedCommand {
    /// To a speed, by at most a rate.
    To {
        /// The speed, in m/s.
        to_mps: f64,
        /// The rate, in m/s².
        rate_mps2: f64,
    },
    /// To a speed, by a shape.
    Profile(SpeedProfile),
    /// As fast as another.
    Match(SpeedMatch),
    /// At a distance from another.
    Keep(KeepDistance),
    /// So that it arrives when another does.
    Arrive(ArriveTogether),
}

/// The speed of another body that an actor drives with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SpeedMatch {
    /// Index of the actor; `None` for the ego.
    pub(super) of: Option<usize>,
    /// Share of its speed.
    pub(super) factor: f64,
    /// Added to it, in m/s.
    pub(super) delta_mps: f64,
}

/// A change of speed by a shape.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SpeedProfile {
    from_mps: f64,
    to_mps: f64,
    shape: Shape,
    over_s: f64,
    elapsed_s: f64,
}

impl SpeedMatch {
    /// The speed now, in m/s; `None` if the other is absent.
    fn speed_mps(&self, bodies: &[LeadCandidate]) -> Option<f64> {
        let body = LeadCandidate::find(bodies, self.of)?;
        let speed_mps = self.factor * body.velocity_mps.length() + self.delta_mps;
        Some(speed_mps.clamp(0.0, limits::ACTOR_SPEED_M_S))
    }
}

impl SpeedProfile {
    /// A change from a speed to another.
    pub(super) fn new(from_mps: f64, to_mps: f64, over: Over, shape: Shape) -> Self {
        let extent = shape.extent(to_mps - from_mps, over);
        let over_s = match over {
            // Every shape here is symmetric, so that its mean speed is that of its ends.
            // The minimum keeps the time finite for a change from standing to standing.
            Over::Distance(_) => 2.0 * extent / (from_mps + to_mps).max(1e-3),
            _ => extent,
        };
        Self { from_mps, to_mps, shape, over_s, elapsed_s: 0.0 }
    }

    fn acceleration_mps2(&self, speed_mps: f64, duration_s: f64) -> f64 {
        let share = if self.over_s > 0.0 {
            self.shape.at((self.elapsed_s + duration_s) / self.over_s)
        } else {
            1.0
        };
        let next_mps = self.from_mps + share * (self.to_mps - self.from_mps);
        // Exact at the end, so that the change is known to be complete.
        (next_mps - speed_mps) / duration_s
    }
}

impl SpeedCommand {
    /// The speed at which it aims, in m/s; `None` if that of another decides.
    pub(super) fn aim_mps(&self) -> Option<f64> {
        match self {
            Self::To { to_mps, .. } | Self::Profile(SpeedProfile { to_mps, .. }) => Some(*to_mps),
            Self::Match(_) | Self::Keep(_) | Self::Arrive(_) => None,
        }
    }

    /// The acceleration for the next sub-step, in m/s². `place` is where the actor is, and which
    /// way it faces.
    pub(super) fn acceleration_mps2(
        &self,
        place: &super::distance::Place<'_>,
        duration_s: f64,
        bodies: &[LeadCandidate],
    ) -> f64 {
        let speed_mps = place.speed_mps;
        match self {
            Self::To { to_mps, rate_mps2 } => {
                ((to_mps - speed_mps) / duration_s).clamp(-rate_mps2, *rate_mps2)
            }
            Self::Profile(profile) => profile.acceleration_mps2(speed_mps, duration_s),
            Self::Match(matched) => {
                // An absent body keeps the actor at its present speed.
                (matched.speed_mps(bodies).unwrap_or(speed_mps) - speed_mps) / duration_s
            }
            Self::Keep(keep) => keep.acceleration_mps2(place, duration_s, bodies),
            Self::Arrive(arrive) => arrive.acceleration_mps2(place, duration_s, bodies),
        }
    }

    /// The command after a sub-step.
    pub(super) fn after(mut self, duration_s: f64) -> Self {
        if let Self::Profile(profile) = &mut self {
            profile.elapsed_s += duration_s;
        }
        self
    }

    /// Whether it is complete at the end of a sub-step, with the place at its start and the speed
    /// at its end.
    pub(super) fn is_over(
        &self,
        place: &super::distance::Place<'_>,
        speed_mps: f64,
        bodies: &[LeadCandidate],
    ) -> bool {
        match self {
            Self::To { to_mps, .. } => speed_mps == *to_mps,
            Self::Profile(profile) => profile.elapsed_s >= profile.over_s,
            // Never: the other may change its speed at any time.
            Self::Match(_) => false,
            Self::Keep(keep) => keep.is_over(place, bodies),
            Self::Arrive(arrive) => arrive.is_over(place, bodies),
        }
    }
}
