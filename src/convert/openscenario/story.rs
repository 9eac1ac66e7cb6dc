//! Reads the stories: events, and the states of the storyboard's elements that others wait for.

use std::collections::BTreeMap;

use wildcity_sim::scenario::{ConditionSection, PhaseSection};

use super::actions::private_act;
use super::catalogs::declared;
use super::conditions::{PENDING, all_of, group_of, trigger_of};
use super::element::Element;
use super::init::set_place;
use super::ledger::Part;
use super::model::{Act, Context, Draft};
use super::position::place_of;
use crate::ConvertError;

/// The events by the elements of the storyboard that contain them.
#[derive(Debug, Default)]
pub(super) struct Elements {
    events: Vec<Event>,
    /// Indices of events by the type and the name of an element.
    by_name: BTreeMap<(String, String), Vec<usize>>,
    /// The triggers that fire when an act starts; `None` for an act that starts with the scenario.
    acts: BTreeMap<String, Option<String>>,
    /// Triggers that only mark an instant.
    marks: Vec<(String, Draft)>,
}

/// An event.
#[derive(Debug, Default)]
struct Event {
    /// `ACTOR/TRIGGER` of its actions, with the names of the actions.
    triggers: Vec<(String, String)>,
    /// The trigger that marks the start of an event of the ego, and the longest of its actions, in seconds, if known.
    mark: Option<(String, Option<f64>)>,
}

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
    for act in story.all("Act") {
        act.only(&["ManeuverGroup", "StartTrigger", "StopTrigger"])?;
        if let Some(stop) = act.find("StopTrigger")?
            && stop.children().next().is_some()
        {
            stop.leave_out(Part::Stop)?;
        }
        let act_name = act.find_text("name")?.unwrap_or_default();
        let gate = gate_of(&act, &act_name, context, elements)?;
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
            for maneuver in group.children().filter(|child| child.name() != "Actors") {
                let maneuver = match maneuver.name() {
                    "CatalogReference" => context.catalogs.entry(&maneuver)?,
                    _ => declared(&maneuver)?,
                };
                maneuver.only(&["ParameterDeclarations", "Event"])?;
                let maneuver_name = maneuver.find_text("name")?.unwrap_or_default();
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
fn gate_of(
    act: &Element<'_>,
    name: &str,
    context: &mut Context<'_>,
    elements: &mut Elements,
) -> Result<Option<String>, ConvertError> {
    let start = act.find("StartTrigger")?;
    let start = start.map(|start| trigger_of(&start, context, true)).transpose()?;
    let start = start.unwrap_or_default();
    let at_once = ConditionSection { time_s: Some(0.0), ..ConditionSection::default() };
    let gate = match start == ConditionSection::default() || start == at_once {
        true => None,
        false => Some(elements.mark(&format!("act-{name}"), start, context, act)?),
    };
    elements.acts.insert(name.to_owned(), gate.clone());
    Ok(gate)
}

impl Elements {
    /// Adds a trigger that only marks an instant. Returns `ACTOR/TRIGGER`.
    fn mark(
        &mut self,
        name: &str,
        when: ConditionSection,
        context: &Context<'_>,
        element: &Element<'_>,
    ) -> Result<String, ConvertError> {
        let actor = context.entities.iter().find(|(name, _)| **name != context.ego);
        // Without an actor, nothing can wait for it.
        let Some((key, entity)) = actor else { return Ok(String::new()) };
        let plain = super::plain_name(name);
        let taken = |name: &str| self.marks.iter().any(|(_, draft)| draft.name == name);
        let mut free = (1..1000).map(|index| match index {
            1 => format!("at-{plain}"),
            _ => format!("at-{plain}-{index}"),
        });
        let name = free.find(|name| !taken(name));
        let name = name.ok_or_else(|| element.wrong("is there too often; rename some"))?;
        let reference = format!("{}/{name}", entity.name);
        self.marks.push((key.clone(), Draft { name, when, then: Vec::new() }));
        Ok(reference)
    }
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
    let read = start.as_ref().map(|start| trigger_of(start, context, scope.gate.is_none()));
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
        Some(gate) => {
            let gate = Some(gate.clone());
            ConditionSection { after: gate, all: vec![start], ..ConditionSection::default() }
        }
    };
    let index = elements.events.len();
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

/// A condition that was not read: nothing may wait for it.
fn unknown() -> ConditionSection {
    let after = Some(format!("{PENDING}unread{PENDING}{PENDING}"));
    ConditionSection { after, ..ConditionSection::default() }
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
                for target in &self.scope.actors {
                    self.act_of(&kind, target, &action_name, context, elements)?;
                }
                Ok(())
            }
            "GlobalAction" => {
                let global = kind.only_child()?;
                match global.name() {
                    "EntityAction" => {
                        let target = global.text("entityRef")?;
                        self.act_of(&global.only_child()?, &target, &action_name, context, elements)
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
    fn act_of(
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
                let place = place_of(&kind.need("Position")?, context)?;
                set_place(target, place, context);
                Act::Spawn
            }
            "DeleteEntityAction" => Act::Remove,
            "TeleportAction" => {
                let place = place_of(&kind.need("Position")?, context)?;
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
        let mut when = self.when.clone();
        for entry in profile.children() {
            let (act, over_s) = super::actions::profile_entry(&entry)?;
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
            Act::Match { .. } => entity.fastest_mps = wildcity_sim::limits::ACTOR_SPEED_M_S,
            Act::Lane { lane, .. } => entity.lane = Some(*lane),
            Act::Spawn if entity.script.is_empty() => entity.present = false,
            _ => {}
        }
        let plain = super::plain_name(self.name);
        let taken = |name: &str| entity.script.iter().any(|draft| draft.name == name);
        let mut free = (1..1000).map(|index| match index {
            1 => plain.clone(),
            _ => format!("{plain}-{index}"),
        });
        let name = free.find(|name| !taken(name));
        let name = name.ok_or_else(|| kind.wrong("is there too often; rename some events"))?;
        let reference = format!("{}/{name}", entity.name);
        let mut then = Vec::new();
        if self.is_overriding && act.is_motion() {
            // Of the other events of this maneuver, what is under way ends.
            let key = &self.scope.names[3];
            let maneuver = elements.by_name.get(key).into_iter().flatten();
            let others = maneuver.filter(|index| **index != self.index);
            let others = others.flat_map(|index| &elements.events[*index].triggers);
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
    Ok(matches!(kind.name(), "TeleportAction").then_some(0.0))
}

/// Puts triggers in place of the names of storyboard elements, and adds the marks that conditions wait for.
pub(super) fn resolve(elements: Elements, context: &mut Context<'_>) -> Result<(), ConvertError> {
    let mut elements = elements;
    let marks = std::mem::take(&mut elements.marks);
    // Marks that nothing waits for may have conditions that were not read.
    let mut resolved = Vec::new();
    for (key, mut mark) in marks {
        let error = resolve_condition(&mut mark.when, &elements).err();
        resolved.push((key, mark, error));
    }
    let mut marks = resolved;
    for entity in context.entities.values_mut() {
        for draft in &mut entity.script {
            resolve_condition(&mut draft.when, &elements)?;
        }
    }
    // Only what something waits for: first by actions, then by the marks themselves.
    let mut wanted: Vec<String> = Vec::new();
    for draft in context.entities.values().flat_map(|entity| &entity.script) {
        names_of(&draft.when, &mut wanted);
    }
    loop {
        let is_wanted = |key: &str, mark: &Draft| {
            let actor = context.entities.get(key).map(|entity| &entity.name);
            actor.is_some_and(|actor| wanted.contains(&format!("{actor}/{}", mark.name)))
        };
        let Some(at) = marks.iter().position(|(key, mark, _)| is_wanted(key, mark)) else {
            return Ok(());
        };
        let (key, mark, error) = marks.remove(at);
        if let Some(error) = error {
            return Err(error);
        }
        names_of(&mark.when, &mut wanted);
        if let Some(entity) = context.entities.get_mut(&key) {
            entity.script.push(mark);
        }
    }
}

/// The triggers that a condition waits for.
fn names_of(when: &ConditionSection, names: &mut Vec<String>) {
    names.extend(when.after.clone());
    when.all.iter().chain(&when.any).for_each(|part| names_of(part, names));
}

fn resolve_condition(when: &mut ConditionSection, elements: &Elements) -> Result<(), ConvertError> {
    for part in when.all.iter_mut().chain(&mut when.any) {
        resolve_condition(part, elements)?;
    }
    let Some(pending) = when.after.as_deref().and_then(|after| after.strip_prefix(PENDING)) else {
        return Ok(());
    };
    let mut words = pending.split(PENDING);
    let [kind, name, line] = [(); 3].map(|()| words.next().unwrap_or_default().to_owned());
    let place = format!("line {line}, <StoryboardElementStateCondition>");
    let phase = when.phase.unwrap_or(PhaseSection::Fired);
    let parts = elements.afters(&kind, &name, phase, when.delay_s.unwrap_or(0.0));
    let parts = parts.map_err(|message| ConvertError::new(place, message))?;
    let after = all_of(parts);
    *when = ConditionSection { after: None, phase: None, delay_s: None, ..when.clone() };
    *when = match *when == ConditionSection::default() {
        true => after,
        false => all_of(vec![after, when.clone()]),
    };
    Ok(())
}

impl Elements {
    /// The conditions that wait for an element of the storyboard.
    fn afters(
        &self,
        kind: &str,
        name: &str,
        phase: PhaseSection,
        delay_s: f64,
    ) -> Result<Vec<ConditionSection>, String> {
        let at_start = || ConditionSection { time_s: Some(delay_s), ..Default::default() };
        let after = |trigger: &str, phase: PhaseSection, delay_s: f64| ConditionSection {
            after: Some(trigger.to_owned()),
            phase: (phase != PhaseSection::Fired).then_some(phase),
            delay_s: (delay_s > 0.0).then_some(delay_s),
            ..Default::default()
        };
        let is_fired = phase == PhaseSection::Fired;
        if kind == "act" && is_fired {
            return match self.acts.get(name) {
                None => Err(format!("there is no act {name:?}")),
                Some(None) => Ok(vec![at_start()]),
                Some(Some(gate)) => Ok(vec![after(gate, phase, delay_s)]),
            };
        }
        if kind == "story" && is_fired {
            return Ok(vec![at_start()]);
        }
        if kind == "unread" {
            return Err("waits for an event of the ego whose condition is not read".to_owned());
        }
        let key = (kind.to_owned(), name.to_owned());
        let Some(events) = self.by_name.get(&key) else {
            return Err(format!("there is no {kind} {name:?}"));
        };
        let is_one = matches!(kind, "event" | "action");
        if is_one && events.windows(2).any(|pair| pair[0] != pair[1]) {
            return Err(format!("{kind} {name:?} is there several times; rename them"));
        }
        if is_fired && !is_one {
            return Err(format!("waits for the start of a {kind}; name its act or an event"));
        }
        let mut parts = Vec::new();
        for event in events.iter().map(|index| &self.events[*index]) {
            let triggers = event.triggers.iter();
            let triggers = triggers.filter(|(_, action)| kind != "action" || action == name);
            parts.extend(triggers.map(|(trigger, _)| after(trigger, phase, delay_s)));
            let has_own = kind == "action" && !parts.is_empty();
            let Some((mark, duration_s)) = event.mark.as_ref().filter(|_| !has_own) else {
                continue;
            };
            let duration_s = if is_fired { Some(0.0) } else { *duration_s };
            let Some(duration_s) = duration_s else {
                let message = format!(
                    "waits for the end of {kind} {name:?}, whose actions of the ego are left out: the agent drives it"
                );
                return Err(message);
            };
            parts.push(after(mark, PhaseSection::Fired, delay_s + duration_s));
        }
        parts.dedup();
        match parts.is_empty() {
            true => Err(format!("{kind} {name:?} has no actions")),
            false => Ok(parts),
        }
    }
}

/// When a `<StopTrigger>` ends the scenario, in seconds; `None` if it does not by time.
pub(super) fn stop_time_s(
    stop: &Element<'_>,
    context: &Context<'_>,
) -> Result<Option<f64>, ConvertError> {
    stop.only(&["ConditionGroup"])?;
    let mut end_s: Option<f64> = None;
    for group in stop.children() {
        let kinds: Vec<&str> = group
            .children()
            .filter_map(|condition| Some(condition.only_child().ok()?.only_child().ok()?.name()))
            .collect();
        if kinds.is_empty() {
            return Err(group.wrong("is empty"));
        }
        let is_time = |kind: &&str| **kind == *"SimulationTimeCondition";
        let condition = match kinds.iter().all(is_time) {
            // A mistake in a time is no other kind of condition.
            true => Ok(group_of(&group, context, true)?),
            false if kinds.iter().all(|kind| is_time(kind) || *kind == "ParameterCondition") => {
                group_of(&group, context, true)
            }
            false => Err(group.unread()),
        };
        let Ok(condition) = condition else {
            group.leave_out(Part::Stop)?;
            continue;
        };
        let parts = condition.all.iter().chain([&condition]).filter_map(|part| part.time_s);
        let time_s = parts.fold(0.0, f64::max);
        // A parameter that is another never ends it.
        if time_s < wildcity_sim::limits::END_S {
            end_s = Some(end_s.map_or(time_s, |before_s| before_s.min(time_s)));
        }
    }
    Ok(end_s)
}
