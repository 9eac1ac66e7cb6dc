//! Scripts of actors: what each does when a condition holds.

use std::sync::Arc;

use super::actor_file::ActorSection;
use super::condition::{References, condition};
use super::courses::Courses;
use super::error::{FileError, in_range, named};
use super::pair_action::{arrive_together, keep_distance};
use super::script_file::{ActionSection, ProfileSection, ShapeSection};
use crate::limits;
use crate::traffic::{Action, Actor, Behaviour, Over, Shape, Trigger};

/// Adds the triggers of a section to its actor, whose index is `own`.
pub(super) fn add_script(
    section: &ActorSection,
    own: usize,
    actor: &mut Actor,
    courses: &mut Courses<'_>,
    references: &References<'_>,
) -> Result<(), FileError> {
    if section.script.len() > limits::TRIGGERS {
        let message = format!("{} triggers; at most {}", section.script.len(), limits::TRIGGERS);
        return Err(FileError::new("script", message));
    }
    for (index, trigger) in section.script.iter().enumerate() {
        let path = format!("script[{index}]");
        if let Some(name) = &trigger.name {
            named(&format!("{path}.name"), name)?;
            let names = &references.triggers[own];
            // The list has this trigger's own name, too.
            if names.iter().filter(|other| *other == name).count() > 1 {
                let message = format!("{name:?} is there twice; give each trigger its own name");
                return Err(FileError::new(format!("{path}.name"), message));
            }
        }
        let when = condition(&trigger.when, Some(own), references)
            .map_err(|error| error.within(&format!("{path}.when")))?;
        // A trigger without actions is an instant that `after` may name.
        let is_empty = trigger.then.is_empty() && trigger.name.is_none();
        if is_empty || trigger.then.len() > limits::ACTIONS {
            let message = format!(
                "{} actions; 1 to {} are accepted, and none for a trigger with a name",
                trigger.then.len(),
                limits::ACTIONS
            );
            return Err(FileError::new(format!("{path}.do"), message));
        }
        // Actions stay in order: later ones replace what earlier ones of the same sub-step began.
        let mut then = Vec::with_capacity(trigger.then.len());
        for (at, action) in trigger.then.iter().enumerate() {
            // An action may add a course to the follower, and then names it by its index.
            let action = action_from(action, &mut actor.behaviour, courses, (references, own));
            then.push(action.map_err(|error| error.within(&format!("{path}.do[{at}]")))?);
        }
        actor.script.push(Trigger { when, then });
    }
    Ok(())
}

/// The aim, the extent and the shape of a change.
fn profile(section: &ProfileSection) -> Result<(Over, Shape), FileError> {
    let shape = match section.shape {
        ShapeSection::Step => Shape::Step,
        ShapeSection::Linear => Shape::Linear,
        ShapeSection::Sinusoidal => Shape::Sinusoidal,
        ShapeSection::Cubic => Shape::Cubic,
    };
    // The bounds keep a time at least as long as a sub-step of 10 ms, and a rate above 0.
    let given = [
        section.over_s.map(|s| Ok(Over::Time(in_range("over_s", s, [0.01, 1e4])?))),
        section.over_m.map(|m| Ok(Over::Distance(in_range("over_m", m, [0.01, 1e5])?))),
        section.rate.map(|rate| Ok(Over::Rate(in_range("rate", rate, [1e-3, 1e3])?))),
        section
            .acceleration
            .map(|most| Ok(Over::Acceleration(in_range("acceleration", most, [1e-3, 1e3])?))),
    ];
    let mut written = given.into_iter().flatten();
    // The first two tell whether there is none, one, or too many.
    match (shape, written.next(), written.next()) {
        (Shape::Step, None, _) => Ok((Over::Time(0.0), shape)),
        (Shape::Linear | Shape::Sinusoidal | Shape::Cubic, Some(over), None) => Ok((over?, shape)),
        _ => {
            let message =
                "write exactly one of over_s, over_m, rate and acceleration; none for step";
            Err(FileError::new("shape", message))
        }
    }
}

