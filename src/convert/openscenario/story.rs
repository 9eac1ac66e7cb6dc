//! Reads the storyboard: `Init`, the events of the stories, and the stop trigger.

use std::collections::BTreeMap;

use wildcity_sim::scenario::{ActionSection, ConditionSection, CourseSection, TriggerSection};

use super::Entity;
use super::element::Element;
use super::position::place_of;
use crate::ConvertError;

/// The rate of a step of speed, in m/s²: the largest of an actor.
const STEP_MPS2: f64 = wildcity_sim::limits::ACTOR_ACCELERATION_M_S2;

/// Least rate of a change of speed, in m/s².
const LEAST_MPS2: f64 = 0.01;

type Entities = BTreeMap<String, Entity>;

/// Reads the actions of `Init`.
pub(super) fn read_init(init: Element<'_>, entities: &mut Entities) -> Result<(), ConvertError> {
    init.only(&["Actions"])?;
    let actions = init.need("Actions")?;
    actions.only(&["Private"])?;
    for private in actions.children() {
        let name = private.text("entityRef")?;
        if !entities.contains_key(&name) {
            return Err(private.wrong(&format!("there is no entity {name:?}")));
        }
        for action in private.children() {
            if action.name() != "PrivateAction" {
                return Err(action.unread());
            }
            read_init_action(action.only_child()?, &name, entities)?;
        }
    }
    Ok(())
}

fn read_init_action(
    action: Element<'_>,
    name: &str,
    entities: &mut Entities,
) -> Result<(), ConvertError> {
    match action.name() {
        "TeleportAction" => {
            let place = place_of(action.need("Position")?, entities)?;
            if let Some(entity) = entities.get_mut(name) {
                entity.place = Some(place);
            }
        }
        "LongitudinalAction" => {
            let (to_mps, _) = speed_of(action, 0.0)?;
            if let Some(entity) = entities.get_mut(name) {
                entity.speed_mps = to_mps;
                entity.begin_mps = to_mps;
            }
        }
        "RoutingAction" => {
            let (line, times_s) = trajectory_of(action, entities)?;
            if let Some(entity) = entities.get_mut(name) {
                entity.line = Some(line);
                entity.times_s = times_s;
            }
        }
        _ => return Err(action.unread()),
    }
    Ok(())
}

/// Reads the events of a story.
pub(super) fn read_story(
    story: Element<'_>,
    entities: &mut Entities,
    ego: &str,
) -> Result<(), ConvertError> {
    story.only(&["Act"])?;
    for act in story.children() {
        act.only(&["ManeuverGroup", "StartTrigger", "StopTrigger"])?;
        if let Some(stop) = act.find("StopTrigger")? {
            stop.only(&[])?;
        }
        let act_start = act.find("StartTrigger")?;
        for group in act.all("ManeuverGroup") {
            group.expect("maximumExecutionCount", &["1"])?;
            group.only(&["Actors", "Maneuver"])?;
            let actors = group.need("Actors")?;
            actors.only(&["EntityRef"])?;
            actors.expect("selectTriggeringEntities", &["false"])?;
            let names: Result<Vec<String>, _> =
                actors.children().map(|actor| actor.text("entityRef")).collect();
            for maneuver in group.all("Maneuver") {
                maneuver.only(&["Event"])?;
                for event in maneuver.children() {
                    read_event(event, act_start, &names.clone()?, entities, ego)?;
                }
            }
        }
    }
    Ok(())
}

