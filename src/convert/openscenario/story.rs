//! Reads the stories: their events, with the actions of entities.

use wildcity_sim::scenario::ConditionSection;

use super::actions::{private_act, profile_entry};
use super::catalogs::declared;
use super::conditions::trigger_condition;
use super::element::Element;
use super::elements::{Elements, Event, unknown};
use super::init::{read_route_of_ego, set_place};
use super::ledger::Part;
use super::model::{Act, Context, Draft};
use super::position::place_from;
use crate::ConvertError;

/// The place of an event in the storyboard.
struct Scope<'e, 'a> {
    /// The types and names of the elements around it.
    names: Vec<(String, String)>,
    actors: Vec<String>,
    /// The trigger that fires when the act starts.
    gate: Option<String>,
    maneuver: &'e Element<'a>,
}

/// Reads the events of a story.
pub(super) fn read_story<'a>(
    story: &Element<'a>,
    context: &mut Context<'a>,
    elements: &mut Elements,
) -> Result<(), ConvertError> {
    let story = declared(story)?;
    story.only(&["ParameterDeclarations", "Act"])?;
    let story_name = story.find_text("name")?.unwrap_or_default();
    elements.count("story", &story_name);
    for act in story.all("Act") {
        act.only(&["ManeuverGroup", "StartTrigger", "StopTrigger"])?;
        if let Some(stop) = act.find("StopTrigger")?
            && stop.children().next().is_some()
        {
            stop.leave_out(Part::Stop)?;
        }
        let act_name = act.find_text("name")?.unwrap_or_default();
        elements.count("act", &act_name);
        let gate = act_gate(&act, &act_name, context, elements)?;
        for group in act.all("ManeuverGroup") {
            group.only(&["Actors", "Maneuver", "CatalogReference"])?;
            group.ignore(&["maximumExecutionCount"])?;
            let actors = group.need("Actors")?;
            actors.only(&["EntityRef"])?;
            actors.expect("selectTriggeringEntities", &["false", "0"])?;
            let names: Result<Vec<String>, _> =
                actors.children().map(|actor| actor.text("entityRef")).collect();
            let names = names?;
            let group_name = group.find_text("name")?.unwrap_or_default();
            elements.count("maneuverGroup", &group_name);
            for maneuver in group.children().filter(|child| child.name() != "Actors") {
                let maneuver = match maneuver.name() {
                    "CatalogReference" => context.catalogs.entry(&maneuver)?,
                    _ => declared(&maneuver)?,
                };
                maneuver.only(&["ParameterDeclarations", "Event"])?;
                let maneuver_name = maneuver.find_text("name")?.unwrap_or_default();
                elements.count("maneuver", &maneuver_name);
                let around = [
                    ("story", &story_name),
                    ("act", &act_name),
                    ("maneuverGroup", &group_name),
                    ("maneuver", &maneuver_name),
                ];
                // Whatever the agent's entity does is not carried out at all.
                if names.iter().any(|name| *name != context.ego) {
                    group.expect("maximumExecutionCount", &["1"])?;
                }
                let scope = Scope {
                    names: around.map(|(kind, name)| (kind.to_owned(), name.clone())).to_vec(),
                    actors: names.clone(),
                    gate: gate.clone(),
                    maneuver: &maneuver,
                };
                for event in maneuver.all("Event") {
                    read_event(&event, &scope, context, elements)?;
                }
                maneuver.check_read()?;
            }
        }
    }
    Ok(())
}

/// The trigger that fires when an act starts; `None` if it starts with the scenario.
fn act_gate(
    act: &Element<'_>,
    name: &str,
    context: &mut Context<'_>,
    elements: &mut Elements,
) -> Result<Option<String>, ConvertError> {
    let start = act
        .find("StartTrigger")?
        .map(|start| trigger_condition(&start, context, true))
        .transpose()?
        .unwrap_or_default();
    // An act that starts at time 0 needs no mark, because its events need not wait for it.
    let at_once = ConditionSection { time_s: Some(0.0), ..ConditionSection::default() };
    let gate = if start == ConditionSection::default() || start == at_once {
        None
    } else {
        Some(elements.mark(&format!("act-{name}"), start, context, act)?)
    };
    elements.acts.insert(name.to_owned(), gate.clone());
    Ok(gate)
}

