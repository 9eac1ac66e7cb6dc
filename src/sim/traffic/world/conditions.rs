//! Which conditions hold at an instant.

use std::cell::OnceCell;

use crate::traffic::condition::Measures;
use crate::traffic::lead::LeadCandidate;
use crate::traffic::script::{After, Condition, Near};
use crate::traffic::state::EgoState;
use crate::traffic::waiting::{Gate, is_plain};

use super::World;

/// The instant at the start of a sub-step, as the conditions of one actor see it.
pub(super) struct Instant<'a> {
    pub(super) ego: &'a EgoState,
    pub(super) bodies: &'a [LeadCandidate],
    /// Where the ego is along the actor's course, once it is known: a search along the course, and
    /// one for all triggers of the actor.
    ego_station_m: OnceCell<Option<f64>>,
}

impl<'a> Instant<'a> {
    pub(super) fn new(ego: &'a EgoState, bodies: &'a [LeadCandidate]) -> Self {
        Self { ego, bodies, ego_station_m: OnceCell::new() }
    }
}

impl World {
    /// Whether the gate of a trigger of an actor is open: only then its condition may hold.
    pub(super) fn is_open(&self, index: usize, gate: &Gate, instant: &Instant<'_>) -> bool {
        match *gate {
            Gate::Time(time_us) => self.time_us >= time_us,
            Gate::After(after) => self.is_after(after),
            Gate::EgoStation(least_m) => {
                self.ego_station_m(index, instant).is_some_and(|at_m| at_m >= least_m)
            }
            Gate::Station(least_m) => {
                let place = self.progress[index].motion.course();
                place.is_some_and(|(_, at_m)| at_m >= least_m)
            }
            Gate::EgoSpeed(least_mps) => instant.ego.velocity_mps.length() >= least_mps,
            Gate::Near(near) => self.is_near(index, near, instant.bodies),
            Gate::Open => true,
        }
    }

    /// Where the ego's box is along the course of an actor, in metres; `None` without a course.
    fn ego_station_m(&self, index: usize, instant: &Instant<'_>) -> Option<f64> {
        *instant.ego_station_m.get_or_init(|| {
            let (course, _) = self.progress[index].motion.course()?;
            // The ego is the first of the bodies.
            Some(course.nearest(instant.bodies[0].center_m).station_m)
        })
    }

    /// Whether a trigger that has not fired fires now.
    pub(super) fn is_due(
        &mut self,
        [index, at]: [usize; 2],
        when: &Condition,
        instant: &Instant<'_>,
    ) -> bool {
        // Edges and delays count from then on.
        if !when.after.is_none_or(|after| self.is_after(after)) {
            return false;
        }
        if is_plain(when) {
            return self.holds(Some(index), when, instant);
        }
        // Taken out, because `holds` borrows the whole world meanwhile.
        let mut state = std::mem::take(&mut self.progress[index].fired[at].condition);
        let own = |part: &Condition| self.holds(Some(index), part, instant);
        let value = state.value(when, self.time_us, &own);
        self.progress[index].fired[at].condition = state;
        value
    }

    pub(super) fn is_after(&self, after: After) -> bool {
        let since_us = self.ended_us(after.actor, after.trigger, after.phase);
        since_us.is_some_and(|since_us| self.time_us >= since_us.saturating_add(after.delay_us))
    }

    /// Whether the own parts of a condition hold, of an actor by its index, or of no actor.
    pub(super) fn holds(
        &self,
        index: Option<usize>,
        when: &Condition,
        instant: &Instant<'_>,
    ) -> bool {
        let Instant { ego, bodies, .. } = *instant;
        let course_and_station = index.and_then(|index| self.progress[index].motion.course());
        let course = course_and_station.map(|(course, _)| course);
        let measures = Measures { bodies, travelled_m: &self.travelled_m, course };
        // The cheap comparisons first. The order cannot matter otherwise: none of them remembers
        // anything.
        when.time_us.is_none_or(|time_us| self.time_us >= time_us)
            && when.ego_speed_above_mps.is_none_or(|least| ego.velocity_mps.length() >= least)
            && when.after.is_none_or(|after| self.is_after(after))
            && when
                .station_m
                .is_none_or(|least_m| course_and_station.is_some_and(|(_, at_m)| at_m >= least_m))
            && self.holds_of_own(index, when, bodies)
            && when.measure.is_none_or(|measure| measures.holds(&measure))
            && when.ego_station_m.is_none_or(|least_m| {
                let station_m = index.and_then(|index| self.ego_station_m(index, instant));
                station_m.is_some_and(|at_m| at_m >= least_m)
            })
    }

    /// Whether the parts hold that are about the state of the condition's own actor.
    fn holds_of_own(
        &self,
        index: Option<usize>,
        when: &Condition,
        bodies: &[LeadCandidate],
    ) -> bool {
        let Some(index) = index else { return true };
        let state = &self.states[index];
        let speed_mps = state.velocity_mps.length();
        when.speed_above_mps.is_none_or(|least| state.present && speed_mps >= least)
            && when.speed_below_mps.is_none_or(|most| state.present && speed_mps <= most)
            && when.near.is_none_or(|near| self.is_near(index, near, bodies))
    }

    /// Whether an actor is near another, or the ego.
    fn is_near(&self, index: usize, near: Near, bodies: &[LeadCandidate]) -> bool {
        let other_m = match near.actor {
            None => Some(bodies[0].center_m),
            Some(other) => {
                let other = &self.states[other];
                // An absent actor has no place, so that it is never near.
                other.present.then_some(other.world_from_actor.position_m)
            }
        };
        let Some(other_m) = other_m else { return false };
        let state = &self.states[index];
        // While this actor has not appeared yet, its distances are measured from the place where it
        // will appear.
        let own_m = if state.present {
            state.world_from_actor.position_m
        } else {
            let motion = &self.progress[index].motion;
            motion.state(index, self.time_us, None).world_from_actor.position_m
        };
        other_m.distance(own_m) <= near.within_m
    }
}
