//! Conditions of triggers.

use wildcity_sim::scenario::{
    ConditionSection, EdgeSection, MeasureSection, PhaseSection, QuantitySection,
};

use super::element::Element;
use super::model::Context;
use super::position::place_from;
use crate::ConvertError;

/// In front of a name in `after` whose triggers are not known yet, with the type of the
/// storyboard's element.
pub(super) const PENDING: char = '\u{1}';

/// Slower than this stands, in m/s.
const STANDS_MPS: f64 = 0.01;

/// The condition of a trigger: one of its groups. `is_immediate` says whether it is evaluated from
/// the start on.
pub(super) fn trigger_condition(
    trigger: &Element<'_>,
    context: &Context<'_>,
    is_immediate: bool,
) -> Result<ConditionSection, ConvertError> {
    trigger.only(&["ConditionGroup"])?;
    let groups: Result<Vec<ConditionSection>, ConvertError> =
        trigger.children().map(|group| group_condition(&group, context, is_immediate)).collect();
    Ok(join_any(groups?))
}

/// The condition of a group: all of its conditions.
pub(super) fn group_condition(
    group: &Element<'_>,
    context: &Context<'_>,
    is_immediate: bool,
) -> Result<ConditionSection, ConvertError> {
    group.only(&["Condition"])?;
    let parts: Result<Vec<ConditionSection>, ConvertError> =
        group.children().map(|part| condition_from(&part, context, is_immediate)).collect();
    Ok(join_all(parts?))
}

pub(super) fn join_all(mut parts: Vec<ConditionSection>) -> ConditionSection {
    // The default condition always holds, so that it changes nothing in `all`.
    parts.retain(|part| *part != ConditionSection::default());
    match parts.len() {
        0 => ConditionSection::default(),
        1 => parts.remove(0),
        _ => ConditionSection { all: parts, ..ConditionSection::default() },
    }
}

pub(super) fn join_any(mut parts: Vec<ConditionSection>) -> ConditionSection {
    match parts.len() {
        0 => ConditionSection::default(),
        1 => parts.remove(0),
        // If one part always holds, the whole does.
        _ if parts.contains(&ConditionSection::default()) => ConditionSection::default(),
        _ => ConditionSection { any: parts, ..ConditionSection::default() },
    }
}

fn condition_from(
    condition: &Element<'_>,
    context: &Context<'_>,
    is_immediate: bool,
) -> Result<ConditionSection, ConvertError> {
    let edge = match condition.find_text("conditionEdge")?.as_deref() {
        None | Some("none") => None,
        Some("rising") => Some(EdgeSection::Rising),
        Some("falling") => Some(EdgeSection::Falling),
        Some("risingOrFalling") => Some(EdgeSection::Both),
        Some(other) => {
            return Err(condition.wrong(&format!("conditionEdge={other:?} is not read")));
        }
    };
    let delay_s = condition.number_or_0("delay")?;
    if delay_s < 0.0 {
        return Err(condition.wrong(&format!("delay={delay_s:?}; write 0 or more")));
    }
    let kind = condition.only_child()?;
    match kind.name() {
        "ByValueCondition" => {
            let value = kind.only_child()?;
            by_value(&value, context, (edge, delay_s), is_immediate)
        }
        "ByEntityCondition" => Ok(with_edge(by_entity(&kind, context)?, edge, delay_s)),
        _ => Err(kind.unread()),
    }
}

/// A condition with an edge and a delay.
fn with_edge(part: ConditionSection, edge: Option<EdgeSection>, delay_s: f64) -> ConditionSection {
    ConditionSection { edge, later_s: (delay_s > 0.0).then_some(delay_s), ..part }
}