fn read_event<'a>(
    event: &Element<'a>,
    scope: &Scope<'_, 'a>,
    context: &mut Context<'a>,
    elements: &mut Elements,
) -> Result<(), ConvertError> {
    event.only(&["Action", "StartTrigger"])?;
    let priority = event.find_text("priority")?.unwrap_or_else(|| "override".to_owned());
    let is_overriding = match priority.as_str() {
        "override" | "overwrite" => true,
        "parallel" => false,
        // Alone in its maneuver, there is no other event that could make it skip.
        "skip" if scope.maneuver.all("Event").count() == 1 => false,
        _ => {
            let message = format!(
                "priority={priority:?} is not read; override or parallel is, or skip alone"
            );
            return Err(event.wrong(&message));
        }
    };
    let is_of_ego = scope.actors.iter().all(|name| *name == context.ego);
    let is_global = event.all("Action").any(|action| action.all("PrivateAction").count() == 0);
    let is_of_ego = is_of_ego && !is_global;
    if !is_of_ego {
        event.expect("maximumExecutionCount", &["1"])?;
    }
    event.ignore(&["maximumExecutionCount"])?;
    // A name that is no formula is a text.
    let name = event.text("name").or_else(|_| event.raw("name"))?;
    let start = event.find("StartTrigger")?;
    let read = start.as_ref().map(|start| trigger_condition(start, context, scope.gate.is_none()));
    let start = match (read.transpose(), &start) {
        // When the agent's entity would act does not matter, if nothing waits for it.
        (Err(_), Some(start)) if is_of_ego => {
            start.leave_out(Part::Ego)?;
            unknown()
        }
        (start, _) => start?.unwrap_or_default(),
    };
    let when = match &scope.gate {
        None => start,
        // It waits for its act, and then for its own trigger.
        Some(gate) => {
            let gate = Some(gate.clone());
            ConditionSection { after: gate, all: vec![start], ..ConditionSection::default() }
        }
    };
    let index = elements.events.len();
    // Before its actions are read, because these add their triggers to it.
    elements.events.push(Event::default());
    let own = ("event".to_owned(), name.clone());
    for key in scope.names.iter().chain([&own]) {
        elements.by_name.entry(key.clone()).or_default().push(index);
    }
    let mut read = EventRead { index, name: &name, when: &when, is_overriding, scope };
    for action in event.all("Action") {
        read.action(&action, context, elements)?;
    }
    Ok(())
}

/// An event while its actions are read.
struct EventRead<'e, 'a> {
    index: usize,
    name: &'e str,
    when: &'e ConditionSection,
    is_overriding: bool,
    scope: &'e Scope<'e, 'a>,
}

