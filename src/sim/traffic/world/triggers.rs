//! Triggers that fire, their actions that end, and the condition that ends the episode.

use crate::traffic::condition::ConditionState;
use crate::traffic::follow::Owners;
use crate::traffic::lead::LeadCandidate;
use crate::traffic::script::Condition;
use crate::traffic::state::EgoState;

use super::conditions::Instant;
use super::{Traffic, World};

/// A trigger that fired in a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Firing {
    /// When it fired, in microseconds since the start of the episode.
    pub time_us: i64,
    /// Index of the actor.
    pub actor: u16,
    /// Index of the trigger within the actor's script.
    pub trigger: usize,
}

/// The values of the condition that ends the episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct EndState {
    condition: ConditionState,
    /// When it was last evaluated, in microseconds.
    last_us: Option<i64>,
    /// When it held first, in microseconds.
    pub(super) held_us: Option<i64>,
}

impl World {
    /// Evaluates the condition that ends the episode: at each instant once, as an edge or a delay
    /// remembers its values.
    pub(super) fn look_for_end(
        &mut self,
        traffic: &Traffic,
        ego: &EgoState,
        bodies: &[LeadCandidate],
    ) {
        let Some(when) = traffic.end.as_ref().filter(|_| self.end.held_us.is_none()) else {
            return;
        };
        // The end of a step is the start of the next one: the condition must not be evaluated twice
        // then.
        let is_new = self.end.last_us != Some(self.time_us);
        if !is_new || !when.after.is_none_or(|after| self.is_after(after)) {
            return;
        }
        // Moved out and back, because `holds` borrows all of `self`.
        let mut state = std::mem::take(&mut self.end.condition);
        let instant = Instant::new(ego, bodies);
        let own = |part: &Condition| self.holds(None, part, &instant);
        let holds = state.value(when, self.time_us, &own);
        let now_us = self.time_us;
        self.end =
            EndState { condition: state, last_us: Some(now_us), held_us: holds.then_some(now_us) };
    }

    /// Fires the triggers whose conditions hold at the start of the sub-step.
    pub(super) fn fire(&mut self, traffic: &Traffic, ego: &EgoState, bodies: &[LeadCandidate]) {
        // All conditions first and all actions afterwards, so that no trigger sees the effect of
        // another at the same instant.
        let mut firing: Vec<(usize, usize)> = Vec::new();
        let mut instant = Instant::new(ego, bodies);
        let mut of = 0;
        // Taken instead of borrowed, because conditions change their states.
        let mut waiting = std::mem::take(&mut self.waiting);
        waiting.retain(|waits| {
            let [index, at] = [waits.actor, waits.trigger].map(usize::from);
            if of != index {
                (instant, of) = (Instant::new(ego, bodies), index);
            }
            let is_due = self.is_open(index, &waits.gate, &instant)
                && self.is_due([index, at], &traffic.actors[index].script[at].when, &instant);
            if is_due {
                firing.push((index, at));
            }
            !is_due
        });
        self.waiting = waiting;
        for (index, at) in firing {
            let actor = &traffic.actors[index];
            self.progress[index].fired[at].fired_us = Some(self.time_us);
            self.under_way.push((index as u16, at as u16));
            let time_us = self.time_us;
            self.firings.push(Firing { time_us, actor: index as u16, trigger: at });
            for action in &actor.script[at].then {
                self.progress[index].apply_action(*action, at);
            }
        }
    }

    /// Notes the triggers all of whose actions have ended.
    pub(super) fn note_ends(&mut self, time_us: i64) {
        self.under_way.retain(|(index, at)| {
            let [index, at] = [*index, *at].map(usize::from);
            let progress = &mut self.progress[index];
            // An actor that has gone has nothing under way.
            let by = if progress.spawned { progress.motion.owners() } else { Owners::default() };
            let is_under_way = by.has(at);
            if !is_under_way {
                progress.fired[at].ended_us = Some(time_us);
            }
            is_under_way
        });
    }
}