fn by_value(
    kind: &Element<'_>,
    context: &Context<'_>,
    (edge, delay_s): (Option<EdgeSection>, f64),
    is_immediate: bool,
) -> Result<ConditionSection, ConvertError> {
    let falls = matches!(edge, Some(EdgeSection::Falling));
    match kind.name() {
        "SimulationTimeCondition" => {
            let value_s = kind.number("value")?;
            let rule = kind.text("rule")?;
            // Files write a time that equals 0 for what begins with the scenario.
            let is_start = rule == "equalTo" && value_s == 0.0;
            if falls || !(is_start || matches!(rule.as_str(), "greaterThan" | "greaterOrEqual")) {
                return Err(kind.wrong("is read from a time on: greaterThan or greaterOrEqual"));
            }
            if is_immediate {
                // From the start on, a time begins to hold once: that is its edge.
                let time_s = (value_s.max(0.0)) + delay_s;
                return Ok(ConditionSection { time_s: Some(time_s), ..Default::default() });
            }
            // Evaluated later, the time may have passed already. Then there is no edge, so that the
            // edge must be kept.
            let part = ConditionSection { time_s: Some(value_s.max(0.0)), ..Default::default() };
            Ok(with_edge(part, edge, delay_s))
        }
        "StoryboardElementStateCondition" => {
            if falls {
                return Err(kind.wrong("is not read with a falling edge"));
            }
            let element = kind.text("storyboardElementType")?;
            let phase = match kind.text("state")?.as_str() {
                "startTransition" | "runningState" => PhaseSection::Fired,
                "endTransition" => PhaseSection::Done,
                "completeState" => PhaseSection::Ended,
                other => return Err(kind.wrong(&format!("state={other:?} is not read"))),
            };
            let path =
                kind.text("storyboardElementRef").or_else(|_| kind.raw("storyboardElementRef"))?;
            // A name may be a path.
            let name = path.rsplit("::").next().unwrap_or_default();
            // Its triggers are known only after all stories are read: `elements::resolve` puts them
            // here.
            Ok(ConditionSection {
                after: Some(format!("{PENDING}{element}{PENDING}{name}{PENDING}{}", kind.line())),
                phase: Some(phase),
                delay_s: (delay_s > 0.0).then_some(delay_s),
                ..Default::default()
            })
        }
        "ParameterCondition" => parameter_condition(kind, "parameterRef", context, delay_s),
        "VariableCondition" => parameter_condition(kind, "variableRef", context, delay_s),
        _ => Err(kind.unread()),
    }
}

/// A parameter or a variable has one value, or actions set another one.
fn parameter_condition(
    kind: &Element<'_>,
    attribute: &str,
    context: &Context<'_>,
    delay_s: f64,
) -> Result<ConditionSection, ConvertError> {
    let name = super::catalogs::plain_parameter(&kind.raw(attribute)?);
    let value = kind.parameters().get(&name).or_else(|| context.variables.get(&name));
    let Some(value) = value else {
        return Err(kind.wrong(&format!("there is no parameter or variable {name:?}; declare it")));
    };
    let rule = kind.text("rule")?;
    let bound = kind.text("value")?;
    let holds = super::catalogs::compare(&rule, value, &bound);
    let sets: Vec<_> = context.sets.iter().filter(|(other, ..)| *other == name).collect();
    if !sets.is_empty() {
        let is_set = |value: &str| super::catalogs::compare(&rule, value, &bound) == Some(true);
        let is_plain = sets.iter().all(|(_, value, event)| is_set(value) && !event.is_empty());
        // It does not hold at first, and each set makes it hold: so it holds from the first of
        // these events on.
        if holds != Some(false) || !is_plain {
            return Err(
                kind.wrong("is read if it holds from the first event on that sets the value")
            );
        }
        let parts = sets.into_iter().map(|(_, _, event)| ConditionSection {
            after: Some(format!("{PENDING}event{PENDING}{event}{PENDING}{}", kind.line())),
            delay_s: (delay_s > 0.0).then_some(delay_s),
            ..Default::default()
        });
        return Ok(join_any(parts.collect()));
    }
    match holds {
        // It holds from the start on, so that only the delay remains.
        Some(true) => Ok(ConditionSection {
            time_s: (delay_s > 0.0).then_some(delay_s),
            ..ConditionSection::default()
        }),
        // A condition that never holds: after the longest episode.
        Some(false) => Ok(never()),
        None => Err(kind.wrong("compares a text by size; use equalTo")),
    }
}

