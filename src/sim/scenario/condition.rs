//! Conditions of triggers, and of the end of an episode.

use std::collections::BTreeMap;

use super::error::{FileError, in_range, listed};
use super::script_file::{
    ConditionSection, EdgeSection, MeasureSection, PhaseSection, QuantitySection,
};
use crate::limits;
use crate::traffic::{After, Body, Condition, Edge, Measure, Near, Other, Phase, Quantity};

/// The names that scripts may refer to.
pub(super) struct References<'a> {
    /// The index of each actor, by name.
    pub(super) indices: &'a BTreeMap<String, usize>,
    /// The names of each actor's triggers.
    pub(super) triggers: &'a [Vec<String>],
}

impl References<'_> {
    /// The index of an actor that a field names.
    pub(super) fn actor(&self, field: &str, name: &str) -> Result<usize, FileError> {
        self.indices.get(name).copied().ok_or_else(|| {
            let known = listed(self.indices.keys().map(String::as_str));
            let message =
                format!("there is no actor {name:?}; there is {known}; the ego has no name");
            FileError::new(field, message)
        })
    }
}

/// The condition of a trigger of an actor, whose index is `own`; or of none.
pub(super) fn condition(
    section: &ConditionSection,
    own: Option<usize>,
    references: &References<'_>,
) -> Result<Condition, FileError> {
    // Checked beforehand, so that `part` need not know about conditions without an actor.
    if own.is_none() {
        check_without_actor(section)?;
    }
    part(section, own, references, (0, &mut 0))
}

/// A condition at a depth, with the number of conditions so far.
fn part(
    section: &ConditionSection,
    own: Option<usize>,
    references: &References<'_>,
    (depth, count): (usize, &mut usize),
) -> Result<Condition, FileError> {
    // Counted before its parts, so that the limit also ends the recursion.
    *count += 1;
    if *count > limits::CONDITIONS || depth > limits::CONDITION_DEPTH {
        let most = limits::CONDITIONS;
        let deepest = limits::CONDITION_DEPTH;
        let message = format!("at most {most} conditions, {deepest} deep, are accepted");
        return Err(FileError::new("all", message));
    }
    // `count` is shared by all levels, so that the limit is on the whole tree. The depth is of this
    // branch only.
    let mut parts = |name: &str, parts: &[ConditionSection]| {
        let parts = parts.iter().enumerate().map(|(index, inner)| {
            part(inner, own, references, (depth + 1, &mut *count))
                .map_err(|error| error.within(&format!("{name}[{index}]")))
        });
        parts.collect::<Result<Vec<Condition>, FileError>>()
    };
    let all = parts("all", &section.all)?;
    let any = parts("any", &section.any)?;
    // The bound keeps the product far within 64 bits.
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
            let actor = of.as_ref().map(|name| references.actor("of", name));
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
            // The actor and the trigger; phase and delay are written above.
            ..trigger_named(name, own, references)?
        }),
    };
    let later_s = in_range("later_s", section.later_s.unwrap_or(0.0), [0.0, limits::LATER_S])?;
    let held_us = microseconds("held_s", section.held_s.unwrap_or(0.0))?;
    let measure = section
        .measure
        .as_ref()
        .map(|section| measure(section, references))
        .transpose()
        .map_err(|error| error.within("measure"))?;
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

fn measure(section: &MeasureSection, references: &References<'_>) -> Result<Measure, FileError> {
    let body = |field: &str, name: &Option<String>, ahead_m: Option<f64>| {
        // Both fields exist for the measured body and for the other one, with different names.
        let ahead = if field == "of" { "ahead_m" } else { "to_ahead_m" };
        let actor = match name {
            None => None,
            Some(name) => Some(references.actor(field, name)?),
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
    // A field without effect would be read as a rule that holds, so it is refused.
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

/// A trigger by `TRIGGER` or `ACTOR/TRIGGER`.
fn trigger_named(
    text: &str,
    own: Option<usize>,
    references: &References<'_>,
) -> Result<After, FileError> {
    let missing = || {
        let message = format!("there is no trigger {text:?}; write TRIGGER or ACTOR/TRIGGER");
        FileError::new("after", message)
    };
    // A name without an actor is one of the same actor. The condition of the end has none.
    let (actor, name) = match text.split_once('/') {
        None => (own.ok_or_else(missing)?, text),
        Some((actor, name)) => (*references.indices.get(actor).ok_or_else(missing)?, name),
    };
    // Both lists have an entry for each actor, so the index is valid.
    let triggers = &references.triggers[actor];
    // A trigger without a name has an empty one in the list, which no reference may find.
    let trigger = triggers.iter().position(|other| !name.is_empty() && other == name);
    Ok(After { actor, trigger: trigger.ok_or_else(missing)?, phase: Phase::Fired, delay_us: 0 })
}

/// Refuses parts that are about the actor of a trigger.
fn check_without_actor(section: &ConditionSection) -> Result<(), FileError> {
    let on_course = section.measure.as_ref().and_then(|measure| measure.on_course);
    let own = [
        ("within_m", section.within_m.is_some()),
        ("station_m", section.station_m.is_some()),
        ("ego_station_m", section.ego_station_m.is_some()),
        ("speed_above", section.speed_above.is_some()),
        ("speed_below", section.speed_below.is_some()),
        ("measure.on_course", on_course == Some(true)),
    ];
    if let Some((field, _)) = own.iter().find(|(_, is_given)| *is_given) {
        let message = "is about a trigger's own actor; use a measure of an actor that it names";
        return Err(FileError::new(*field, message));
    }
    for (name, parts) in [("all", &section.all), ("any", &section.any)] {
        for (index, part) in parts.iter().enumerate() {
            check_without_actor(part).map_err(|e| e.within(&format!("{name}[{index}]")))?;
        }
    }
    Ok(())
}