fn read_event(
    event: Element<'_>,
    act_start: Option<Element<'_>>,
    actors: &[String],
    entities: &mut Entities,
    ego: &str,
) -> Result<(), ConvertError> {
    event.only(&["Action", "StartTrigger"])?;
    event.expect("priority", &["override", "overwrite", "skip"])?;
    event.expect("maximumExecutionCount", &["1"])?;
    let event_name = super::plain_name(&event.text("name")?);
    for action in event.all("Action") {
        let kind = action.only_child()?;
        // Global actions name their entity themselves.
        let (targets, kind) = match kind.name() {
            "PrivateAction" => (actors.to_vec(), kind.only_child()?),
            "GlobalAction" => {
                let entity = kind.only_child()?;
                if entity.name() != "EntityAction" {
                    return Err(entity.unread());
                }
                (vec![entity.text("entityRef")?], entity.only_child()?)
            }
            _ => return Err(kind.unread()),
        };
        for target in targets {
            let mut when = ConditionSection::default();
            for start in act_start.into_iter().chain(event.find("StartTrigger")?) {
                add_conditions(start, &target, ego, entities, &mut when)?;
            }
            let Some(entity) = entities.get(&target) else {
                return Err(action.wrong(&format!("there is no entity {target:?}")));
            };
            let then = action_of(kind, entity, entities)?;
            let Some(entity) = entities.get_mut(&target) else { continue };
            match &then {
                ActionSection::Speed { to, .. } => entity.speed_mps = *to,
                ActionSection::Spawn {} if entity.script.is_empty() => entity.present = false,
                _ => {}
            }
            let same = entity
                .script
                .iter_mut()
                .find(|trigger| trigger.name.as_deref() == Some(event_name.as_str()));
            match same {
                Some(trigger) => trigger.then.push(then),
                None => entity.script.push(TriggerSection {
                    name: Some(event_name.clone()),
                    when,
                    then: vec![then],
                }),
            }
        }
    }
    Ok(())
}

fn action_of(
    kind: Element<'_>,
    entity: &Entity,
    entities: &Entities,
) -> Result<ActionSection, ConvertError> {
    match kind.name() {
        "LongitudinalAction" => {
            let (to, rate) = speed_of(kind, entity.speed_mps)?;
            Ok(ActionSection::Speed { to, rate })
        }
        "RoutingAction" => {
            let (points, times_s) = trajectory_of(kind, entities)?;
            if times_s.is_some() {
                let message = "has times, which an event cannot keep; use <None> as time reference";
                return Err(kind.wrong(message));
            }
            Ok(ActionSection::Path(CourseSection {
                points: Some(points),
                ..CourseSection::default()
            }))
        }
        "AddEntityAction" => Ok(ActionSection::Spawn {}),
        "DeleteEntityAction" => Ok(ActionSection::Remove {}),
        _ => Err(kind.unread()),
    }
}

/// Whether actions move an actor along its course.
pub(super) fn is_motion(then: &[ActionSection]) -> bool {
    let is_presence = |action: &ActionSection| {
        matches!(action, ActionSection::Spawn {} | ActionSection::Remove {})
    };
    !then.iter().all(is_presence)
}

/// The speed and the rate of a `<LongitudinalAction>`, from a speed in m/s.
fn speed_of(action: Element<'_>, from_mps: f64) -> Result<(f64, f64), ConvertError> {
    let speed = action.only_child()?;
    if speed.name() != "SpeedAction" {
        return Err(speed.unread());
    }
    speed.only(&["SpeedActionDynamics", "SpeedActionTarget"])?;
    let target = speed.need("SpeedActionTarget")?.only_child()?;
    if target.name() != "AbsoluteTargetSpeed" {
        return Err(target.unread());
    }
    let to_mps = target.number("value")?;
    if to_mps < 0.0 {
        return Err(target.wrong("is below 0; actors do not drive backwards"));
    }
    let dynamics = speed.need("SpeedActionDynamics")?;
    dynamics.expect("dynamicsShape", &["step", "linear"])?;
    if dynamics.text("dynamicsShape")? == "step" {
        return Ok((to_mps, STEP_MPS2));
    }
    let value = dynamics.number("value")?;
    let change_mps = (to_mps - from_mps).abs();
    let rate = match dynamics.text("dynamicsDimension")?.as_str() {
        "rate" => value.abs(),
        "time" if value > 0.0 => change_mps / value,
        "time" => STEP_MPS2,
        // v² - v0² = 2 a s.
        "distance" if value > 0.0 => change_mps * (to_mps + from_mps) / (2.0 * value),
        other => {
            let message = format!("dynamicsDimension={other:?}; rate, time or distance is read");
            return Err(dynamics.wrong(&message));
        }
    };
    Ok((to_mps, rate.clamp(LEAST_MPS2, STEP_MPS2)))
}

