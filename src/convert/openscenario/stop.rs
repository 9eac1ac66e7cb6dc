//! The stop trigger.

use super::conditions::group_of;
use super::element::Element;
use super::ledger::Part;
use super::model::Context;
use crate::ConvertError;

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
