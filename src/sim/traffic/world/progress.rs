//! The progress of one actor: its motion, and what has happened to its triggers.

use crate::traffic::behaviour::Motion;
use crate::traffic::condition::ConditionState;
use crate::traffic::script::Action;

use super::Actor;

/// The progress of one actor's behaviour and script.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ActorProgress {
    /// Whether the actor is in the world. Its track may be absent at this time nevertheless.
    pub(super) spawned: bool,
    pub(super) motion: Motion,
    /// What has happened to each trigger of its script.
    pub(super) fired: Vec<FiredTrigger>,
}

/// What has happened to a trigger.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct FiredTrigger {
    /// The values of its condition.
    pub(super) condition: ConditionState,
    /// When it fired, in microseconds.
    pub(super) fired_us: Option<i64>,
    /// When all its actions had ended, in microseconds.
    pub(super) ended_us: Option<i64>,
    /// Whether another trigger replaced one of them.
    pub(super) is_replaced: bool,
}

impl ActorProgress {
    pub(super) fn new(actor: &Actor) -> Self {
        let fired = vec![FiredTrigger::default(); actor.script.len()];
        Self { spawned: actor.present, motion: Motion::begin(&actor.behaviour), fired }
    }

    /// Carries out an action of a trigger of the actor's script.
    pub(super) fn apply_action(&mut self, action: Action, trigger: usize) {
        match action {
            Action::Spawn => self.spawned = true,
            Action::Remove => self.spawned = false,
            action => {
                // Which changes were under way before, to find those that this action replaces.
                let before = self.motion.owners();
                self.motion.act(action, trigger);
                let after = self.motion.owners();
                let lost = (0..self.fired.len()).filter(|at| before.has(*at) && *at != trigger);
                for at in lost {
                    self.fired[at].is_replaced |= before.loses(&after, at);
                }
            }
        }
    }
}