/// Points in metres, with their times in seconds if they count.
type TimedPoints = (Vec<[f64; 3]>, Option<Vec<f64>>);

/// The points of a `<FollowTrajectoryAction>`.
fn trajectory_of(action: Element<'_>, entities: &Entities) -> Result<TimedPoints, ConvertError> {
    let follow = action.only_child()?;
    if follow.name() != "FollowTrajectoryAction" {
        return Err(follow.unread());
    }
    follow.only(&["Trajectory", "TrajectoryRef", "TimeReference", "TrajectoryFollowingMode"])?;
    let trajectory = match follow.find("TrajectoryRef")? {
        Some(reference) => reference.need("Trajectory")?,
        None => follow.need("Trajectory")?,
    };
    trajectory.expect("closed", &["false", "0"])?;
    trajectory.only(&["ParameterDeclarations", "Shape"])?;
    if let Some(parameters) = trajectory.find("ParameterDeclarations")? {
        parameters.only(&[])?;
    }
    let shape = trajectory.need("Shape")?.only_child()?;
    if shape.name() != "Polyline" {
        return Err(shape.unread());
    }
    shape.only(&["Vertex"])?;
    let mut points = Vec::new();
    let mut times_s = Vec::new();
    for vertex in shape.children() {
        points.push(place_of(vertex.need("Position")?, entities)?.xyz_m);
        times_s.push(vertex.find_number("time")?);
    }
    let reference = follow.find("TimeReference")?.map(|reference| reference.only_child());
    let Some(reference) = reference.transpose()? else { return Ok((points, None)) };
    match reference.name() {
        "None" => Ok((points, None)),
        "Timing" => {
            reference.expect("domainAbsoluteRelative", &["absolute", "relative"])?;
            reference.expect("scale", &["1", "1.0"])?;
            let offset_s = reference.find_number("offset")?.unwrap_or(0.0);
            let times_s: Option<Vec<f64>> =
                times_s.into_iter().map(|time_s| Some(time_s? + offset_s)).collect();
            let missing = || reference.wrong("a <Vertex> has no time; give all of them one");
            Ok((points, Some(times_s.ok_or_else(missing)?)))
        }
        _ => Err(reference.unread()),
    }
}

/// Adds the conditions of a trigger, all of which must be true.
fn add_conditions(
    start: Element<'_>,
    own: &str,
    ego: &str,
    entities: &Entities,
    when: &mut ConditionSection,
) -> Result<(), ConvertError> {
    start.only(&["ConditionGroup"])?;
    let Some(group) = start.find("ConditionGroup")? else { return Ok(()) };
    for condition in group.children() {
        if condition.name() != "Condition" {
            return Err(condition.unread());
        }
        condition.expect("conditionEdge", &["rising", "none"])?;
        let delay_s = condition.find_number("delay")?.unwrap_or(0.0);
        let kind = condition.only_child()?;
        match kind.name() {
            "ByValueCondition" => add_by_value(kind.only_child()?, delay_s, when)?,
            "ByEntityCondition" => {
                if delay_s != 0.0 {
                    return Err(condition.wrong("delay is read for times and events only"));
                }
                add_by_entity(kind, own, ego, entities, when)?;
            }
            _ => return Err(kind.unread()),
        }
    }
    Ok(())
}

