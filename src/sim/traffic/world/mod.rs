//! The traffic of an episode: all actors, advanced together.
//!
//! A step is cut into equal sub-steps of at most 10 ms. Each evaluates the triggers first, in the
//! order of the actors and of their scripts, and then moves every actor. Triggers and actors read
//! only the states at the start of the sub-step, and each actor has its own stream of random
//! numbers. So the order of the actors cannot matter.

mod conditions;
mod progress;
mod triggers;

use std::ops::ControlFlow;
use std::sync::Arc;

use self::progress::{ActorProgress, FiredTrigger};
use self::triggers::EndState;
use super::behaviour::{Behaviour, Motion, MotionStep, absent};
use super::ego_motion::EgoMotion;
use super::lead::LeadCandidate;
use super::script::{Condition, Phase, Trigger};
use super::state::{ActorSpec, ActorState, EgoBox, EgoState, SubStep};
use super::waiting::{Waiting, waiting};

pub use self::triggers::Firing;

/// The actors of an episode before it begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Traffic {
    /// Seed of every stream of random numbers.
    pub seed: u64,
    pub ego_box: EgoBox,
    /// The actors; at most [`ACTORS`](crate::limits::ACTORS).
    pub actors: Vec<Actor>,
    /// Ends the episode when it holds. It has no actor of its own.
    pub end: Option<Condition>,
}

/// An actor before the episode begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Actor {
    /// Name, class, box and asset.
    pub spec: ActorSpec,
    pub behaviour: Behaviour,
    /// Its conditions and the actions that follow.
    pub script: Vec<Trigger>,
    /// Whether it is present from the start; otherwise it waits for [`Action::Spawn`](super::Action::Spawn).
    pub present: bool,
}

/// The actors of an episode at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct World {
    traffic: Arc<Traffic>,
    time_us: i64,
    states: Vec<ActorState>,
    progress: Vec<ActorProgress>,
    /// The distances driven since the start: by the ego, then by each actor, in metres.
    travelled_m: Vec<f64>,
    /// The triggers that have not fired.
    waiting: Vec<Waiting>,
    /// The triggers that have fired, and whose actions have not ended: actor and trigger.
    under_way: Vec<(u16, u16)>,
    /// The triggers that fired in the last step.
    firings: Vec<Firing>,
    end: EndState,
}

impl World {
    /// The world at the start of an episode, at time 0.
    pub fn new(traffic: Arc<Traffic>) -> Self {
        let progress: Vec<ActorProgress> = traffic.actors.iter().map(ActorProgress::new).collect();
        let states = progress
            .iter()
            .enumerate()
            // An actor that is not there yet has a state as well, so that the list stays in order
            // of the indices.
            .map(|(index, progress)| {
                if progress.spawned { progress.motion.state(index, 0, None) } else { absent(index) }
            })
            .collect();
        let travelled_m = vec![0.0; progress.len() + 1];
        let waiting = waiting(traffic.actors.iter().map(|actor| &actor.script));
        Self {
            traffic,
            time_us: 0,
            states,
            progress,
            travelled_m,
            waiting,
            under_way: Vec::new(),
            firings: Vec::new(),
            end: EndState::default(),
        }
    }

    /// Bytes that a copy does not share with its original, without the values that conditions
    /// remember, and without the triggers that are under way or fired in the last step.
    pub fn copied_bytes(&self) -> usize {
        let triggers: usize = self.progress.iter().map(|actor| actor.fired.len()).sum();
        size_of_val(&*self.states)
            + size_of_val(&*self.progress)
            + triggers * size_of::<FiredTrigger>()
            + size_of_val(&*self.travelled_m)
            + size_of_val(&*self.waiting)
    }

    /// The actors as they were set up.
    pub fn traffic(&self) -> &Traffic {
        &self.traffic
    }

    /// Time since the episode's start, in microseconds.
    pub fn time_us(&self) -> i64 {
        self.time_us
    }

    /// The actors now, in order of their index.
    pub fn states(&self) -> &[ActorState] {
        &self.states
    }

    /// The actors at a time before the episode's start, in a warm-up: tracks at their own times,
    /// others in their starting state.
    pub fn states_before(&self, time_us: i64) -> Vec<ActorState> {
        let actors = self.traffic.actors.iter().enumerate();
        actors
            .map(|(index, actor)| {
                let motion = Motion::begin(&actor.behaviour);
                let time_us = if matches!(motion, Motion::Track(_)) { time_us.min(0) } else { 0 };
                if actor.present { motion.state(index, time_us, None) } else { absent(index) }
            })
            .collect()
    }

    /// When a trigger fired, in microseconds; `None` if it has not.
    pub fn fired_us(&self, actor: usize, trigger: usize) -> Option<i64> {
        self.progress.get(actor)?.fired.get(trigger)?.fired_us
    }

    /// The triggers that fired in the last step, by time; at one time in the order of the actors
    /// and of their scripts.
    pub fn firings(&self) -> &[Firing] {
        &self.firings
    }

    /// When the condition held that ends the episode, in microseconds; `None` if it has not.
    pub fn end_us(&self) -> Option<i64> {
        self.end.held_us
    }

