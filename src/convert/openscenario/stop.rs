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
        let kinds: Result<Vec<&str>, ConvertError> =
            group.children().map(|condition| kind_of(&condition)).collect();
        let kinds = kinds?;
        if kinds.is_empty() {
            return Err(group.wrong("is empty"));
        }
        let is_timed = kinds.iter().all(|kind| *kind == "SimulationTimeCondition");
        let is_known =
            |kind: &&str| matches!(*kind, "SimulationTimeCondition" | "ParameterCondition");
        let condition = match kinds.iter().all(is_known) {
            true => group_of(&group, context, true),
            false => Err(group.unread()),
        };
        // The mistake itself says more than that the group may be left out.
        if is_timed && !group.leaves_out(Part::Stop) {
            condition.clone()?;
        }
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

/// The kind of a condition.
fn kind_of<'a>(condition: &Element<'a>) -> Result<&'a str, ConvertError> {
    let by = condition.only_child()?;
    match by.name() {
        "ByValueCondition" => Ok(by.only_child()?.name()),
        other => Ok(other),
    }
}
