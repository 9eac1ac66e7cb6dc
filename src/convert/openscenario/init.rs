//! Reads `Init`: where entities start, how fast, and what they do from the start on.

use wildcity_sim::scenario::{ConditionSection, ShapeSection};

use super::actions::{private_act, speed_change, speed_match, trajectory_line};
use super::controllers;
use super::distances;
use super::ego_route::read_ego_route;
use super::element::Element;
use super::ledger::Part;
use super::model::{Act, Context, Draft, Entity};
use super::position::place_from;
use super::route::{lanes_between, waypoints};
use crate::ConvertError;

/// An action of `Init` with its entity.
type InitAction<'a> = (String, Element<'a>);

/// Reads the actions of `Init`. An action that refers to another entity is read after those of that
/// entity.
pub(super) fn read_init<'a>(
    init: &Element<'a>,
    context: &mut Context<'a>,
) -> Result<(), ConvertError> {
    init.only(&["Actions"])?;
    let actions = init.need("Actions")?;
    // In this order: speeds and distances refer to places, and all else may refer to both.
    let mut places: Vec<InitAction<'a>> = Vec::new();
    let mut speeds: Vec<InitAction<'a>> = Vec::new();
    let mut others: Vec<InitAction<'a>> = Vec::new();
    for action in actions.children() {
        match action.name() {
            "GlobalAction" => others.push((String::new(), action.only_child()?)),
            "UserDefinedAction" => action.leave_out(Part::Custom)?,
            "Private" => {
                let name = action.text("entityRef")?;
                if !context.entities.contains_key(&name) {
                    return Err(action.wrong(&format!("there is no entity {name:?}")));
                }
                for private in action.children() {
                    if private.name() != "PrivateAction" {
                        return Err(private.unread());
                    }
                    let kind = private.only_child()?;
                    match kind.name() {
                        "TeleportAction" => places.push((name.clone(), kind)),
                        "LongitudinalAction" => speeds.push((name.clone(), kind)),
                        _ => others.push((name.clone(), kind)),
                    }
                }
            }
            _ => return Err(action.unread()),
        }
    }
    in_turn(places, context, read_place)?;
    // A speed that is relative to one of these cannot be read yet.
    context.waiting = speeds.iter().map(|(name, _)| name.clone()).collect();
    in_turn(speeds, context, read_speed)?;
    for (name, action) in &others {
        read_other(action, name, context)?;
    }
    Ok(())
}

/// Reads actions, those that can not be read yet after the others.
fn in_turn<'a>(
    mut actions: Vec<InitAction<'a>>,
    context: &mut Context<'a>,
    read: fn(&Element<'a>, &str, &mut Context<'a>) -> Result<(), ConvertError>,
) -> Result<(), ConvertError> {
    loop {
        let count = actions.len();
        let mut first = None;
        // What fails is read again in the next round, when more entities have a place or a speed.
        let mut waiting = Vec::new();
        for (name, action) in actions {
            if let Err(error) = read(&action, &name, context) {
                first.get_or_insert(error);
                waiting.push((name, action));
            }
        }
        match first {
            None => return Ok(()),
            // This round has read nothing, so that no further round would.
            Some(error) if waiting.len() == count => return Err(error),
            Some(_) => actions = waiting,
        }
    }
}

fn read_place(
    action: &Element<'_>,
    name: &str,
    context: &mut Context<'_>,
) -> Result<(), ConvertError> {
    action.only(&["Position"])?;
    let place = place_from(&action.need("Position")?, context)?;
    set_place(name, place, context);
    Ok(())
}

/// Puts an entity at a place, and on the lane there.
pub(super) fn set_place(name: &str, place: super::model::Place, context: &mut Context<'_>) {
    let ids = place.spot.and_then(|spot| context.roads.as_ref()?.ids(spot.at.lane));
    if let Some(entity) = context.entities.get_mut(name) {
        entity.place = Some(place);
        entity.lane = ids.map(|(_, lane)| lane);
    }
}

