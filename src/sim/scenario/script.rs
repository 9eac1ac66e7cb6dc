//! Scripts of actors: what each does when a condition holds.

use std::collections::BTreeMap;

use super::actor_file::{ActionSection, ActorSection, ConditionSection};
use super::courses::Courses;
use super::error::{FileError, in_range, listed, named};
use crate::limits;
use crate::traffic::{Action, Actor, After, Behaviour, Condition, Near, Trigger};

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
        let when = condition_of(&trigger.when, own, references);
        let when = when.map_err(|error| error.within(&format!("{path}.when")))?;
        if !(1..=limits::ACTIONS).contains(&trigger.then.len()) {
            let message =
                format!("{} actions; 1 to {} are accepted", trigger.then.len(), limits::ACTIONS);
            return Err(FileError::new(format!("{path}.do"), message));
        }
        let mut then = Vec::with_capacity(trigger.then.len());
        for (at, action) in trigger.then.iter().enumerate() {
            let action = action_of(action, &mut actor.behaviour, courses);
            then.push(action.map_err(|error| error.within(&format!("{path}.do[{at}]")))?);
        }
        actor.script.push(Trigger { when, then });
    }
    Ok(())
}

fn condition_of(
    section: &ConditionSection,
    own: usize,
    references: &References<'_>,
) -> Result<Condition, FileError> {
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
        (None, None) => None,
        (None, Some(_)) => {
            return Err(FileError::new("delay_s", "needs after: write the trigger's name"));
        }
        (Some(name), delay_s) => Some(After {
            delay_us: microseconds("delay_s", delay_s.unwrap_or(0.0))?,
            ..trigger_named(name, own, references)?
        }),
    };
    Ok(Condition {
        time_us: section.time_s.map(|time_s| microseconds("time_s", time_s)).transpose()?,
        near,
        station_m: bounded("station_m", section.station_m)?,
        ego_station_m: bounded("ego_station_m", section.ego_station_m)?,
        speed_above_mps: bounded("speed_above", section.speed_above)?,
        speed_below_mps: bounded("speed_below", section.speed_below)?,
        ego_speed_above_mps: bounded("ego_speed_above", section.ego_speed_above)?,
        after,
    })
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
    Ok(After { actor, trigger: trigger.ok_or_else(missing)?, delay_us: 0 })
}

fn action_of(
    section: &ActionSection,
    behaviour: &mut Behaviour,
    courses: &mut Courses<'_>,
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
        ActionSection::Path(line) => {
            let reverse = line.reverse.unwrap_or(false);
            let along = line.along.as_deref();
            let points = line.points.as_deref();
            let lanes = line.lanes.as_deref();
            let course = courses.line("along", along, points, lanes, reverse);
            let course = course.map_err(|error| error.within("path"))?;
            if let Behaviour::Follow(follow) = behaviour {
                follow.courses.push(course);
                Action::Course { course: follow.courses.len() - 1 }
            } else {
                Action::Course { course: 0 }
            }
        }
    };
    if matches!(behaviour, Behaviour::Follow(_)) {
        return Ok(action);
    }
    let message = "is for path and idm; other actors know spawn and remove only";
    Err(FileError::new("do", message))
}
