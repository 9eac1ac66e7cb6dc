//! The storyboard's elements: what waits for which of them.

use std::collections::BTreeMap;

use wildcity_sim::limits;
use wildcity_sim::scenario::{ConditionSection, PhaseSection};

use super::conditions::{PENDING, join_all};
use super::element::Element;
use super::model::{Context, Draft};
use crate::ConvertError;

/// The events by the elements of the storyboard that contain them.
#[derive(Debug, Default)]
pub(super) struct Elements {
    pub(super) events: Vec<Event>,
    /// Indices of events by the type and the name of an element.
    pub(super) by_name: BTreeMap<(String, String), Vec<usize>>,
    /// How many stories, acts, groups and maneuvers have a name, by type and name.
    counts: BTreeMap<(String, String), usize>,
    /// The triggers that fire when an act starts; `None` for an act that starts with the scenario.
    pub(super) acts: BTreeMap<String, Option<String>>,
    /// Triggers that only mark an instant.
    marks: Vec<(String, Draft)>,
}

#[derive(Debug, Default)]
pub(super) struct Event {
    /// `ACTOR/TRIGGER` of its actions, with the names of the actions.
    pub(super) triggers: Vec<(String, String)>,
    /// The trigger that marks the start of an event of the ego, and the longest of its actions, in
    /// seconds, if known.
    pub(super) mark: Option<(String, Option<f64>)>,
}

impl Elements {
    /// Counts an element that contains events.
    pub(super) fn count(&mut self, kind: &str, name: &str) {
        *self.counts.entry((kind.to_owned(), name.to_owned())).or_default() += 1;
    }

    /// Adds a trigger that only marks an instant. Returns `ACTOR/TRIGGER`.
    pub(super) fn mark(
        &mut self,
        name: &str,
        when: ConditionSection,
        context: &Context<'_>,
        element: &Element<'_>,
    ) -> Result<String, ConvertError> {
        // A trigger belongs to an actor. A mark has no actions, so that any actor will do.
        let actor = context.entities.iter().find(|(name, _)| **name != context.ego);
        // Without an actor, nothing can wait for it.
        let Some((key, entity)) = actor else { return Ok(String::new()) };
        let plain = super::plain_name(name);
        let taken = |name: &str| self.marks.iter().any(|(_, draft)| draft.name == name);
        let mut free = (1..1000).map(|index| match index {
            1 => format!("at-{plain}"),
            _ => format!("at-{plain}-{index}"),
        });
        let name = free
            .find(|name| !taken(name))
            .ok_or_else(|| element.wrong("is there too often; rename some"))?;
        let reference = format!("{}/{name}", entity.name);
        self.marks.push((key.clone(), Draft { name, when, then: Vec::new() }));
        Ok(reference)
    }
}

/// A condition that was not read: nothing may wait for it.
pub(super) fn unknown() -> ConditionSection {
    let after = Some(format!("{PENDING}unread{PENDING}{PENDING}"));
    ConditionSection { after, ..ConditionSection::default() }
}