/// The action of a section.
fn action_from(
    section: &ActionSection,
    behaviour: &mut Behaviour,
    courses: &mut Courses<'_>,
    (references, own): (&References<'_>, usize),
) -> Result<Action, FileError> {
    let most_mps2 = limits::ACTOR_ACCELERATION_M_S2;
    let rate_of = |path: &str, rate: f64| in_range(path, rate, [0.01, most_mps2]);
    let action = match section {
        // These two are for every behaviour, so they return before the check at the end.
        ActionSection::Spawn {} => return Ok(Action::Spawn),
        ActionSection::Remove {} => return Ok(Action::Remove),
        ActionSection::Speed { to, rate } => Action::Speed {
            to_mps: in_range("speed.to", *to, [0.0, limits::ACTOR_SPEED_M_S])?,
            rate_mps2: rate_of("speed.rate", *rate)?,
        },
        ActionSection::Stop { rate } => {
            Action::Speed { to_mps: 0.0, rate_mps2: rate_of("stop.rate", *rate)? }
        }
        ActionSection::Offset { to_m, over_s } => Action::Offset {
            to_m: in_range("offset.to_m", *to_m, [-100.0, 100.0])?,
            over_s: in_range("offset.over_s", *over_s, [0.1, 1000.0])?,
        },
        ActionSection::SpeedProfile(section) => {
            let within = |error: FileError| error.within("speed_profile");
            let (over, shape) = profile(section).map_err(within)?;
            // `profile` is for speeds and offsets. A rate of speed is an acceleration already.
            if section.acceleration.is_some() {
                return Err(FileError::new(
                    "speed_profile.acceleration",
                    "is for offsets; use rate",
                ));
            }
            let to_mps = in_range("speed_profile.to", section.to, [0.0, limits::ACTOR_SPEED_M_S])?;
            Action::SpeedProfile { to_mps, over, shape }
        }
        ActionSection::SpeedMatch { of, factor, delta } => {
            let index = |name: &String| references.actor("speed_match.of", name);
            let most_mps = limits::ACTOR_SPEED_M_S;
            Action::SpeedMatch {
                of: of.as_ref().map(index).transpose()?,
                factor: in_range("speed_match.factor", factor.unwrap_or(1.0), [0.0, 100.0])?,
                delta_mps: in_range(
                    "speed_match.delta",
                    delta.unwrap_or(0.0),
                    [-most_mps, most_mps],
                )?,
            }
        }
        ActionSection::KeepDistance(section) => {
            let keep = keep_distance(section, (references, own))
                .map_err(|error| error.within("keep_distance"))?;
            // The model computes the acceleration of an IDM actor, so that a jump would break its
            // gap.
            let is_idm = matches!(behaviour, Behaviour::Follow(follow) if follow.idm.is_some());
            if is_idm && keep.bounds.is_none() {
                let message = "is missing, as is braking: an idm actor is not put anywhere at once";
                return Err(FileError::new("keep_distance.acceleration", message));
            }
            Action::KeepDistance(keep)
        }
        ActionSection::ArriveTogether(section) => {
            let arrive = arrive_together(section, (references, own));
            Action::ArriveTogether(arrive.map_err(|error| error.within("arrive_together"))?)
        }
        ActionSection::OffsetProfile(section) => {
            let within = |error: FileError| error.within("offset_profile");
            let (over, shape) = profile(section).map_err(within)?;
            let to_m = in_range("offset_profile.to", section.to, [-100.0, 100.0])?;
            Action::OffsetProfile { to_m, over, shape }
        }
        ActionSection::Halt { trigger } => {
            let found = references.triggers[own]
                .iter()
                .position(|name| !name.is_empty() && name == trigger);
            let missing = || {
                let message = format!("there is no trigger {trigger:?} of this actor");
                FileError::new("halt.trigger", message)
            };
            Action::Halt { trigger: found.ok_or_else(missing)? }
        }
        ActionSection::Path(line) => {
            let reverse = line.reverse.unwrap_or(false);
            let along = line.along.as_deref();
            let points = line.points.as_deref();
            let lanes = line.lanes.as_deref();
            let course = courses
                .line("along", along, points, lanes, reverse)
                .map_err(|error| error.within("path"))?;
            // Both places are on the line of this action and not on the present course.
            let done_m = line
                .done_m
                .map(|m| in_range("path.done_m", m, [0.0, course.length_m()]))
                .transpose()?;
            let at_m = line
                .at_m
                .map(|m| in_range("path.at_m", m, [0.0, course.length_m()]))
                .transpose()?;
            // Courses are only appended, so that the indices of earlier actions stay valid.
            if let Behaviour::Follow(follow) = behaviour {
                let follow = Arc::make_mut(follow);
                follow.courses.push(course);
                Action::Course { course: follow.courses.len() - 1, done_m, at_m }
            } else {
                // The index does not matter: the check below refuses the action.
                Action::Course { course: 0, done_m, at_m }
            }
        }
    };
    if matches!(behaviour, Behaviour::Follow(_)) {
        return Ok(action);
    }
    let message = "is for path and idm; other actors know spawn and remove only";
    Err(FileError::new("do", message))
}
