//! Reads `Init`: where entities start, how fast, and what they do from the start on.

use wildcity_sim::scenario::{ConditionSection, ShapeSection};

use super::actions::{private_act, speed_of, trajectory_of};
use super::element::Element;
use super::ledger::Part;
use super::model::{Act, Context, Draft, Entity};
use super::position::place_of;
use crate::ConvertError;

/// An action of `Init` with its entity.
type InitAction<'a> = (String, Element<'a>);

/// Reads the actions of `Init`. An action that refers to another entity is read after those of that entity.
pub(super) fn read_init<'a>(
    init: &Element<'a>,
    context: &mut Context<'a>,
) -> Result<(), ConvertError> {
    init.only(&["Actions"])?;
    let actions = init.need("Actions")?;
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
        let mut waiting = Vec::new();
        for (name, action) in actions {
            if let Err(error) = read(&action, &name, context) {
                first.get_or_insert(error);
                waiting.push((name, action));
            }
        }
        match first {
            None => return Ok(()),
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
    let place = place_of(&action.need("Position")?, context)?;
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
    let profile = match speed_of(&speed, context) {
        // Whatever moves the ego later is the agent's.
        Err(_) if is_ego && speed.name() != "SpeedAction" => {
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
            false => add(entity, "init-speed", vec![Act::Speed(profile)]),
        }
    }
    if let Some(at) = context.waiting.iter().position(|other| other == name) {
        context.waiting.remove(at);
    }
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
            return action.leave_out(Part::Controllers);
        }
        "AppearanceAction" | "VisibilityAction" => return action.leave_out(Part::Appearance),
        _ if is_ego => return action.leave_out(Part::Ego),
        _ => {}
    }
    if action.name() == "RoutingAction" {
        let follow = action.only_child()?;
        if follow.name() == "FollowTrajectoryAction" {
            let line = trajectory_of(&follow, context)?;
            if let Some(entity) = context.entities.get_mut(name) {
                entity.line = Some(line);
            }
            return Ok(());
        }
    }
    let Some(act) = private_act(action, name, context)? else { return Ok(()) };
    let Some(entity) = context.entities.get_mut(name) else { return Err(action.unread()) };
    if let Act::Lane { lane, .. } = &act {
        entity.lane = Some(*lane);
    }
    add(entity, "init", vec![act]);
    Ok(())
}

fn read_entity_action(
    action: &Element<'_>,
    context: &mut Context<'_>,
) -> Result<(), ConvertError> {
    let name = action.text("entityRef")?;
    let kind = action.only_child()?;
    let place = match kind.name() {
        "AddEntityAction" => Some(place_of(&kind.need("Position")?, context)?),
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
        entity.present = place.is_some();
    }
    Ok(())
}
