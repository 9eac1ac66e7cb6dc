//! Actors that follow a course: at a speed of their own, or by the Intelligent Driver Model.

use std::sync::Arc;

use glam::{DQuat, DVec3};

use wildcity_scene::ActorBox;
use wildcity_scene::geometry::Pose;

use super::course::{Course, flat, turned_rad};
use super::distance::Place;
use super::idm::{Idm, rolled};
use super::lateral::Lateral;
use super::lead::{Corridor, Lead, LeadCandidate, lead_ahead};
use super::script::Action;
use super::speed::{SpeedCommand, SpeedMatch, SpeedProfile};
use super::state::ActorState;
use crate::limits;

/// An actor that follows a course: its parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct CourseFollower {
    /// The courses of the actor: it begins on the first, and actions name the others.
    pub courses: Vec<Arc<Course>>,
    /// Where it starts, in metres along the first course.
    pub station_m: f64,
    /// Its offset to the left of the course, in metres.
    pub offset_m: f64,
    /// Its speed at the start, in m/s.
    pub speed_mps: f64,
    /// Car-following model. Without it, the actor keeps its own speed and ignores all others.
    pub idm: Option<Idm>,
    /// Whether it disappears at the end of its course. Otherwise it stops at the end.
    pub leaves: bool,
}

/// The state of an actor on its course.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct CourseFollowerState {
    course: usize,
    pub(super) station_m: f64,
    pub(super) speed_mps: f64,
    /// Desired speed on a free road, in m/s.
    free_flow_speed_mps: f64,
    /// The change of speed that a script has commanded and that is not complete.
    speed_command: Option<SpeedCommand>,
    lateral: Lateral,
    /// The triggers whose changes are under way.
    pub(super) by: Owners,
    /// Station at which the action that chose the course is done, in metres.
    course_done_m: f64,
}

/// The triggers whose changes of speed, offset and course are under way, by their indices in the
/// script.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Owners {
    pub(super) speed: Option<usize>,
    pub(super) offset: Option<usize>,
    pub(super) course: Option<usize>,
}

impl Owners {
    /// Whether a trigger has a change that is under way.
    pub(super) fn has(&self, trigger: usize) -> bool {
        [self.speed, self.offset, self.course].contains(&Some(trigger))
    }

    /// Whether a trigger has a change here that it has no longer there.
    pub(super) fn loses(&self, after: &Self, trigger: usize) -> bool {
        let pairs =
            [(self.speed, after.speed), (self.offset, after.offset), (self.course, after.course)];
        pairs.iter().any(|(before, after)| *before == Some(trigger) && before != after)
    }
}

impl CourseFollower {
    /// The state at the start of the episode.
    pub(super) fn begin(&self) -> CourseFollowerState {
        CourseFollowerState {
            course: 0,
            station_m: self.station_m,
            speed_mps: self.speed_mps,
            // With the model the actor aims at the model's speed on a free road, and else keeps its
            // own.
            free_flow_speed_mps: self.idm.map_or(self.speed_mps, |idm| idm.free_speed_mps),
            speed_command: None,
            lateral: Lateral::at(self.offset_m),
            by: Owners::default(),
            course_done_m: 0.0,
        }
    }

    /// The course that the actor is on.
    pub(super) fn course(&self, now: &CourseFollowerState) -> &Course {
        &self.courses[now.course]
    }

    /// The state after an action of a trigger of the actor's script.
    pub(super) fn with_action(
        &self,
        now: &CourseFollowerState,
        action: Action,
        trigger: usize,
    ) -> CourseFollowerState {
        let mut next = *now;
        match action {
            Action::Speed { to_mps, rate_mps2 } => {
                next.command(SpeedCommand::To { to_mps, rate_mps2 }, trigger);
            }
            Action::SpeedProfile { to_mps, over, shape } => {
                let profile = SpeedProfile::new(now.speed_mps, to_mps, over, shape);
                next.command(SpeedCommand::Profile(profile), trigger);
            }
            Action::SpeedMatch { of, factor, delta_mps } => {
                let matched = SpeedMatch { of, factor, delta_mps };
                next.command(SpeedCommand::Match(matched), trigger);
            }
            Action::KeepDistance(keep) => next.command(SpeedCommand::Keep(keep), trigger),
            Action::ArriveTogether(arrive) => next.command(SpeedCommand::Arrive(arrive), trigger),
            Action::Offset { to_m, over_s } => {
                next.lateral = now.lateral.moving_to(to_m, over_s, now.speed_mps);
                next.by.offset = Some(trigger);
            }
            Action::OffsetProfile { to_m, over, shape } => {
                next.lateral = now.lateral.by_profile(to_m, over, shape);
                next.by.offset = Some(trigger);
            }
            Action::Course { course, done_m, at_m } => {
                // The place before the change, so that the actor continues from where it is.
                let place_m = self.pose(now).position_m;
                let beside = self.courses[course].nearest(place_m);
                next.course = course;
                next.station_m = at_m.unwrap_or(beside.station_m);
                // An actor that is put somewhere starts on the line. One that continues keeps its
                // offset, so that it does not jump.
                next.lateral = Lateral::at(if at_m.is_some() { 0.0 } else { beside.left_m });
                // A change of offset belongs to the old course, and ends with it.
                next.by.offset = None;
                next.by.course = done_m.map(|_| trigger);
                next.course_done_m = done_m.unwrap_or(0.0);
            }
            Action::Halt { trigger: halted } => next.halt(halted),
            Action::Spawn | Action::Remove => {}
        }
        next
    }