/// Puts triggers in place of the names of storyboard elements, and adds the marks that conditions
/// wait for. Returns the conditions of `ends`, the groups of the stop trigger.
pub(super) fn resolve(
    elements: Elements,
    ends: Vec<(Element<'_>, ConditionSection)>,
    context: &mut Context<'_>,
) -> Result<Vec<ConditionSection>, ConvertError> {
    let mut elements = elements;
    let marks = std::mem::take(&mut elements.marks);
    // Marks that nothing waits for may have conditions that were not read.
    let mut resolved = Vec::new();
    for (key, mut mark) in marks {
        // The error counts only if something waits for the mark.
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
        collect_names(&draft.when, &mut wanted);
    }
    let mut conditions = Vec::new();
    for (group, mut when) in ends {
        let resolved = resolve_condition(&mut when, &elements);
        // The groups become the parts of one condition, which counts as well.
        let is_small = || match count(&when) + conditions.iter().map(count).sum::<usize>() {
            sum if sum + 1 < limits::CONDITIONS => Ok(()),
            _ => Err(group.wrong("waits for more events than a condition may have parts")),
        };
        let marked = resolved.and_then(|()| is_small());
        match marked.and_then(|()| check_marks(&when, &marks, context)) {
            Ok(()) => {
                collect_names(&when, &mut wanted);
                conditions.push(when);
            }
            Err(error) => super::stop::leave_out(&group, error)?,
        }
    }
    // A wanted mark may wait for others, which are wanted then. Each round takes one mark away, so
    // that the loop ends.
    loop {
        let is_wanted = |key: &str, mark: &Draft| {
            let actor = context.entities.get(key).map(|entity| &entity.name);
            actor.is_some_and(|actor| wanted.contains(&format!("{actor}/{}", mark.name)))
        };
        let Some(at) = marks.iter().position(|(key, mark, _)| is_wanted(key, mark)) else {
            return Ok(conditions);
        };
        let (key, mark, error) = marks.remove(at);
        if let Some(error) = error {
            return Err(error);
        }
        collect_names(&mark.when, &mut wanted);
        if let Some(entity) = context.entities.get_mut(&key) {
            entity.script.push(mark);
        }
    }
}

/// The number of a condition and its parts.
fn count(when: &ConditionSection) -> usize {
    1 + when.all.iter().chain(&when.any).map(count).sum::<usize>()
}

/// A mark, with the key of its entity, and why its condition was not read.
type Mark = (String, Draft, Option<ConvertError>);

/// Refuses a condition that waits, perhaps by way of other marks, for one whose condition was not
/// read.
fn check_marks(
    when: &ConditionSection,
    marks: &[Mark],
    context: &Context<'_>,
) -> Result<(), ConvertError> {
    let mut open = Vec::new();
    collect_names(when, &mut open);
    let mut seen: Vec<String> = Vec::new();
    while let Some(name) = open.pop() {
        let is_named = |(key, mark, _): &&Mark| {
            let actor = context.entities.get(key).map(|entity| &entity.name);
            actor.is_some_and(|actor| name == format!("{actor}/{}", mark.name))
        };
        let Some((_, mark, error)) = marks.iter().find(is_named) else { continue };
        if let Some(error) = error {
            return Err(error.clone());
        }
        // Marks may wait for each other in a circle.
        if !seen.contains(&name) {
            collect_names(&mark.when, &mut open);
            seen.push(name);
        }
    }
    Ok(())
}

/// The triggers that a condition waits for.
fn collect_names(when: &ConditionSection, names: &mut Vec<String>) {
    names.extend(when.after.clone());
    when.all.iter().chain(&when.any).for_each(|part| collect_names(part, names));
}

fn resolve_condition(when: &mut ConditionSection, elements: &Elements) -> Result<(), ConvertError> {
    for part in when.all.iter_mut().chain(&mut when.any) {
        resolve_condition(part, elements)?;
    }
    let Some(pending) = when.after.as_deref().and_then(|after| after.strip_prefix(PENDING)) else {
        return Ok(());
    };
    // The type, the name and the line, as `conditions` wrote them.
    let mut words = pending.split(PENDING);
    let [kind, name, line] = [(); 3].map(|()| words.next().unwrap_or_default().to_owned());
    let place = format!("line {line}, <StoryboardElementStateCondition>");
    let phase = when.phase.unwrap_or(PhaseSection::Fired);
    let parts = elements
        .afters(&kind, &name, phase, when.delay_s.unwrap_or(0.0))
        .map_err(|message| ConvertError::new(place, message))?;
    let after = join_all(parts);
    // What else the condition says must hold in addition.
    *when = ConditionSection { after: None, phase: None, delay_s: None, ..when.clone() };
    *when = if *when == ConditionSection::default() {
        after
    } else {
        join_all(vec![after, when.clone()])
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
        let unmarked = || {
            Err(format!("waits for {kind} {name:?}, but there is no entity but the ego to mark it"))
        };
        let key = (kind.to_owned(), name.to_owned());
        // Of a path only the last name counts, so that two elements of one name cannot be told
        // apart.
        if self.counts.get(&key).is_some_and(|count| *count > 1) {
            return Err(format!("{kind} {name:?} is there several times; rename them"));
        }
        if kind == "act" && is_fired {
            return match self.acts.get(name) {
                None => Err(format!("there is no act {name:?}")),
                Some(None) => Ok(vec![at_start()]),
                Some(Some(gate)) if gate.is_empty() => unmarked(),
                Some(Some(gate)) => Ok(vec![after(gate, phase, delay_s)]),
            };
        }
        if kind == "story" && is_fired && self.counts.contains_key(&key) {
            return Ok(vec![at_start()]);
        }
        if kind == "unread" {
            return Err("waits for an event of the ego whose condition is not read".to_owned());
        }
        let Some(events) = self.by_name.get(&key) else {
            return Err(format!("there is no {kind} {name:?}"));
        };
        // All other types contain several events.
        let is_one = matches!(kind, "event" | "action");
        if is_one && events.windows(2).any(|pair| pair[0] != pair[1]) {
            return Err(format!("{kind} {name:?} is there several times; rename them"));
        }
        if is_fired && !is_one {
            return Err(format!("waits for the start of a {kind}; name its act or an event"));
        }
        // What contains events is over when each of them is, also if another one has replaced it.
        let phase = match phase {
            PhaseSection::Done if !is_one => PhaseSection::Ended,
            phase => phase,
        };
        let mut parts = Vec::new();
        for event in events.iter().map(|index| &self.events[*index]) {
            let triggers =
                event.triggers.iter().filter(|(_, action)| kind != "action" || action == name);
            parts.extend(triggers.map(|(trigger, _)| after(trigger, phase, delay_s)));
            // The mark of an event stands for the actions of the ego. An action with a trigger does
            // not need it.
            let has_own = kind == "action" && !parts.is_empty();
            let Some((mark, duration_s)) = event.mark.as_ref().filter(|_| !has_own) else {
                continue;
            };
            // A start has no duration. An end is as long after the start as the longest action that
            // was left out.
            let duration_s = if is_fired { Some(0.0) } else { *duration_s };
            let Some(duration_s) = duration_s else {
                let message = format!(
                    "waits for the end of {kind} {name:?}, whose actions of the ego are left out: the agent drives it"
                );
                return Err(message);
            };
            if mark.is_empty() {
                return unmarked();
            }
            parts.push(after(mark, PhaseSection::Fired, delay_s + duration_s));
        }
        parts.dedup();
        if parts.is_empty() { Err(format!("{kind} {name:?} has no actions")) } else { Ok(parts) }
    }
}
