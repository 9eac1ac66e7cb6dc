//! The stop trigger.

use wildcity_sim::limits;
use wildcity_sim::scenario::ConditionSection;

use super::conditions::group_condition;
use super::element::Element;
use super::ledger::Part;
use super::model::Context;
use crate::ConvertError;

/// When a scenario ends.
#[derive(Default)]
pub(super) struct Stop<'a> {
    /// After this time, in seconds.
    pub(super) time_s: Option<f64>,
    /// When one of these holds, each with its element.
    pub(super) groups: Vec<(Element<'a>, ConditionSection)>,
}

pub(super) fn read_stop<'a>(
    stop: &Element<'a>,
    context: &Context<'_>,
) -> Result<Stop<'a>, ConvertError> {
    stop.only(&["ConditionGroup"])?;
    let mut read = Stop::default();
    for group in stop.children() {
        // A group without conditions would end the scenario at once.
        if group.children().next().is_none() {
            return Err(group.wrong("is empty"));
        }
        let condition = match group_condition(&group, context, true) {
            Ok(condition) => condition,
            Err(error) => {
                leave_out(&group, error)?;
                continue;
            }
        };
        match time_s(&condition) {
            // A parameter that is another never ends it.
            Some(time_s) if time_s >= limits::END_S => {}
            Some(time_s) => {
                // Groups are alternatives, so that the earliest time counts.
                read.time_s = Some(read.time_s.map_or(time_s, |before_s| before_s.min(time_s)));
            }
            None => read.groups.push((group, condition)),
        }
    }
    Ok(read)
}

/// Leaves out a group that is not read because of an error, if that was asked for.
pub(super) fn leave_out(group: &Element<'_>, error: ConvertError) -> Result<(), ConvertError> {
    if group.leaves_out(Part::Stop) {
        return group.leave_out(Part::Stop);
    }
    let ConvertError { place, message } = error;
    Err(ConvertError::new(place, format!("{message}; or use --leave-out {}", Part::Stop.name())))
}

/// The time of a condition that is nothing else, in seconds.
fn time_s(condition: &ConditionSection) -> Option<f64> {
    let ConditionSection { time_s: own_s, all, .. } = condition;
    let plain =
        ConditionSection { time_s: *own_s, all: all.clone(), ..ConditionSection::default() };
    if *condition != plain {
        return None;
    }
    let parts: Option<Vec<f64>> = all.iter().map(time_s).collect();
    // All parts must hold, so that the latest time counts.
    Some(parts?.into_iter().fold(own_s.unwrap_or(0.0), f64::max))
}