fn read_speed(
    action: &Element<'_>,
    name: &str,
    context: &mut Context<'_>,
) -> Result<(), ConvertError> {
    let speed = action.only_child()?;
    let is_ego = name == context.ego;
    if speed.name() == "LongitudinalDistanceAction" && !is_ego {
        return read_distance(&speed, name, context);
    }
    if is_ego
        && let Some(dynamics) = speed.find("SpeedActionDynamics")?
        && dynamics.find_text("dynamicsShape")?.as_deref() != Some("step")
        && dynamics.find_number("value")? != Some(0.0)
    {
        // The agent begins from standstill.
        context.waiting.retain(|other| other != name);
        return action.leave_out(Part::Ego);
    }
    if !is_ego && let Some(act) = speed_match(&speed, name, context)? {
        let Act::Match { of, factor, delta_mps } = &act else { return Err(speed.unread()) };
        let is_other = |entity: &&Entity| Some(&entity.name) == of.as_ref();
        // `None` is the ego.
        let other = match of {
            None => context.entities.get(&context.ego),
            Some(_) => context.entities.values().find(is_other),
        };
        if context.waiting.contains(&context.ego) || other.is_none() {
            return Err(speed.wrong("refers to an entity whose speed is not known"));
        }
        let begin_mps = factor * other.map_or(0.0, |other| other.begin_mps) + delta_mps;
        context.waiting.retain(|other| other != name);
        let Some(entity) = context.entities.get_mut(name) else { return Err(speed.unread()) };
        entity.begin_mps = begin_mps.clamp(0.0, wildcity_sim::limits::ACTOR_SPEED_M_S);
        // The other may become as fast as any actor, and this one with it.
        entity.fastest_mps = wildcity_sim::limits::ACTOR_SPEED_M_S;
        add(entity, "init-speed", vec![act]);
        return Ok(());
    }
    let profile = match speed_change(&speed, context) {
        // Whatever moves the ego later is the agent's.
        Err(_)
            if is_ego
                && (speed.name() != "SpeedAction"
                    || speed_match(&speed, name, context)?.is_some()) =>
        {
            action.leave_out(Part::Ego)?;
            context.waiting.retain(|other| other != name);
            return Ok(());
        }
        other => other?,
    };
    let is_step = profile.shape == ShapeSection::Step;
    if is_ego && !is_step {
        action.leave_out(Part::Ego)?;
    } else if let Some(entity) = context.entities.get_mut(name) {
        entity.fastest_mps = entity.fastest_mps.max(profile.to);
        match is_step {
            true => entity.begin_mps = profile.to,
            // A ramp without a rate changes nothing.
            false if profile.rate == Some(0.0) => {}
            false => add(entity, "init-speed", vec![Act::Speed(profile)]),
        }
    }
    is_read(name, context);
    Ok(())
}

/// Notes that an action which sets the speed of an entity was read.
fn is_read(name: &str, context: &mut Context<'_>) {
    // Only one entry: an entity has as many as it has such actions.
    if let Some(at) = context.waiting.iter().position(|other| other == name) {
        context.waiting.remove(at);
    }
}

/// Reads a distance of `Init`. Without bounds the entity begins there, as fast as the other.
fn read_distance(
    action: &Element<'_>,
    name: &str,
    context: &mut Context<'_>,
) -> Result<(), ConvertError> {
    let keep = distances::distance(action, name, context);
    let act = distances::or_left_out(action, keep.map(|keep| Act::Keep(Box::new(keep))))?;
    let Some(Act::Keep(keep)) = act else {
        is_read(name, context);
        return Ok(());
    };
    let other = action.text("entityRef")?;
    if context.waiting.contains(&other) {
        return Err(action.wrong("refers to an entity whose speed is not known"));
    }
    let [own, of] = [name, other.as_str()].map(|name| context.entities.get(name));
    let place = own.zip(of).and_then(|(entity, other)| {
        distances::place_at_distance(&keep, entity, other, context.roads.as_ref())
    });
    let other_mps = of.map_or(0.0, |other| other.begin_mps);
    if let Some(place) = place {
        set_place(name, place, context);
    }
    let Some(entity) = context.entities.get_mut(name) else { return Err(action.unread()) };
    // With bounds it begins at its own speed, and reaches its distance later.
    if keep.acceleration.is_none() {
        entity.begin_mps = other_mps;
    }
    // Not needed if it begins at its distance and must not keep it.
    if place.is_none() || keep.once != Some(true) {
        entity.fastest_mps = wildcity_sim::limits::ACTOR_SPEED_M_S;
        add(entity, "init-distance", vec![Act::Keep(keep)]);
    }
    is_read(name, context);
    Ok(())
}

