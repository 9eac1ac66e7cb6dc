//! Scripts of actors: what each does when a condition holds.

use std::collections::BTreeMap;

use super::actor_file::ActorSection;
use super::courses::Courses;
use super::error::{FileError, in_range, listed, named};
use super::script_file::{
    ActionSection, ConditionSection, EdgeSection, MeasureSection, PhaseSection, ProfileSection,
    QuantitySection, ShapeSection,
};
use crate::limits;
use crate::traffic::{
    Action, Actor, After, Behaviour, Body, Condition, Edge, Measure, Near, Other, Over, Phase,
    Quantity, Shape, Trigger,
};

/// The names that scripts may refer to.
pub(super) struct References<'a> {
    /// The index of each actor, by name.
    pub(super) indices: &'a BTreeMap<String, usize>,
    /// The names of each actor's triggers.
    pub(super) triggers: &'a [Vec<String>],
}

/// Adds the triggers of a section to its actor, whose index is `own`.
pub(super) fn script_of(
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
            if names.iter().filter(|other| *other == name).count() > 1 {
                let message = format!("{name:?} is there twice; give each trigger its own name");
                return Err(FileError::new(format!("{path}.name"), message));
            }
        }
        let mut count = 0;
        let when = condition_of(&trigger.when, own, references, (0, &mut count));
        let when = when.map_err(|error| error.within(&format!("{path}.when")))?;
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
        let mut then = Vec::with_capacity(trigger.then.len());
        for (at, action) in trigger.then.iter().enumerate() {
            let action = action_of(action, &mut actor.behaviour, courses, (references, own));
            then.push(action.map_err(|error| error.within(&format!("{path}.do[{at}]")))?);
        }
        actor.script.push(Trigger { when, then });
    }
    Ok(())
}

/// A condition at a depth, with the number of conditions so far.
fn condition_of(
    section: &ConditionSection,
    own: usize,
    references: &References<'_>,
    (depth, count): (usize, &mut usize),
) -> Result<Condition, FileError> {
    *count += 1;
    if *count > limits::CONDITIONS || depth > limits::CONDITION_DEPTH {
        let [most, deepest] = [limits::CONDITIONS, limits::CONDITION_DEPTH];
        let message = format!("at most {most} conditions, {deepest} deep, are accepted");
        return Err(FileError::new("all", message));
    }
    let mut parts = |name: &str, parts: &[ConditionSection]| {
        let parts = parts.iter().enumerate().map(|(index, part)| {
            condition_of(part, own, references, (depth + 1, &mut *count))
                .map_err(|error| error.within(&format!("{name}[{index}]")))
        });
        parts.collect::<Result<Vec<Condition>, FileError>>()
    };
    let all = parts("all", &section.all)?;
    let any = parts("any", &section.any)?;
    let microseconds = |path: &str, value_s: f64| -> Result<i64, FileError> {
        Ok((in_range(path, value_s, [0.0, limits::END_S])? * 1e6).round() as i64)
    };
    let bounded = |path: &str, value: Option<f64>| {
        value.map(|value| in_range(path, value, [0.0, 1e6])).transpose()
    };
    let near = match (section.within_m, &section.of) {
        (None, None) => None,
        (None, Some(_)) => {
            return Err(FileError::new("of", "needs within_m: write the distance"));
        }
        (Some(within_m), of) => {
            let actor = of.as_ref().map(|name| {
                references.indices.get(name).copied().ok_or_else(|| {
                    let known = listed(references.indices.keys().map(String::as_str));
                    let must = format!(
                        "there is no actor {name:?}; there is {known}; without `of`, the distance is to the ego"
                    );
                    FileError::new("of", must)
                })
            });
            let within_m = in_range("within_m", within_m, [0.0, 1e6])?;
            Some(Near { actor: actor.transpose()?, within_m })
        }
    };
    let after = match (&section.after, section.delay_s) {
        (None, Some(_)) => {
            return Err(FileError::new("delay_s", "needs after: write the trigger's name"));
        }
        (None, None) if section.phase.is_some() => {
            return Err(FileError::new("phase", "needs after: write the trigger's name"));
        }
        (None, None) => None,
        (Some(name), delay_s) => Some(After {
            delay_us: microseconds("delay_s", delay_s.unwrap_or(0.0))?,
            phase: match section.phase {
                None | Some(PhaseSection::Fired) => Phase::Fired,
                Some(PhaseSection::Done) => Phase::Done,
                Some(PhaseSection::Ended) => Phase::Ended,
            },
            ..trigger_named(name, own, references)?
        }),
    };
    let later_s = in_range("later_s", section.later_s.unwrap_or(0.0), [0.0, limits::LATER_S])?;
    let held_us = microseconds("held_s", section.held_s.unwrap_or(0.0))?;
    let measure = section.measure.as_ref().map(|measure| measure_of(measure, references));
    let measure = measure.transpose().map_err(|error| error.within("measure"))?;
    Ok(Condition {
        time_us: section.time_s.map(|time_s| microseconds("time_s", time_s)).transpose()?,
        near,
        station_m: bounded("station_m", section.station_m)?,
        ego_station_m: bounded("ego_station_m", section.ego_station_m)?,
        speed_above_mps: bounded("speed_above", section.speed_above)?,
        speed_below_mps: bounded("speed_below", section.speed_below)?,
        ego_speed_above_mps: bounded("ego_speed_above", section.ego_speed_above)?,
        after,
        measure,
        all,
        any,
        edge: section.edge.map(|edge| match edge {
            EdgeSection::Rising => Edge::Rising,
            EdgeSection::Falling => Edge::Falling,
            EdgeSection::Both => Edge::Both,
        }),
        held_us,
        later_us: (later_s * 1e6).round() as i64,
    })
}

