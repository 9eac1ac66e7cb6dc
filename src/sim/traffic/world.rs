//! The traffic of an episode: all actors, advanced together.
//!
//! A step is cut into equal sub-steps of at most 10 ms. Each evaluates the triggers first, in the
//! order of the actors and of their scripts, and then moves every actor. Triggers and actors read
//! only the states at the start of the sub-step, and each actor has its own stream of random
//! numbers. So the order of the actors cannot matter.

use std::cell::OnceCell;
use std::ops::ControlFlow;
use std::sync::Arc;

use super::behaviour::{Behaviour, Motion, MotionStep, absent};
use super::condition::{ConditionState, Measures};
use super::follow::Owners;
use super::lead::LeadCandidate;
use super::script::{Action, After, Condition, Near, Phase, Trigger};
use super::state::{ActorSpec, ActorState, EgoBox, EgoState, SubStep};
use super::waiting::{Gate, Waiting, is_plain, waiting};
use crate::limits;
use crate::{DynamicsModel, Ego};

/// The actors of an episode before it begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Traffic {
    /// Seed of every stream of random numbers.
    pub seed: u64,
    pub ego_box: EgoBox,
    /// The actors; at most [`limits::ACTORS`].
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
    /// Whether it is present from the start; otherwise it waits for [`Action::Spawn`].
    pub present: bool,
}

/// The ego's motion during one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgoMotion {
    /// At the start of the step.
    pub from: EgoState,
    /// At the end of the step.
    pub to: EgoState,
    /// Whether the velocities of both states belong to the motion between them. Then the position
    /// is the cubic with these ends. Otherwise, as for a teleport, it changes linearly.
    pub smooth: bool,
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

/// The instant at the start of a sub-step, as the conditions of one actor see it.
struct Instant<'a> {
    ego: &'a EgoState,
    bodies: &'a [LeadCandidate],
    /// Where the ego is along the actor's course, once it is known: a search along the course, and
    /// one for all triggers of the actor.
    ego_station_m: OnceCell<Option<f64>>,
}

impl<'a> Instant<'a> {
    fn new(ego: &'a EgoState, bodies: &'a [LeadCandidate]) -> Self {
        Self { ego, bodies, ego_station_m: OnceCell::new() }
    }
}

/// The values of the condition that ends the episode.
#[derive(Clone, Debug, Default, PartialEq)]
struct EndState {
    condition: ConditionState,
    /// When it was last evaluated, in microseconds.
    last_us: Option<i64>,
    /// When it held first, in microseconds.
    held_us: Option<i64>,
}

/// The progress of one actor's behaviour and script.
#[derive(Clone, Debug, PartialEq)]
struct ActorProgress {
    /// Whether the actor is in the world. Its track may be absent at this time nevertheless.
    spawned: bool,
    motion: Motion,
    /// What has happened to each trigger of its script.
    fired: Vec<FiredTrigger>,
}

/// What has happened to a trigger.
#[derive(Clone, Debug, Default, PartialEq)]
struct FiredTrigger {
    /// The values of its condition.
    condition: ConditionState,
    /// When it fired, in microseconds.
    fired_us: Option<i64>,
    /// When all its actions had ended, in microseconds.
    ended_us: Option<i64>,
    /// Whether another trigger replaced one of them.
    is_replaced: bool,
}