/// Adds a trigger that fires at the start.
fn add(entity: &mut Entity, name: &str, then: Vec<Act>) {
    let taken = |name: &str| entity.script.iter().any(|draft| draft.name == name);
    let free = (1..).map(|index| format!("{name}-{index}")).find(|name| !taken(name));
    let name = if taken(name) { free.unwrap_or_default() } else { name.to_owned() };
    entity.script.push(Draft { name, when: ConditionSection::default(), then });
}

fn read_other(
    action: &Element<'_>,
    name: &str,
    context: &mut Context<'_>,
) -> Result<(), ConvertError> {
    let is_ego = name == context.ego;
    match action.name() {
        "EnvironmentAction" => return action.leave_out(Part::Environment),
        "InfrastructureAction" => return action.leave_out(Part::Signals),
        "EntityAction" => return read_entity_action(action, context),
        "ControllerAction" | "ActivateControllerAction" => {
            return controllers::read_action(action, name, context);
        }
        "RoutingAction" if is_ego => return read_route_of_ego(action, context),
        "AppearanceAction" | "VisibilityAction" => return action.leave_out(Part::Appearance),
        _ if is_ego => return action.leave_out(Part::Ego),
        _ => {}
    }
    if action.name() == "RoutingAction" {
        let follow = action.only_child()?;
        if follow.name() == "AssignRouteAction" {
            let waypoints = waypoints(&follow, context, place_from)?;
            let roads = context.roads.as_ref().ok_or_else(|| follow.wrong("needs the roads"))?;
            let lanes =
                lanes_between(&waypoints, roads).map_err(|message| follow.wrong(&message))?;
            if let Some(entity) = context.entities.get_mut(name) {
                entity.route = lanes;
            }
            return Ok(());
        }
        if follow.name() == "FollowTrajectoryAction" {
            let line = trajectory_line(&follow, context)?;
            if let Some(entity) = context.entities.get_mut(name) {
                entity.line = Some(line);
            }
            return Ok(());
        }
    }
    let Some(act) = private_act(action, name, context)? else { return Ok(()) };
    let Some(entity) = context.entities.get_mut(name) else { return Err(action.unread()) };
    // A later change that is relative to this entity counts from the new lane.
    if let Act::Lane { lane, .. } = &act {
        entity.lane = Some(*lane);
    }
    add(entity, "init", vec![act]);
    Ok(())
}

/// Reads where the ego goes; what does not say that is left out on request.
pub(super) fn read_route_of_ego(
    action: &Element<'_>,
    context: &mut Context<'_>,
) -> Result<(), ConvertError> {
    match read_ego_route(action, context) {
        Ok(()) => Ok(()),
        Err(_) if action.leaves_out(Part::Ego) => action.leave_out(Part::Ego),
        Err(ConvertError { place, message }) => {
            let part = Part::Ego.name();
            Err(ConvertError::new(place, format!("{message}; or use --leave-out {part}")))
        }
    }
}

fn read_entity_action(action: &Element<'_>, context: &mut Context<'_>) -> Result<(), ConvertError> {
    let name = action.text("entityRef")?;
    let kind = action.only_child()?;
    let place = match kind.name() {
        "AddEntityAction" => Some(place_from(&kind.need("Position")?, context)?),
        "DeleteEntityAction" => None,
        _ => return Err(kind.unread()),
    };
    if name == context.ego || !context.entities.contains_key(&name) {
        return Err(action.wrong(&format!("{name:?} is the ego, or no entity")));
    }
    if let Some(place) = place {
        set_place(&name, place, context);
    }
    if let Some(entity) = context.entities.get_mut(&name) {
        // What `Init` deletes is not there from the start on.
        entity.present = place.is_some();
    }
    Ok(())
}