fn add_by_value(
    kind: Element<'_>,
    delay_s: f64,
    when: &mut ConditionSection,
) -> Result<(), ConvertError> {
    match kind.name() {
        "SimulationTimeCondition" => {
            kind.expect("rule", &["greaterThan", "greaterOrEqual"])?;
            let time_s = (kind.number("value")? + delay_s).max(0.0);
            // Both the act's and the event's must be over.
            when.time_s = Some(when.time_s.map_or(time_s, |other| other.max(time_s)));
        }
        "StoryboardElementStateCondition" => {
            kind.expect("storyboardElementType", &["event"])?;
            kind.expect("state", &["startTransition", "runningState"])?;
            let event = super::plain_name(&kind.text("storyboardElementRef")?);
            set(&kind, &mut when.after, event)?;
            when.delay_s = (delay_s > 0.0).then_some(delay_s);
        }
        _ => return Err(kind.unread()),
    }
    Ok(())
}

fn add_by_entity(
    by: Element<'_>,
    own: &str,
    ego: &str,
    entities: &Entities,
    when: &mut ConditionSection,
) -> Result<(), ConvertError> {
    by.only(&["TriggeringEntities", "EntityCondition"])?;
    let triggering = by.need("TriggeringEntities")?;
    let subject = triggering.only_child()?.text("entityRef")?;
    let kind = by.need("EntityCondition")?.only_child()?;
    let is_own = subject == own;
    let is_ego = subject == ego;
    match kind.name() {
        "SpeedCondition" => {
            let value = kind.number("value")?;
            let rule = kind.text("rule")?;
            match (rule.as_str(), is_own, is_ego) {
                ("greaterThan" | "greaterOrEqual", true, _) => {
                    set(&kind, &mut when.speed_above, value)?;
                }
                ("lessThan" | "lessOrEqual", true, _) => {
                    set(&kind, &mut when.speed_below, value)?;
                }
                ("greaterThan" | "greaterOrEqual", _, true) => {
                    set(&kind, &mut when.ego_speed_above, value)?;
                }
                _ => {
                    let message =
                        "is read for the event's own actor, or the ego's speed above a value";
                    return Err(kind.wrong(message));
                }
            }
        }
        "RelativeDistanceCondition" => {
            kind.expect("freespace", &["false", "0"])?;
            kind.expect("rule", &["lessThan", "lessOrEqual"])?;
            kind.expect("relativeDistanceType", &["cartesianDistance", "euclidianDistance"])?;
            let reference = kind.text("entityRef")?;
            let other = match (is_own, reference == own) {
                (true, _) => reference,
                (_, true) => subject,
                _ => return Err(kind.wrong("is read for the event's own actor only")),
            };
            set(&kind, &mut when.within_m, kind.number("value")?)?;
            if other != ego {
                let name = entities.get(&other).map(|entity| entity.name.clone());
                when.of = Some(name.ok_or_else(|| kind.wrong("names no entity"))?);
            }
        }
        "TraveledDistanceCondition" if is_own => {
            let begin_m = match entities.get(own) {
                Some(entity) if entity.line.is_some() => entity.center_x_m.max(0.0),
                _ => 0.0,
            };
            set(&kind, &mut when.station_m, begin_m + kind.number("value")?)?;
        }
        "TraveledDistanceCondition" => {
            return Err(kind.wrong("is read for the event's own actor only"));
        }
        _ => return Err(kind.unread()),
    }
    Ok(())
}

/// Sets a part of a condition that is not set yet.
fn set<T>(kind: &Element<'_>, part: &mut Option<T>, value: T) -> Result<(), ConvertError> {
    if part.replace(value).is_some() {
        return Err(kind.wrong("is there twice for one event; keep one"));
    }
    Ok(())
}

/// The time of a `<StopTrigger>`, in seconds; `None` if it is empty.
pub(super) fn stop_time_s(stop: Element<'_>) -> Result<Option<f64>, ConvertError> {
    stop.only(&["ConditionGroup"])?;
    let Some(group) = stop.find("ConditionGroup")? else { return Ok(None) };
    let condition = group.only_child()?;
    let kind = condition.only_child()?.only_child()?;
    if kind.name() != "SimulationTimeCondition" {
        return Err(kind.unread());
    }
    kind.expect("rule", &["greaterThan", "greaterOrEqual"])?;
    Ok(Some(kind.number("value")?))
}
