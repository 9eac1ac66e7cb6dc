//! Controllers of entities.

use super::element::Element;
use super::ledger::Part;
use super::model::Context;
use crate::ConvertError;

/// Reads an action that assigns, activates or overrides a controller. It has no effect here on the
/// ego, whose controller is the agent, nor on an entity that has no controller; any other is left
/// out on request.
pub(super) fn read_action(
    action: &Element<'_>,
    name: &str,
    context: &Context<'_>,
) -> Result<(), ConvertError> {
    let kinds: Vec<&str> = match action.name() {
        "ControllerAction" => action.children().map(|child| child.name()).collect(),
        other => vec![other],
    };
    let activates = kinds.iter().all(|kind| *kind == "ActivateControllerAction");
    let overrides = kinds.contains(&"OverrideControllerValueAction");
    if name == context.ego && !overrides {
        action.mark_left_out();
        action.note("has no effect: the agent is the ego's controller");
        return Ok(());
    }
    if name != context.ego && activates && !context.controlled.contains(name) {
        action.mark_left_out();
        action.note(&format!("has no effect: {name:?} has no controller"));
        return Ok(());
    }
    action.leave_out(if name == context.ego { Part::Ego } else { Part::Controllers })
}

/// The entities to which actions assign controllers.
pub(super) fn assigned(node: roxmltree::Node<'_, '_>) -> Vec<String> {
    let is_assigned = |node: &roxmltree::Node<'_, '_>| node.has_tag_name("AssignControllerAction");
    let mut names = Vec::new();
    for action in node.descendants().filter(is_assigned) {
        // In `Init` the entity is that of the <Private> around it; in a story, all actors of the
        // group.
        let around = action.ancestors().find_map(|node| match node.tag_name().name() {
            "Private" => Some(vec![node]),
            "ManeuverGroup" => {
                Some(node.descendants().filter(|node| node.has_tag_name("EntityRef")).collect())
            }
            _ => None,
        });
        let entities = around.into_iter().flatten();
        names.extend(entities.filter_map(|node| Some(node.attribute("entityRef")?.to_owned())));
    }
    names
}