fn measure_of(section: &MeasureSection, references: &References<'_>) -> Result<Measure, FileError> {
    let body = |field: &str, name: &Option<String>, ahead_m: Option<f64>| {
        let ahead = if field == "of" { "ahead_m" } else { "to_ahead_m" };
        let actor = match name {
            None => None,
            Some(name) => Some(references.indices.get(name).copied().ok_or_else(|| {
                let known = listed(references.indices.keys().map(String::as_str));
                let message =
                    format!("there is no actor {name:?}; there is {known}; the ego has no name");
                FileError::new(field, message)
            })?),
        };
        let ahead_m = in_range(ahead, ahead_m.unwrap_or(0.0), [-100.0, 100.0])?;
        Ok::<Body, FileError>(Body { actor, ahead_m })
    };
    let of = body("of", &section.of, section.ahead_m)?;
    let other = Other {
        to: body("to", &section.to, section.to_ahead_m)?,
        is_free: section.free.unwrap_or(false),
        is_on_course: section.on_course.unwrap_or(false),
        is_straight: section.straight.unwrap_or(false),
    };
    let quantity = match section.quantity {
        QuantitySection::Speed => Quantity::Speed,
        QuantitySection::Travelled => Quantity::Travelled,
        QuantitySection::Point => {
            let xyz = section.xyz.ok_or_else(|| FileError::new("xyz", "is missing"))?;
            for axis in xyz {
                in_range("xyz", axis, [-1e7, 1e7])?;
            }
            Quantity::Point(glam::DVec3::from_array(xyz))
        }
        QuantitySection::Distance => Quantity::Distance(other),
        QuantitySection::Longitudinal => Quantity::Longitudinal(other),
        QuantitySection::Lateral => Quantity::Lateral(other),
        QuantitySection::Headway => Quantity::Headway(other),
        QuantitySection::TimeToCollision => Quantity::TimeToCollision(other),
    };
    check_measure(section)?;
    Ok(Measure { quantity, of, above: section.above, below: section.below })
}

/// Checks that a measure has bounds, and no field that its quantity ignores.
fn check_measure(section: &MeasureSection) -> Result<(), FileError> {
    for (field, bound) in [("above", section.above), ("below", section.below)] {
        bound.map(|bound| in_range(field, bound, [0.0, 1e6])).transpose()?;
    }
    if section.above.is_none() && section.below.is_none() {
        return Err(FileError::new("above", "is missing, as is below; write one of them"));
    }
    use QuantitySection::{Distance, Headway, Lateral, Longitudinal, Point, TimeToCollision};
    let quantity = section.quantity;
    let is_relative =
        matches!(quantity, Distance | Longitudinal | Lateral | Headway | TimeToCollision);
    let is_along = matches!(quantity, Longitudinal | Lateral | Headway | TimeToCollision);
    let is_by_speed = matches!(quantity, Headway | TimeToCollision);
    let ignored = [
        ("xyz", section.xyz.is_some() && quantity != Point),
        ("to", section.to.is_some() && !is_relative),
        ("to_ahead_m", section.to_ahead_m.is_some() && !is_relative),
        ("free", section.free.is_some() && !is_relative),
        ("straight", section.straight.is_some() && !is_by_speed),
        ("on_course", section.on_course.is_some() && !is_along),
    ];
    match ignored.iter().find(|(_, is_ignored)| *is_ignored) {
        None => Ok(()),
        Some((field, _)) => Err(FileError::new(*field, "is not for this quantity; remove it")),
    }
}