    /// The state after a sub-step. `None` if the actor has left.
    pub(super) fn after(
        &self,
        now: &CourseFollowerState,
        box_: &ActorBox,
        own: u16,
        bodies: &[LeadCandidate],
        duration_s: f64,
    ) -> Option<CourseFollowerState> {
        let course = self.course(now);
        let mut now = *now;
        let mut place = self.place(&now, box_);
        // A distance without bounds is met before anything else, so that lead and speed below are
        // those of the new place.
        if let Some(SpeedCommand::Keep(keep)) = &now.speed_command
            && let Some(missing) = keep.jump(&place, bodies)
        {
            now.station_m = (now.station_m + missing.way_m).clamp(0.0, course.length_m());
            now.speed_mps = missing.speed_mps.clamp(0.0, limits::ACTOR_SPEED_M_S);
            place = self.place(&now, box_);
        }
        let now = &now;
        let lead = self.idm.and_then(|idm| self.lead(now, &idm, box_, own, bodies));
        let acceleration = self.acceleration(now, &place, lead, bodies, duration_s);
        let [way_m, speed_mps] = rolled(now.speed_mps, acceleration, duration_s);

        // A line that lies d to the left of one with curvature k is (1 - k d) as long.
        let stretch = 1.0 - course.curvature_1_m(now.station_m) * now.lateral.offset_m();
        // At least 0.1, because the line has no length at the centre of the curve and the station
        // would jump.
        let station_m = now.station_m + way_m / stretch.max(0.1);
        // The mean of both speeds, as for the way of a constant acceleration.
        let lateral = now.lateral.after(duration_s, 0.5 * (now.speed_mps + speed_mps));
        let speed_command = now.speed_command.map(|command| command.after(duration_s));
        let is_over =
            speed_command.is_none_or(|command| command.is_over(&place, speed_mps, bodies));
        // A command to stop holds the actor until the next one.
        let is_kept = |command: &SpeedCommand| command.aim_mps() == Some(0.0) || !is_over;
        let speed_command = speed_command.filter(is_kept);
        let by = Owners {
            // A change that is over has no owner, from which triggers see that it has ended.
            speed: now.by.speed.filter(|_| !is_over),
            offset: now.by.offset.filter(|_| lateral.is_moving()),
            course: now.by.course.filter(|_| station_m < now.course_done_m),
        };
        let next = CourseFollowerState { station_m, speed_mps, lateral, speed_command, by, ..*now };
        let length_m = course.length_m();
        match (station_m >= length_m, self.leaves) {
            (false, _) => Some(next),
            (true, true) => None,
            (true, false) => {
                Some(CourseFollowerState { station_m: length_m, speed_mps: 0.0, ..next })
            }
        }
    }

    /// Acceleration in m/s²: that of the model, that of a speed command, or the lesser of both.
    fn acceleration(
        &self,
        now: &CourseFollowerState,
        place: &Place<'_>,
        lead: Option<Lead>,
        bodies: &[LeadCandidate],
        duration_s: f64,
    ) -> f64 {
        let commanded =
            now.speed_command.map(|command| command.acceleration_mps2(place, duration_s, bodies));
        let Some(idm) = self.idm else { return commanded.unwrap_or(0.0) };
        // Without a lead the gap is infinite and its term vanishes, whatever the speed.
        let lead = lead.unwrap_or(Lead { gap_m: f64::INFINITY, speed_mps: now.speed_mps });
        // During a commanded change to a lower speed, the free-road term would brake at its own
        // rate.
        let free_speed_mps = now.free_flow_speed_mps.max(commanded.map_or(0.0, |_| now.speed_mps));
        let model = Idm { free_speed_mps, ..idm };
        let followed = model.acceleration(now.speed_mps, lead.speed_mps, lead.gap_m);
        commanded.map_or(followed, |commanded| commanded.min(followed))
    }