impl World {
    /// The world at the start of an episode, at time 0.
    pub fn new(traffic: Arc<Traffic>) -> Self {
        let progress: Vec<ActorProgress> = traffic.actors.iter().map(ActorProgress::new).collect();
        let states = progress.iter().enumerate();
        let states = states
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

    /// Evaluates the condition that ends the episode: at each instant once, as an edge or a delay
    /// remembers its values.
    fn look_for_end(&mut self, traffic: &Traffic, ego: &EgoState, bodies: &[LeadCandidate]) {
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

    /// The boxes of the ego and of all present actors, the ego's first.
    fn bodies(&self, ego: &EgoState) -> Vec<LeadCandidate> {
        let present = self.states.iter().filter(|state| state.present);
        let actors = &self.traffic.actors;
        let boxes = present
            .map(|state| LeadCandidate::from_actor(&actors[usize::from(state.index)].spec, state));
        std::iter::once(LeadCandidate::from_ego(ego, &self.traffic.ego_box)).chain(boxes).collect()
    }

    /// Fires the triggers whose conditions hold at the start of the sub-step.
    fn fire(&mut self, traffic: &Traffic, ego: &EgoState, bodies: &[LeadCandidate]) {
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

    /// Whether the gate of a trigger of an actor is open: only then its condition may hold.
    fn is_open(&self, index: usize, gate: &Gate, instant: &Instant<'_>) -> bool {
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
            Some(course.nearest(instant.bodies[0].center_m).station_m)
        })
    }

    /// Whether a trigger that has not fired fires now.
    fn is_due(&mut self, [index, at]: [usize; 2], when: &Condition, instant: &Instant<'_>) -> bool {
        // Edges and delays count from then on.
        if !when.after.is_none_or(|after| self.is_after(after)) {
            return false;
        }
        if is_plain(when) {
            return self.holds(Some(index), when, instant);
        }
        let mut state = std::mem::take(&mut self.progress[index].fired[at].condition);
        let own = |part: &Condition| self.holds(Some(index), part, instant);
        let value = state.value(when, self.time_us, &own);
        self.progress[index].fired[at].condition = state;
        value
    }

    fn is_after(&self, after: After) -> bool {
        let since_us = self.ended_us(after.actor, after.trigger, after.phase);
        since_us.is_some_and(|since_us| self.time_us >= since_us.saturating_add(after.delay_us))
    }

    /// Notes the triggers all of whose actions have ended.
    fn note_ends(&mut self, time_us: i64) {
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

    /// Whether the own parts of a condition hold, of an actor by its index, or of no actor.
    fn holds(&self, index: Option<usize>, when: &Condition, instant: &Instant<'_>) -> bool {
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

impl EgoMotion {
    /// The motion of an ego from a state to its present one.
    pub fn new(from: EgoState, to: &Ego) -> Self {
        let smooth = to.dynamics().model != DynamicsModel::Teleport;
        Self { from, to: EgoState::new(to), smooth }
    }

    /// An ego that stands.
    pub fn standing(state: EgoState) -> Self {
        Self { from: state, to: state, smooth: false }
    }

    /// Length of the straight line between its ends over the time of a step of `dt_us`, in m/s.
    pub fn mean_speed_mps(&self, dt_us: i64) -> f64 {
        let way_m = self.from.world_from_rig.position_m.distance(self.to.world_from_rig.position_m);
        way_m / (dt_us as f64 * 1e-6)
    }

    /// The ends of the sub-steps of a step of `dt_us`, above 0: the time since the start of the
    /// step, in microseconds, and the ego then.
    pub fn sub_steps(&self, dt_us: i64) -> impl Iterator<Item = (i64, EgoState)> {
        // At least one sub-step, so that the end of the step is always reached.
        let count = dt_us.max(1).unsigned_abs().div_ceil(limits::SUB_STEP_US.unsigned_abs()) as i64;
        (1..=count).map(move |sub_step| {
            // i128, since the product may overflow i64.
            let since_us = (i128::from(dt_us) * i128::from(sub_step) / i128::from(count)) as i64;
            (since_us, self.at(since_us, dt_us))
        })
    }

    /// The ego at a time of a step of `dt_us`.
    pub fn at(&self, since_us: i64, dt_us: i64) -> EgoState {
        // Exact for an ego that stands: interpolation could round.
        if since_us <= 0 || self.from == self.to {
            return self.from;
        }
        if since_us >= dt_us {
            return self.to;
        }
        // Both ends are excluded above, so that 0 < t < 1.
        let t = since_us as f64 / dt_us as f64;
        let [from, to] = [&self.from, &self.to];
        let mut pose = from.world_from_rig.interpolate(&to.world_from_rig, t);
        if self.smooth {
            let dt_s = dt_us as f64 * 1e-6;
            // Hermite's cubic: the ends' positions and velocities. On an arc its error is
            // (v dt)⁴ κ³ / 384: 0.1 mm at 10 m/s, 0.5 s and 0.05 1/m.
            pose.position_m =
                (1.0 + 2.0 * t) * (1.0 - t) * (1.0 - t) * from.world_from_rig.position_m
                    + t * t * (3.0 - 2.0 * t) * to.world_from_rig.position_m
                    + dt_s * t * (1.0 - t) * (1.0 - t) * from.velocity_mps
                    - dt_s * t * t * (1.0 - t) * to.velocity_mps;
        }
        // A teleport has one velocity, the mean over the step, so nothing is interpolated.
        let velocity_mps =
            if self.smooth { from.velocity_mps.lerp(to.velocity_mps, t) } else { to.velocity_mps };
        let yaw_rate_radps = if self.smooth {
            from.yaw_rate_radps + t * (to.yaw_rate_radps - from.yaw_rate_radps)
        } else {
            to.yaw_rate_radps
        };
        EgoState { world_from_rig: pose, velocity_mps, yaw_rate_radps }
    }
}

impl ActorProgress {
    fn new(actor: &Actor) -> Self {
        let fired = vec![FiredTrigger::default(); actor.script.len()];
        Self { spawned: actor.present, motion: Motion::begin(&actor.behaviour), fired }
    }

    /// Carries out an action of a trigger of the actor's script.
    fn apply_action(&mut self, action: Action, trigger: usize) {
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
