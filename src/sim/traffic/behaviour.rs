//! How an actor moves: its behaviour, and the state of its motion.

use std::sync::Arc;

use glam::{DQuat, DVec3};

use wildcity_scene::geometry::Pose;
use wildcity_scene::random::Random;

use super::attack::{self, Attack, Spline};
use super::course::{Course, turned_rad};
use super::follow::{CourseFollower, CourseFollowerState, Owners};
use super::lead::LeadCandidate;
use super::script::Action;
use super::state::{ActorSpec, ActorState};
use super::track::Track;

/// How an actor moves, before the episode begins.
#[derive(Clone, Debug, PartialEq)]
pub enum Behaviour {
    /// Along timed poses, whatever others do.
    Track(Arc<Track>),
    Follow(Arc<CourseFollower>),
    Attack {
        attack: Attack,
        /// Its pose at the start of the episode.
        world_from_actor: Pose,
        /// Its speed at the start, in m/s.
        speed_mps: f64,
    },
}

impl From<Track> for Behaviour {
    fn from(track: Track) -> Self {
        Self::Track(Arc::new(track))
    }
}

impl From<CourseFollower> for Behaviour {
    fn from(follower: CourseFollower) -> Self {
        Self::Follow(Arc::new(follower))
    }
}

/// A behaviour with its state. A copy shares what does not change.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Motion {
    Track(Arc<Track>),
    Follow { follower: Arc<CourseFollower>, now: CourseFollowerState },
    Attack { attack: Attack, plan: AttackPlan },
}

/// The current plan of an attacker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct AttackPlan {
    spline: Spline,
    world_from_begin: Pose,
    begin_us: i64,
    plans: usize,
}

/// A sub-step, as every actor sees it.
pub(super) struct MotionStep<'a> {
    pub(super) seed: u64,
    /// The boxes of the ego and of all present actors at its start, the ego's first.
    pub(super) bodies: &'a [LeadCandidate],
    pub(super) begin_us: i64,
    pub(super) end_us: i64,
}

impl Motion {
    pub(super) fn begin(behaviour: &Behaviour) -> Self {
        match behaviour {
            Behaviour::Track(track) => Self::Track(track.clone()),
            Behaviour::Follow(follower) => {
                Self::Follow { follower: follower.clone(), now: follower.begin() }
            }
            Behaviour::Attack { attack, world_from_actor, speed_mps } => {
                let plan = AttackPlan {
                    spline: Spline::straight(*speed_mps),
                    world_from_begin: *world_from_actor,
                    begin_us: 0,
                    plans: 0,
                };
                Self::Attack { attack: *attack, plan }
            }
        }
    }

    /// The course that the actor is on, and where on it, in metres; `None` without a course.
    pub(super) fn course(&self) -> Option<(&Course, f64)> {
        match self {
            Self::Follow { follower, now } => Some((follower.course(now), now.station_m)),
            Self::Track(_) | Self::Attack { .. } => None,
        }
    }

    /// The triggers whose changes are under way: none without a course.
    pub(super) fn owners(&self) -> Owners {
        match self {
            Self::Follow { now, .. } => now.by,
            Self::Track(_) | Self::Attack { .. } => Owners::default(),
        }
    }

    /// Carries out an action of a trigger of the actor's script.
    pub(super) fn act(&mut self, action: Action, trigger: usize) {
        match self {
            Self::Follow { follower, now } => *now = follower.with_action(now, action, trigger),
            // The scenario's check refuses such scripts.
            Self::Track(_) | Self::Attack { .. } => {}
        }
    }

    /// Advances the motion, and says whether the actor stays in the world. `before` is its state at
    /// the start of the sub-step.
    pub(super) fn advance(
        &mut self,
        step: &MotionStep<'_>,
        spec: &ActorSpec,
        before: &ActorState,
    ) -> bool {
        let MotionStep { seed, bodies, begin_us, end_us } = *step;
        match self {
            // The pose of a track follows from the time alone.
            Self::Track(_) => {}
            Self::Follow { follower, now } => {
                let duration_s = (end_us - begin_us) as f64 * 1e-6;
                match follower.after(now, &spec.box_, before.index, bodies, duration_s) {
                    Some(next) => *now = next,
                    None => return false,
                }
            }
            Self::Attack { attack, plan } => {
                // The motion before the first plan is a straight line that no plan chose, so the
                // first is due at once.
                let is_first = plan.plans == 0;
                let is_due = begin_us.saturating_sub(plan.begin_us) >= attack.plan_us;
                if before.present && (is_first || is_due) {
                    *plan = plan.plan_next(seed, attack, &spec.name, before, bodies, begin_us);
                } else if !before.present {
                    // An attacker that is absent postpones its plan, so that it does not begin in
                    // the middle of one.
                    plan.begin_us = begin_us;
                }
            }
        }
        true
    }