/// The aim, the extent and the shape of a change.
fn profile_of(section: &ProfileSection) -> Result<(Over, Shape), FileError> {
    let shape = match section.shape {
        ShapeSection::Step => Shape::Step,
        ShapeSection::Linear => Shape::Linear,
        ShapeSection::Sinusoidal => Shape::Sinusoidal,
        ShapeSection::Cubic => Shape::Cubic,
    };
    let given = [
        section.over_s.map(|s| Ok(Over::Time(in_range("over_s", s, [0.01, 1e4])?))),
        section.over_m.map(|m| Ok(Over::Distance(in_range("over_m", m, [0.01, 1e5])?))),
        section.rate.map(|rate| Ok(Over::Rate(in_range("rate", rate, [1e-3, 1e3])?))),
        section
            .acceleration
            .map(|most| Ok(Over::Acceleration(in_range("acceleration", most, [1e-3, 1e3])?))),
    ];
    let mut given = given.into_iter().flatten();
    match (shape, given.next(), given.next()) {
        (Shape::Step, None, _) => Ok((Over::Time(0.0), shape)),
        (Shape::Linear | Shape::Sinusoidal | Shape::Cubic, Some(over), None) => Ok((over?, shape)),
        _ => {
            let message =
                "write exactly one of over_s, over_m, rate and acceleration; none for step";
            Err(FileError::new("shape", message))
        }
    }
}

/// A trigger by `TRIGGER` or `ACTOR/TRIGGER`.
fn trigger_named(text: &str, own: usize, references: &References<'_>) -> Result<After, FileError> {
    let missing = || {
        let message = format!("there is no trigger {text:?}; write TRIGGER or ACTOR/TRIGGER");
        FileError::new("after", message)
    };
    let (actor, name) = match text.split_once('/') {
        None => (own, text),
        Some((actor, name)) => (*references.indices.get(actor).ok_or_else(missing)?, name),
    };
    let triggers = &references.triggers[actor];
    let trigger = triggers.iter().position(|other| !name.is_empty() && other == name);
    Ok(After { actor, trigger: trigger.ok_or_else(missing)?, phase: Phase::Fired, delay_us: 0 })
}

fn action_of(
    section: &ActionSection,
    behaviour: &mut Behaviour,
    courses: &mut Courses<'_>,
    (references, own): (&References<'_>, usize),
) -> Result<Action, FileError> {
    let most_mps2 = limits::ACTOR_ACCELERATION_M_S2;
    let rate_of = |path: &str, rate: f64| in_range(path, rate, [0.01, most_mps2]);
    let action = match section {
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
            let (over, shape) = profile_of(section).map_err(within)?;
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
            let index = |name: &String| {
                references.indices.get(name).copied().ok_or_else(|| {
                    let message = format!("there is no actor {name:?}; the ego has no name");
                    FileError::new("speed_match.of", message)
                })
            };
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
        ActionSection::OffsetProfile(section) => {
            let within = |error: FileError| error.within("offset_profile");
            let (over, shape) = profile_of(section).map_err(within)?;
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
            let course = courses.line("along", along, points, lanes, reverse);
            let course = course.map_err(|error| error.within("path"))?;
            let done_m = line.done_m.map(|m| in_range("path.done_m", m, [0.0, course.length_m()]));
            let done_m = done_m.transpose()?;
            let at_m = line.at_m.map(|m| in_range("path.at_m", m, [0.0, course.length_m()]));
            let at_m = at_m.transpose()?;
            if let Behaviour::Follow(follow) = behaviour {
                follow.courses.push(course);
                Action::Course { course: follow.courses.len() - 1, done_m, at_m }
            } else {
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