/// A condition that does not hold within any episode.
fn never() -> ConditionSection {
    let time_s = Some(wildcity_sim::limits::END_S);
    ConditionSection { time_s, ..ConditionSection::default() }
}

fn by_entity(by: &Element<'_>, context: &Context<'_>) -> Result<ConditionSection, ConvertError> {
    by.only(&["TriggeringEntities", "EntityCondition"])?;
    let triggering = by.need("TriggeringEntities")?;
    triggering.only(&["EntityRef"])?;
    let rule = triggering.text("triggeringEntitiesRule")?;
    let kind = by.need("EntityCondition")?.only_child()?;
    let held_s = match kind.name() {
        "StandStillCondition" => Some(kind.number("duration")?).filter(|held_s| *held_s > 0.0),
        _ => None,
    };
    let mut parts = Vec::new();
    for entity in triggering.children() {
        let name = entity.text("entityRef")?;
        if !context.entities.contains_key(&name) {
            return Err(entity.wrong(&format!("there is no entity {name:?}")));
        }
        let measure = measure_from(&kind, &name, context)?;
        parts.push(ConditionSection { measure: Some(measure), held_s, ..Default::default() });
    }
    match (rule.as_str(), parts.len()) {
        ("any" | "all", 0) => Err(triggering.wrong("is empty")),
        ("any" | "all", 1) => Ok(parts.remove(0)),
        ("any", _) => Ok(join_any(parts)),
        ("all", _) => Ok(join_all(parts)),
        _ => Err(triggering.wrong(&format!("triggeringEntitiesRule={rule:?}; any or all"))),
    }
}

/// A measure of a body, without bounds.
fn body(quantity: QuantitySection, name: &str, context: &Context<'_>) -> MeasureSection {
    let of = context.actor_name(name);
    let ahead_m = context.ahead_m(name);
    MeasureSection {
        quantity,
        of,
        ahead_m,
        to: None,
        to_ahead_m: None,
        xyz: None,
        free: None,
        on_course: None,
        straight: None,
        above: None,
        below: None,
    }
}

fn measure_from(
    kind: &Element<'_>,
    name: &str,
    context: &Context<'_>,
) -> Result<MeasureSection, ConvertError> {
    use QuantitySection::{
        Distance, Headway, Lateral, Longitudinal, Point, Speed, TimeToCollision, Travelled,
    };
    match kind.name() {
        "SpeedCondition" => bounded(kind, body(Speed, name, context)),
        "StandStillCondition" => {
            Ok(MeasureSection { below: Some(STANDS_MPS), ..body(Speed, name, context) })
        }
        "CollisionCondition" => {
            let other = kind.only_child()?;
            if other.name() != "EntityRef" {
                return Err(other.unread());
            }
            let measure = to_entity((kind, &other), body(Distance, name, context), context)?;
            // Boxes touch if the free distance between them is 0.
            Ok(MeasureSection { free: Some(true), below: Some(0.0), ..measure })
        }
        "TraveledDistanceCondition" => {
            let above = Some(kind.number("value")?);
            Ok(MeasureSection { above, ..body(Travelled, name, context) })
        }
        "ReachPositionCondition" => {
            let xyz = Some(place_from(&kind.need("Position")?, context)?.xyz_m);
            let below = Some(kind.number("tolerance")?);
            Ok(MeasureSection { xyz, below, ..body(Point, name, context) })
        }
        "DistanceCondition" => {
            let xyz = Some(place_from(&kind.need("Position")?, context)?.xyz_m);
            kind.expect("freespace", &["false", "0"])?;
            kind.expect("alongRoute", &["false", "0"])?;
            kind.expect("relativeDistanceType", &["euclidianDistance", "cartesianDistance"])?;
            kind.ignore(&["coordinateSystem"])?;
            bounded(kind, MeasureSection { xyz, ..body(Point, name, context) })
        }
        "RelativeDistanceCondition" => {
            let quantity = match kind.text("relativeDistanceType")?.as_str() {
                "longitudinal" => Longitudinal,
                "lateral" => Lateral,
                "cartesianDistance" | "euclidianDistance" => Distance,
                other => {
                    return Err(kind.wrong(&format!("relativeDistanceType={other:?} is not read")));
                }
            };
            let measure = to_entity((kind, kind), body(quantity, name, context), context)?;
            bounded(kind, measure)
        }
        "TimeHeadwayCondition" => time_measure(kind, kind, body(Headway, name, context), context),
        "TimeToCollisionCondition" => {
            let target = kind.need("TimeToCollisionConditionTarget")?.only_child()?;
            if target.name() != "EntityRef" {
                return Err(target.unread());
            }
            time_measure(kind, &target, body(TimeToCollision, name, context), context)
        }
        _ => Err(kind.unread()),
    }
}