    /// Returns what the actor follows: the nearest box in its corridor, or the end of its course,
    /// which acts as a standing lead.
    fn lead(
        &self,
        now: &CourseFollowerState,
        idm: &Idm,
        box_: &ActorBox,
        own: u16,
        bodies: &[LeadCandidate],
    ) -> Option<Lead> {
        let course = self.course(now);
        let [least_m, most_m] = limits::LEAD_M;
        let half_width_m = 0.5 * box_.width_m;
        let offset_m = now.lateral.offset_m();
        let target_m = now.lateral.target_m();
        let corridor = Corridor {
            station_m: now.station_m,
            // From the present offset to the aimed one, so that a lane change sees both lanes.
            edges_m: [offset_m.min(target_m) - half_width_m, offset_m.max(target_m) + half_width_m],
            half_length_m: 0.5 * box_.length_m,
            height_m: box_.height_m,
            ahead_m: (limits::LEAD_GAPS * idm.desired_gap_m(now.speed_mps, 0.0))
                .clamp(least_m, most_m),
        };
        let body = lead_ahead(course, &corridor, own, bodies);
        if self.leaves {
            // No wall at the end of the course for an actor that drives out of the world.
            return body;
        }
        let gap_m = course.length_m() - now.station_m - corridor.half_length_m;
        let end = Lead { gap_m, speed_mps: 0.0 };
        // The nearer of both; a body beyond the end of the course does not matter.
        Some(body.filter(|body| body.gap_m <= end.gap_m).unwrap_or(end))
    }

    /// Where an actor is in a state, for its changes of speed.
    fn place(&self, at: &CourseFollowerState, box_: &ActorBox) -> Place<'_> {
        let pose = self.pose(at);
        Place {
            course: self.course(at),
            station_m: at.station_m,
            center_m: pose.position_m,
            forward: flat(pose.rotation * DVec3::X).normalize_or_zero(),
            half_length_m: 0.5 * box_.length_m,
            speed_mps: at.speed_mps,
        }
    }

    /// The pose of an actor in a state.
    fn pose(&self, at: &CourseFollowerState) -> Pose {
        let on_course = self.course(at).at(at.station_m);
        let offset_m = at.lateral.offset_m();
        let rate_mps = at.lateral.rate_mps(at.speed_mps);
        let position_m = on_course.position_m + on_course.rotation * (offset_m * DVec3::Y);
        // Exactly the course's rotation without a manoeuvre: a product would change its last bits.
        let rotation = if rate_mps == 0.0 {
            on_course.rotation
        } else {
            // The heading is the direction of motion: `atan(lateral / forward)`, small because the
            // manoeuvre slows with the actor.
            on_course.rotation * DQuat::from_rotation_z(rate_mps.atan2(at.speed_mps))
        };
        Pose { position_m, rotation: rotation.normalize() }
    }

    /// The actor in a state. `before` is the previous pose, and the time since then in seconds.
    pub(super) fn state(
        &self,
        index: u16,
        at: &CourseFollowerState,
        before: Option<(Pose, f64)>,
    ) -> ActorState {
        let pose = self.pose(at);
        let rate_mps = at.lateral.rate_mps(at.speed_mps);
        let speed_mps = at.speed_mps.hypot(rate_mps);
        let yaw_rate_radps = before.map_or(0.0, |(before, duration_s)| {
            turned_rad(before.rotation, pose.rotation) / duration_s
        });
        ActorState {
            index,
            world_from_actor: pose,
            velocity_mps: pose.rotation * (speed_mps * DVec3::X),
            yaw_rate_radps,
            present: true,
        }
    }
}

impl CourseFollowerState {
    fn command(&mut self, command: SpeedCommand, trigger: usize) {
        let aim_mps = command.aim_mps().unwrap_or(self.speed_mps);
        // A stop must not become the desired speed, which the model divides by.
        if aim_mps > 0.0 {
            self.free_flow_speed_mps = aim_mps;
        }
        self.speed_command = Some(command);
        self.by.speed = Some(trigger);
    }

    /// Ends the changes of a trigger.
    fn halt(&mut self, trigger: usize) {
        if self.by.speed == Some(trigger) {
            self.speed_command = None;
            // At least 0.1 m/s, because an actor may be halted while it stands, and the model
            // divides by this speed.
            self.free_flow_speed_mps = self.speed_mps.max(0.1);
            self.by.speed = None;
        }
        if self.by.offset == Some(trigger) {
            self.lateral = Lateral::at(self.lateral.offset_m());
            self.by.offset = None;
        }
        // Only the change ends. The actor stays on the course that it has begun.
        if self.by.course == Some(trigger) {
            self.by.course = None;
        }
    }
}
