//! The triggers that have not fired yet, each with what it waits for.
//!
//! A scenario may have 16,384 triggers, and each is asked at every sub-step. A condition with its
//! state is a kilobyte, so that reading all of them would take longer than anything else. What most
//! of them wait for fits into a few bytes, and these are in one list.

use super::script::{After, Condition, Near, Trigger};

/// A trigger that has not fired.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Waiting {
    pub(super) actor: u16,
    /// Index within the actor's script.
    pub(super) trigger: u16,
    pub(super) gate: Gate,
}

/// A part of a condition without which the condition does not hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Gate {
    /// From this time on, in microseconds.
    Time(i64),
    After(After),
    /// The ego is at this station of the actor's course, in metres, or beyond.
    EgoStation(f64),
    /// The actor is at this station of its course, in metres, or beyond.
    Station(f64),
    /// The ego is at least this fast, in m/s.
    EgoSpeed(f64),
    Near(Near),
    /// The condition has to be evaluated.
    Open,
}

impl Gate {
    fn new(when: &Condition) -> Self {
        // Edges and delays count from then on, so that nothing else of the condition is evaluated
        // before.
        if let Some(after) = when.after {
            return Self::After(after);
        }
        // Whatever remembers its values is evaluated each time.
        if !is_plain(when) {
            return Self::Open;
        }
        let gates = [
            when.time_us.map(Self::Time),
            when.ego_station_m.map(Self::EgoStation),
            when.station_m.map(Self::Station),
            when.ego_speed_above_mps.map(Self::EgoSpeed),
            when.near.map(Self::Near),
        ];
        gates.into_iter().flatten().next().unwrap_or(Self::Open)
    }
}

/// Whether a condition remembers nothing: its value is that of its own parts.
pub(super) fn is_plain(when: &Condition) -> bool {
    let has_parts = !when.all.is_empty() || !when.any.is_empty();
    !has_parts && when.held_us == 0 && when.edge.is_none() && when.later_us == 0
}

/// All triggers, in the order of the actors and of their scripts.
pub(super) fn waiting<'a>(scripts: impl Iterator<Item = &'a Vec<Trigger>>) -> Vec<Waiting> {
    let triggers = scripts.enumerate().flat_map(|(actor, script)| {
        script.iter().enumerate().map(move |(at, trigger)| Waiting {
            actor: actor as u16,
            trigger: at as u16,
            gate: Gate::new(&trigger.when),
        })
    });
    triggers.collect()
}
