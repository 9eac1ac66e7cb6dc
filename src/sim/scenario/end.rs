//! When an episode ends of its own accord.

use glam::DVec3;

use super::file::ContactRule;
use crate::limits;

/// The rules of a scenario.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EndRules {
    /// After this time, in microseconds.
    pub time_us: Option<i64>,
    /// Farther than this from the route, in metres.
    pub off_route_m: Option<f64>,
    /// At a contact of this kind.
    pub contact: Option<ContactRule>,
    /// Slower than [`limits::STUCK_M_S`] for this time, in microseconds.
    pub stuck_us: Option<i64>,
    /// Whether the end of the route ends the episode.
    pub route_done: bool,
}

/// Why an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EndReason {
    /// Its time is over.
    Time,
    /// The ego left its route.
    OffRoute,
    /// The ego touched an actor or the twin.
    Contact,
    /// The ego stood for too long.
    Stuck,
    RouteDone,
    /// The scenario's own condition holds.
    Condition,
}

/// The values that the rules test after a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EndInput {
    /// Time since the episode's start, in microseconds.
    pub time_us: i64,
    /// The ego's velocity, in m/s.
    pub velocity_mps: DVec3,
    /// Distance from the route, in metres; `None` without a route.
    pub off_route_m: Option<f64>,
    /// Whether the route is done.
    pub is_route_done: bool,
    /// Whether a contact of the kind that the rule names began in this step.
    pub has_contact: bool,
    /// Whether the scenario's own condition has held.
    pub has_held: bool,
}

/// How long the ego has been slow.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Stuck {
    since_us: Option<i64>,
}

impl EndReason {
    /// The name on the wire and in records.
    pub fn name(self) -> &'static str {
        match self {
            Self::Time => "time",
            Self::OffRoute => "off_route",
            Self::Contact => "contact",
            Self::Stuck => "stuck",
            Self::RouteDone => "route_done",
            Self::Condition => "condition",
        }
    }

    /// Whether the ego failed: neither did it arrive, nor was the scenario over.
    pub fn is_failure(self) -> bool {
        !matches!(self, Self::Time | Self::RouteDone | Self::Condition)
    }
}

impl EndRules {
    /// Whether an episode ends after a step; of several reasons the first of: contact, off the
    /// route, stuck, route done, the scenario's condition, time.
    pub fn ended(&self, input: &EndInput, stuck: &mut Stuck) -> Option<EndReason> {
        let is_slow = input.velocity_mps.length() < limits::STUCK_M_S;
        // The first slow step starts the time; one that is not slow clears it.
        stuck.since_us = is_slow.then(|| stuck.since_us.unwrap_or(input.time_us));
        // -1 for an ego that moves, so that even a limit of 0 µs does not end it.
        let slow_us = stuck.since_us.map_or(-1, |since_us| input.time_us - since_us);
        let off_route =
            self.off_route_m.zip(input.off_route_m).is_some_and(|(most, off)| off > most);
        // In order of severity: an ego that arrives with a contact has not passed.
        let holds = [
            (EndReason::Contact, self.contact.is_some() && input.has_contact),
            (EndReason::OffRoute, off_route),
            (EndReason::Stuck, self.stuck_us.is_some_and(|most_us| slow_us >= most_us)),
            (EndReason::RouteDone, self.route_done && input.is_route_done),
            (EndReason::Condition, input.has_held),
            (EndReason::Time, self.time_us.is_some_and(|end_us| input.time_us >= end_us)),
        ];
        holds.into_iter().find(|(_, holds)| *holds).map(|(reason, _)| reason)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(time_us: i64, speed_mps: f64) -> EndInput {
        EndInput {
            time_us,
            velocity_mps: speed_mps * DVec3::X,
            off_route_m: Some(2.0),
            is_route_done: false,
            has_contact: false,
            has_held: false,
        }
    }

    #[test]
    fn each_rule_ends_an_episode_at_its_bound() {
        let stuck = &mut Stuck::default();
        let none = EndRules::default();
        assert_eq!(none.ended(&after(i64::MAX, 0.0), stuck), None);
        let rules = EndRules { time_us: Some(1000), off_route_m: Some(2.0), ..none };
        assert_eq!(rules.ended(&after(999, 5.0), stuck), None);
        assert_eq!(rules.ended(&after(1000, 5.0), stuck), Some(EndReason::Time));
        let off = EndInput { off_route_m: Some(2.001), ..after(1000, 5.0) };
        assert_eq!(rules.ended(&off, stuck), Some(EndReason::OffRoute));
        let contact = EndInput { has_contact: true, ..off };
        assert_eq!(rules.ended(&contact, stuck), Some(EndReason::OffRoute), "no such rule");
        let rules = EndRules { contact: Some(ContactRule::Any), route_done: true, ..rules };
        assert_eq!(rules.ended(&contact, stuck), Some(EndReason::Contact));
        let done = EndInput { is_route_done: true, ..after(1, 5.0) };
        assert_eq!(rules.ended(&done, stuck), Some(EndReason::RouteDone));
        let held = EndInput { has_held: true, ..after(1000, 5.0) };
        assert_eq!(rules.ended(&held, stuck), Some(EndReason::Condition), "before its time");
        assert!(!EndReason::Condition.is_failure());
    }

    #[test]
    fn stuck_counts_from_the_last_motion() {
        let rules = EndRules { stuck_us: Some(200), ..EndRules::default() };
        let stuck = &mut Stuck::default();
        // 0.1 m/s is not slow, so the time starts again at 300 µs and is over at 500 µs.
        let ended = [(100, 0.0), (200, 0.1), (300, 0.09), (400, 0.0), (500, 0.0)]
            .map(|(time_us, speed_mps)| rules.ended(&after(time_us, speed_mps), stuck));
        assert_eq!(ended, [None, None, None, None, Some(EndReason::Stuck)]);
    }
}