    /// The state at a time. `before` is the previous pose, and the time since then in seconds.
    pub(super) fn state(
        &self,
        index: usize,
        time_us: i64,
        before: Option<(Pose, f64)>,
    ) -> ActorState {
        match self {
            Self::Track(track) => match track.at(time_us) {
                None => absent(index),
                Some(at) => ActorState {
                    index: index as u16,
                    world_from_actor: at.world_from_actor,
                    velocity_mps: at.velocity_mps,
                    yaw_rate_radps: at.yaw_rate_radps,
                    present: true,
                },
            },
            Self::Follow { follower, now } => follower.state(index as u16, now, before),
            Self::Attack { plan, .. } => plan.state(index, time_us, before),
        }
    }
}

impl AttackPlan {
    /// The next plan from where the attacker is.
    fn plan_next(
        &self,
        seed: u64,
        attack: &Attack,
        name: &str,
        own: &ActorState,
        bodies: &[LeadCandidate],
        time_us: i64,
    ) -> Self {
        let begin = own.world_from_actor;
        // Along its own axis, so that it may be negative.
        let speed_mps = own.velocity_mps.dot(begin.rotation * DVec3::X);
        let begin_from_world = begin.inverse();
        let predicted = |body: &LeadCandidate| {
            let at_m = begin_from_world.transform_point(body.center_m).truncate();
            let velocity_mps = (begin_from_world.rotation * body.velocity_mps).truncate();
            attack::predicted(at_m, velocity_mps, body.yaw_rate_radps)
        };
        // The ego is first in `bodies`. The attacker's own box is among the others and is no
        // neighbour.
        let attacked = predicted(&bodies[0]);
        let others = bodies[1..].iter().filter(|body| body.actor != Some(own.index));
        let neighbours: Vec<attack::Points> = others.map(predicted).collect();
        let candidates = attack::candidates(speed_mps);
        let points: Vec<attack::Points> = candidates.iter().map(Spline::points_m).collect();
        let costs = attack::costs_m(&points, &attacked, &neighbours);
        let mut plans: Vec<(f64, Spline)> = costs.into_iter().zip(candidates).collect();
        // A stable sort: equal costs keep the order of the candidates.
        plans.sort_by(|a, b| a.0.total_cmp(&b.0));
        // A stream for each plan of each attacker: `plans` is the number of the draw.
        let mut random = Random::new(seed, &format!("attack/{name}"), self.plans);
        // No drivable plan is left: it goes straight on.
        let spline = match attack.best.min(plans.len()) {
            0 => Spline::straight(speed_mps),
            count => plans[random.below(count)].1,
        };
        Self { spline, world_from_begin: begin, begin_us: time_us, plans: self.plans + 1 }
    }

    fn state(&self, index: usize, time_us: i64, before: Option<(Pose, f64)>) -> ActorState {
        let since_s = (time_us - self.begin_us) as f64 * 1e-6;
        let at_m = self.spline.position_m(since_s);
        let velocity = self.spline.velocity_mps(since_s);
        let begin = &self.world_from_begin;
        let velocity_mps = begin.rotation * velocity.extend(0.0);
        // The heading is the direction of motion, backwards at a negative speed; below 0.1 m/s it
        // stays.
        let ahead = if velocity.x < 0.0 { -velocity } else { velocity };
        let rotation = if velocity.length() < 0.1 {
            before.map_or(begin.rotation, |(before, _)| before.rotation)
        } else {
            begin.rotation * DQuat::from_rotation_z(ahead.to_angle())
        };
        let pose = Pose {
            position_m: begin.transform_point(at_m.extend(0.0)),
            rotation: rotation.normalize(),
        };
        // At the start there is no earlier pose to turn from.
        let yaw_rate_radps = before.map_or(0.0, |(before, duration_s)| {
            turned_rad(before.rotation, pose.rotation) / duration_s
        });
        ActorState {
            index: index as u16,
            world_from_actor: pose,
            velocity_mps,
            yaw_rate_radps,
            present: true,
        }
    }
}

pub(super) fn absent(index: usize) -> ActorState {
    ActorState {
        index: index as u16,
        world_from_actor: Pose::IDENTITY,
        velocity_mps: DVec3::ZERO,
        yaw_rate_radps: 0.0,
        present: false,
    }
}