/// A time: a distance by a speed.
fn time_measure(
    kind: &Element<'_>,
    target: &Element<'_>,
    measure: MeasureSection,
    context: &Context<'_>,
) -> Result<MeasureSection, ConvertError> {
    let along_route = kind.find_flag("alongRoute")?;
    let is_straight = match kind.find_text("relativeDistanceType")?.as_deref() {
        // Files of 1.0 have `alongRoute` and no type.
        None => along_route != Some(true),
        Some("longitudinal") => false,
        Some("cartesianDistance" | "euclidianDistance") => true,
        Some(other) => {
            return Err(kind.wrong(&format!("relativeDistanceType={other:?} is not read")));
        }
    };
    let measure = to_entity((kind, target), measure, context)?;
    let on_course = match along_route {
        Some(true) => Some(true),
        _ => measure.on_course,
    };
    let straight = is_straight.then_some(true);
    // A straight distance follows no course.
    let on_course = on_course.filter(|_| !is_straight);
    bounded(kind, MeasureSection { straight, on_course, ..measure })
}

/// A distance to the entity that a condition names.
fn to_entity(
    (kind, target): (&Element<'_>, &Element<'_>),
    measure: MeasureSection,
    context: &Context<'_>,
) -> Result<MeasureSection, ConvertError> {
    let other = target.text("entityRef")?;
    let Some(to_ahead_m) = context.ahead_m(&other) else {
        return Err(kind.wrong(&format!("there is no entity {other:?}")));
    };
    // A straight distance is the same in all coordinate systems.
    let is_along = measure.quantity != QuantitySection::Distance;
    let is_on_road = match kind.find_text("coordinateSystem")?.as_deref() {
        None | Some("entity") => false,
        Some("road" | "lane") => true,
        Some(other) => return Err(kind.wrong(&format!("coordinateSystem={other:?} is not read"))),
    };
    Ok(MeasureSection {
        to: context.actor_name(&other),
        to_ahead_m: Some(to_ahead_m),
        free: kind.find_flag("freespace")?.filter(|is_free| *is_free),
        on_course: (is_along && is_on_road).then_some(true),
        ..measure
    })
}

/// A measure with the bound of a condition.
fn bounded(kind: &Element<'_>, measure: MeasureSection) -> Result<MeasureSection, ConvertError> {
    let value = kind.number("value")?;
    match kind.text("rule")?.as_str() {
        // The two rules differ only where a value is exactly the bound.
        "greaterThan" | "greaterOrEqual" => Ok(MeasureSection { above: Some(value), ..measure }),
        "lessThan" | "lessOrEqual" => Ok(MeasureSection { below: Some(value), ..measure }),
        other => Err(kind.wrong(&format!("rule={other:?} is not read; a value is never exact"))),
    }
}