impl<'a> EventRead<'_, 'a> {
    fn action(
        &mut self,
        action: &Element<'a>,
        context: &mut Context<'a>,
        elements: &mut Elements,
    ) -> Result<(), ConvertError> {
        let action_name = action.text("name").or_else(|_| action.raw("name")).unwrap_or_default();
        let key = ("action".to_owned(), action_name.clone());
        elements.by_name.entry(key).or_default().push(self.index);
        let kind = action.only_child()?;
        match kind.name() {
            "PrivateAction" => {
                let kind = kind.only_child()?;
                // Each actor of the group does the action.
                for target in &self.scope.actors {
                    self.add_act(&kind, target, &action_name, context, elements)?;
                }
                Ok(())
            }
            "GlobalAction" => {
                let global = kind.only_child()?;
                match global.name() {
                    "EntityAction" => {
                        let target = global.text("entityRef")?;
                        self.add_act(
                            &global.only_child()?,
                            &target,
                            &action_name,
                            context,
                            elements,
                        )
                    }
                    "ParameterAction" | "VariableAction" => {
                        let is_parameter = global.name() == "ParameterAction";
                        let attribute = if is_parameter { "parameterRef" } else { "variableRef" };
                        global.raw(attribute)?;
                        let set = global.only_child()?;
                        if set.name() != "SetAction" {
                            return Err(set.unread());
                        }
                        // Conditions that read the value wait for the event.
                        set.raw("value")?;
                        self.mark_ego(Some(0.0), &set, context, elements)
                    }
                    "EnvironmentAction" => global.leave_out(Part::Environment),
                    "InfrastructureAction" => global.leave_out(Part::Signals),
                    _ => Err(global.unread()),
                }
            }
            "UserDefinedAction" => kind.leave_out(Part::Custom),
            _ => Err(kind.unread()),
        }
    }

    /// Adds an action of an entity.
    fn add_act(
        &mut self,
        kind: &Element<'a>,
        target: &str,
        action_name: &str,
        context: &mut Context<'a>,
        elements: &mut Elements,
    ) -> Result<(), ConvertError> {
        if !context.entities.contains_key(target) {
            return Err(kind.wrong(&format!("there is no entity {target:?}")));
        }
        let is_controller = matches!(kind.name(), "ControllerAction" | "ActivateControllerAction");
        let is_look = matches!(kind.name(), "AppearanceAction" | "VisibilityAction");
        if target == context.ego && !is_controller && !is_look {
            if kind.name() == "RoutingAction" && is_destination(kind) {
                read_route_of_ego(kind, context)?;
                // The agent decides how fast it drives, so that the duration is unknown.
                return self.mark_ego(None, kind, context, elements);
            }
            let duration_s = duration_s(kind)?;
            kind.leave_out(Part::Ego)?;
            return self.mark_ego(duration_s, kind, context, elements);
        }
        if kind.name() == "LongitudinalAction" {
            let profile = kind.only_child()?;
            if profile.name() == "SpeedProfileAction" {
                return self.speed_profile(&profile, target, action_name, context, elements);
            }
        }
        let act = match kind.name() {
            "AddEntityAction" => {
                let place = place_from(&kind.need("Position")?, context)?;
                set_place(target, place, context);
                Act::Spawn
            }
            "DeleteEntityAction" => Act::Remove,
            "TeleportAction" => {
                let place = place_from(&kind.need("Position")?, context)?;
                let before = context.entities.get(target).and_then(|entity| entity.place);
                set_place(target, place, context);
                if let Some(entity) = context.entities.get_mut(target) {
                    // The lane is the new one; the place stays that of the start.
                    entity.place = before;
                }
                Act::Place(place)
            }
            _ => match private_act(kind, target, context)? {
                Some(act) => act,
                // Left out: it has no duration.
                None => {
                    let is_over = is_controller || is_look;
                    return self.mark_ego(is_over.then_some(0.0), kind, context, elements);
                }
            },
        };
        self.add((act, self.when.clone()), target, action_name, context, elements, kind)?;
        Ok(())
    }

    /// Adds a change of speed for each entry of a profile, each when the one before is over.
    fn speed_profile(
        &self,
        profile: &Element<'a>,
        target: &str,
        action_name: &str,
        context: &mut Context<'a>,
        elements: &mut Elements,
    ) -> Result<(), ConvertError> {
        profile.expect("followingMode", &["position"])?;
        profile.only(&["SpeedProfileEntry"])?;
        // The first entry waits for the event, and each further one for the end of the one before
        // it.
        let mut when = self.when.clone();
        for entry in profile.children() {
            let (act, over_s) = profile_entry(&entry)?;
            let trigger = self.add((act, when), target, action_name, context, elements, &entry)?;
            let delay_s = Some(over_s).filter(|over_s| *over_s > 0.0);
            when = ConditionSection { after: Some(trigger), delay_s, ..Default::default() };
        }
        Ok(())
    }

    /// Marks the start of an event that has left out actions.
    fn mark_ego(
        &self,
        duration_s: Option<f64>,
        kind: &Element<'_>,
        context: &Context<'_>,
        elements: &mut Elements,
    ) -> Result<(), ConvertError> {
        let mark = match elements.events[self.index].mark.take() {
            Some((mark, before_s)) => {
                // If one duration is unknown, so is the longest.
                let longest_s = before_s.zip(duration_s).map(|(a, b)| f64::max(a, b));
                (mark, longest_s)
            }
            None => (elements.mark(self.name, self.when.clone(), context, kind)?, duration_s),
        };
        elements.events[self.index].mark = Some(mark);
        Ok(())
    }

    fn add(
        &self,
        (act, when): (Act, ConditionSection),
        target: &str,
        action_name: &str,
        context: &mut Context<'_>,
        elements: &mut Elements,
        kind: &Element<'_>,
    ) -> Result<String, ConvertError> {
        let Some(entity) = context.entities.get_mut(target) else { return Err(kind.unread()) };
        match &act {
            Act::Speed(profile) => entity.fastest_mps = entity.fastest_mps.max(profile.to),
            Act::Match { .. } | Act::Keep(_) | Act::Arrive(_) => {
                entity.fastest_mps = wildcity_sim::limits::ACTOR_SPEED_M_S
            }
            Act::Lane { lane, .. } => entity.lane = Some(*lane),
            // An entity that an event adds is not there before.
            Act::Spawn if entity.script.is_empty() => entity.present = false,
            _ => {}
        }
        let plain = super::plain_name(self.name);
        let taken = |name: &str| entity.script.iter().any(|draft| draft.name == name);
        let mut free = (1..1000).map(|index| match index {
            1 => plain.clone(),
            _ => format!("{plain}-{index}"),
        });
        let name = free
            .find(|name| !taken(name))
            .ok_or_else(|| kind.wrong("is there too often; rename some events"))?;
        let reference = format!("{}/{name}", entity.name);
        let mut then = Vec::new();
        if self.is_overriding && act.is_motion() {
            // Of the other events of this maneuver, what is under way ends.
            // `names` has the story, the act, the group and, at index 3, the maneuver.
            let key = &self.scope.names[3];
            let maneuver = elements.by_name.get(key).into_iter().flatten();
            let others = maneuver
                .filter(|index| **index != self.index)
                .flat_map(|index| &elements.events[*index].triggers);
            let own = format!("{}/", entity.name);
            then.extend(others.filter_map(|(trigger, _)| {
                let name = trigger.strip_prefix(&own)?;
                let draft = entity.script.iter().find(|draft| draft.name == name)?;
                // A change of the same kind is replaced anyway.
                let replaces = draft
                    .then
                    .iter()
                    .any(|other| std::mem::discriminant(other) == std::mem::discriminant(&act));
                let moves = draft.then.iter().any(Act::is_motion);
                (moves && !replaces).then(|| Act::Halt(name.to_owned()))
            }));
        }
        let is_line =
            |draft: &Draft| draft.then.iter().any(|act| matches!(act, Act::Trajectory(_)));
        let halts_line = then.iter().any(|act| match act {
            Act::Halt(name) => {
                entity.script.iter().any(|draft| draft.name == *name && is_line(draft))
            }
            _ => false,
        });
        if halts_line {
            kind.note(
                "ends a trajectory of its maneuver by its priority: the actor stays on the line",
            );
        }
        then.push(act);
        entity.script.push(Draft { name, when, then });
        let triggers = &mut elements.events[self.index].triggers;
        triggers.push((reference.clone(), action_name.to_owned()));
        Ok(reference)
    }
}

/// Whether a `<RoutingAction>` says where to go.
fn is_destination(routing: &Element<'_>) -> bool {
    let names = ["AssignRouteAction", "AcquirePositionAction", "FollowTrajectoryAction"];
    routing.children().any(|action| names.contains(&action.name()))
}

/// How long an action lasts, in seconds, if its dynamics say so.
fn duration_s(kind: &Element<'_>) -> Result<Option<f64>, ConvertError> {
    let Some(action) = kind.children().next() else { return Ok(None) };
    for dynamics in action.children().filter(|child| child.name().ends_with("Dynamics")) {
        if dynamics.find_text("dynamicsShape")?.as_deref() == Some("step") {
            return Ok(Some(0.0));
        }
        if dynamics.find_text("dynamicsDimension")?.as_deref() == Some("time") {
            return dynamics.find_number("value");
        }
    }
    // A teleport takes no time.
    Ok(matches!(kind.name(), "TeleportAction").then_some(0.0))
}