    /// When the actions of a trigger had ended, in microseconds; `None` before. `Phase::Done`
    /// leaves out those that another trigger replaced.
    pub fn ended_us(&self, actor: usize, trigger: usize, phase: Phase) -> Option<i64> {
        let fired = self.progress.get(actor)?.fired.get(trigger)?;
        match phase {
            Phase::Fired => fired.fired_us,
            Phase::Done => fired.ended_us.filter(|_| !fired.is_replaced),
            Phase::Ended => fired.ended_us,
        }
    }

    /// Advances all actors by `dt_us` microseconds, above 0, in which the ego moves as given. Calls
    /// `each` after each sub-step.
    pub fn step(&mut self, dt_us: i64, ego: &EgoMotion, each: &mut dyn FnMut(&SubStep<'_>)) {
        let mut go_on = |sub_step: &SubStep<'_>| {
            each(sub_step);
            ControlFlow::Continue(())
        };
        // It never breaks off.
        let _done = self.step_while(dt_us, ego, &mut go_on);
    }

    /// As [`Self::step`], as long as `each` says so. A world whose step broke off is of no use.
    pub fn step_while(
        &mut self,
        dt_us: i64,
        ego: &EgoMotion,
        each: &mut dyn FnMut(&SubStep<'_>) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        self.firings.clear();
        // A handle of its own, since `self` is changed while the actors' parameters are read.
        let traffic = self.traffic.clone();
        let begin_us = self.time_us;
        let mut ego_now = ego.from;
        for (since_us, ego_next) in ego.sub_steps(dt_us) {
            let sub_begin_us = self.time_us;
            let sub_end_us = begin_us.saturating_add(since_us);
            // Everything below reads these bodies and `states`: the instant at the start of the
            // sub-step.
            let bodies = self.bodies(&ego_now);
            self.look_for_end(&traffic, &ego_now, &bodies);
            self.fire(&traffic, &ego_now, &bodies);
            // Taken instead of borrowed, because `advance_actors` changes the progress of `self`.
            let before = std::mem::take(&mut self.states);
            let after = self.advance_actors(&traffic, &before, &bodies, sub_end_us);
            // After the motion: an action may end within the sub-step in which it began.
            self.note_ends(sub_end_us);
            self.travel([&ego_now, &ego_next], &before, &after);
            each(&SubStep {
                begin_us: sub_begin_us,
                end_us: sub_end_us,
                ego: [ego_now, ego_next],
                before: &before,
                after: &after,
            })?;
            self.states = after;
            self.time_us = sub_end_us;
            ego_now = ego_next;
        }
        // At the end of the step too, so that the step in which the condition holds is the last
        // one.
        if traffic.end.is_some() {
            let bodies = self.bodies(&ego_now);
            self.look_for_end(&traffic, &ego_now, &bodies);
        }
        ControlFlow::Continue(())
    }

    /// The boxes of the ego and of all present actors, the ego's first.
    fn bodies(&self, ego: &EgoState) -> Vec<LeadCandidate> {
        let present = self.states.iter().filter(|state| state.present);
        let actors = &self.traffic.actors;
        let boxes = present
            .map(|state| LeadCandidate::from_actor(&actors[usize::from(state.index)].spec, state));
        std::iter::once(LeadCandidate::from_ego(ego, &self.traffic.ego_box)).chain(boxes).collect()
    }

    /// Adds the ways of a sub-step.
    fn travel(&mut self, ego: [&EgoState; 2], before: &[ActorState], after: &[ActorState]) {
        let [from, to] = ego.map(|ego| ego.world_from_rig.position_m);
        self.travelled_m[0] += from.distance(to);
        for (index, (from, to)) in before.iter().zip(after).enumerate() {
            // An actor that appears or disappears in this sub-step has no way in it.
            if from.present && to.present {
                let [from, to] = [from, to].map(|state| state.world_from_actor.position_m);
                self.travelled_m[index + 1] += from.distance(to);
            }
        }
    }

    /// Advances all actors to the end of a sub-step. Returns their states then.
    fn advance_actors(
        &mut self,
        traffic: &Traffic,
        before: &[ActorState],
        bodies: &[LeadCandidate],
        end_us: i64,
    ) -> Vec<ActorState> {
        let begin_us = self.time_us;
        let duration_s = (end_us - begin_us) as f64 * 1e-6;
        let actors = traffic.actors.iter().zip(&mut self.progress).enumerate();
        actors
            .map(|(index, (actor, progress))| {
                if !progress.spawned {
                    return absent(index);
                }
                let state = &before[index];
                let step = MotionStep { seed: traffic.seed, bodies, begin_us, end_us };
                progress.spawned = progress.motion.advance(&step, &actor.spec, state);
                if progress.spawned {
                    // Without a previous pose, the yaw rate of the first sub-step is 0.
                    let before = state.present.then_some((state.world_from_actor, duration_s));
                    progress.motion.state(index, end_us, before)
                } else {
                    absent(index)
                }
            })
            .collect()
    }
}
