//! Actions of actors: speeds, lanes, offsets and trajectories.

use wildcity_sim::limits;
use wildcity_sim::scenario::{ProfileSection, ShapeSection};

use super::element::Element;
use super::ledger::Part;
use super::model::{Act, Context, Line};
use super::roads::shifted_id;
use super::{catalogs, controllers, distances, trajectory};
use crate::ConvertError;

/// A shape and an extent, without an aim.
const NOWHERE: ProfileSection = ProfileSection {
    to: 0.0,
    shape: ShapeSection::Step,
    over_s: None,
    over_m: None,
    rate: None,
    acceleration: None,
};

/// The private action of an entity; `None` if it is left out or has no effect.
pub(super) fn private_act(
    kind: &Element<'_>,
    name: &str,
    context: &Context<'_>,
) -> Result<Option<Act>, ConvertError> {
    match kind.name() {
        "LongitudinalAction" => {
            let action = kind.only_child()?;
            if action.name() == "LongitudinalDistanceAction" {
                let keep = distances::distance(&action, name, context);
                return distances::or_left_out(&action, keep.map(|keep| Act::Keep(Box::new(keep))));
            }
            if let Some(act) = speed_match(&action, name, context)? {
                return Ok(Some(act));
            }
            let profile = speed_change(&action, context)?;
            // A rate of 0 keeps the speed.
            Ok((profile.rate != Some(0.0)).then_some(Act::Speed(profile)))
        }
        "LateralAction" => {
            let action = kind.only_child()?;
            match action.name() {
                "LaneChangeAction" => lane_change(&action, name, context).map(Some),
                "LateralDistanceAction" => action.leave_out(Part::Distances).map(|()| None),
                "LaneOffsetAction" => Ok(Some(Act::Offset(offset_change(&action)?))),
                _ => Err(action.unread()),
            }
        }
        "RoutingAction" => {
            let action = kind.only_child()?;
            match action.name() {
                "FollowTrajectoryAction" => {
                    Ok(Some(Act::Trajectory(trajectory_line(&action, context)?)))
                }
                "AssignRouteAction" | "AcquirePositionAction" | "RandomRouteAction" => {
                    action.leave_out(Part::Routes).map(|()| None)
                }
                _ => Err(action.unread()),
            }
        }
        "SynchronizeAction" => {
            let arrive = distances::arrival(kind, name, context);
            distances::or_left_out(kind, arrive.map(|arrive| Act::Arrive(Box::new(arrive))))
        }
        "TrailerAction" => kind.leave_out(Part::Trailers).map(|()| None),
        "ControllerAction" | "ActivateControllerAction" => {
            controllers::read_action(kind, name, context).map(|()| None)
        }
        "AppearanceAction" | "VisibilityAction" => kind.leave_out(Part::Appearance).map(|()| None),
        _ => Err(kind.unread()),
    }
}

/// A speed that follows that of another entity; `None` for another action.
pub(super) fn speed_match(
    speed: &Element<'_>,
    own: &str,
    context: &Context<'_>,
) -> Result<Option<Act>, ConvertError> {
    let Some(target) = speed.find("SpeedActionTarget")? else { return Ok(None) };
    let target = target.only_child()?;
    // Otherwise the speed of one moment is the aim, which `speed_change` reads.
    if target.name() != "RelativeTargetSpeed" || !target.find_flag("continuous")?.unwrap_or(false) {
        return Ok(None);
    }
    speed.only(&["SpeedActionDynamics", "SpeedActionTarget"])?;
    let dynamics = speed.need("SpeedActionDynamics")?;
    if dynamics_from(&dynamics)?.shape != ShapeSection::Step {
        let message = "is read as a step only, because the other's speed may change meanwhile";
        return Err(dynamics.wrong(message));
    }
    let name = target.text("entityRef")?;
    if !context.entities.contains_key(&name) || name == own {
        return Err(target.wrong(&format!("there is no other entity {name:?}")));
    }
    let value = target.number("value")?;
    // The speed is factor * v + delta, with the speed v of the other.
    let (factor, delta_mps) = match target.text("speedTargetValueType")?.as_str() {
        "delta" => (1.0, value),
        "factor" => (value, 0.0),
        _ => return Err(target.wrong("speedTargetValueType is delta or factor")),
    };
    Ok(Some(Act::Match { of: context.actor_name(&name), factor, delta_mps }))
}

/// The aim and the dynamics of a `<SpeedAction>`.
pub(super) fn speed_change(
    speed: &Element<'_>,
    context: &Context<'_>,
) -> Result<ProfileSection, ConvertError> {
    if speed.name() != "SpeedAction" {
        return Err(speed.unread());
    }
    speed.only(&["SpeedActionDynamics", "SpeedActionTarget"])?;
    let target = speed.need("SpeedActionTarget")?.only_child()?;
    let to = match target.name() {
        "AbsoluteTargetSpeed" => target.number("value")?,
        "RelativeTargetSpeed" => relative_speed_mps(&target, context)?,
        _ => return Err(target.unread()),
    };
    if to < 0.0 {
        return Err(target.wrong("is below 0; actors do not drive backwards"));
    }
    if to > limits::ACTOR_SPEED_M_S {
        let most = limits::ACTOR_SPEED_M_S;
        return Err(target.wrong(&format!("is {to:?} m/s; at most {most} m/s are accepted")));
    }
    let dynamics = speed.need("SpeedActionDynamics")?;
    let profile = dynamics_from(&dynamics)?;
    // Over a distance s, only a constant acceleration has a simple course: v² = v0² + 2 a s.
    match (profile.over_m, profile.shape) {
        (None, _) => {}
        (Some(_), ShapeSection::Linear) => {
            dynamics.note("is a constant acceleration over the distance");
        }
        (Some(_), _) => {
            return Err(dynamics.wrong("is read over a distance only as linear; give a time"));
        }
    }
    Ok(ProfileSection { to, ..profile })
}

/// A speed relative to that with which an entity begins.
fn relative_speed_mps(target: &Element<'_>, context: &Context<'_>) -> Result<f64, ConvertError> {
    let name = target.text("entityRef")?;
    if target.find_flag("continuous")?.unwrap_or(false) {
        return Err(target.wrong("continuous=\"true\" is not read; give a speed"));
    }
    let value = target.number("value")?;
    let kind = target.text("speedTargetValueType")?;
    let Some(entity) = context.entities.get(&name) else {
        return Err(target.wrong(&format!("there is no entity {name:?}")));
    };
    // In the story, the speed of the other is known only when the scenario runs.
    if context.is_in_story {
        return Err(target.wrong("is read in <Init> only; give a speed"));
    }
    // `Init` reads this action again once the speed of the other is known.
    if context.waiting.contains(&name) || !entity.script.is_empty() {
        return Err(target.wrong(&format!("{name:?} has no speed yet; give it one without a ramp")));
    }
    match kind.as_str() {
        "delta" => Ok((entity.begin_mps + value).max(0.0)),
        "factor" => Ok(entity.begin_mps * value),
        _ => Err(target.wrong("speedTargetValueType is delta or factor")),
    }
}

/// The shape and the extent of a change.
fn dynamics_from(dynamics: &Element<'_>) -> Result<ProfileSection, ConvertError> {
    let shape = shape_from(dynamics)?;
    let dimension = dynamics.text("dynamicsDimension")?;
    let value = dynamics.number("value")?;
    // A rate has no sign: the aim decides whether the value rises or falls.
    let extent = value.abs();
    if dimension != "rate" && value < 0.0 {
        return Err(dynamics.wrong(&format!("value={value:?}; write 0 or more")));
    }
    // A change within 10 ms, a step of the simulation, or within 1 cm is immediate.
    if shape == ShapeSection::Step || (dimension != "rate" && extent < 0.01) {
        return Ok(NOWHERE);
    }
    let profile = ProfileSection { shape, ..NOWHERE };
    match dimension.as_str() {
        "time" => Ok(ProfileSection { over_s: Some(extent), ..profile }),
        "distance" => Ok(ProfileSection { over_m: Some(extent), ..profile }),
        "rate" if extent == 0.0 || extent >= 1e-3 => {
            Ok(ProfileSection { rate: Some(extent), ..profile })
        }
        "rate" => Err(dynamics.wrong("is slower than 0.001 per second; give a larger rate")),
        other => {
            let message = format!("dynamicsDimension={other:?}; rate, time or distance is read");
            Err(dynamics.wrong(&message))
        }
    }
}

/// The change of speed of a `<SpeedProfileEntry>`, and how long it takes, in seconds.
pub(super) fn profile_entry(entry: &Element<'_>) -> Result<(Act, f64), ConvertError> {
    entry.only(&[])?;
    let to = entry.number("speed")?;
    if !(0.0..=limits::ACTOR_SPEED_M_S).contains(&to) {
        let most = limits::ACTOR_SPEED_M_S;
        return Err(entry.wrong(&format!("speed={to:?}; 0 to {most} m/s are accepted")));
    }
    let over_s = entry.number("time")?;
    let profile = match over_s {
        over_s if over_s < 0.0 => return Err(entry.wrong("time is below 0")),
        over_s if over_s < 0.01 => NOWHERE,
        over_s => ProfileSection { shape: ShapeSection::Linear, over_s: Some(over_s), ..NOWHERE },
    };
    Ok((Act::Speed(ProfileSection { to, ..profile }), over_s))
}

fn shape_from(dynamics: &Element<'_>) -> Result<ShapeSection, ConvertError> {
    match dynamics.text("dynamicsShape")?.as_str() {
        "step" => Ok(ShapeSection::Step),
        "linear" => Ok(ShapeSection::Linear),
        "sinusoidal" => Ok(ShapeSection::Sinusoidal),
        "cubic" => Ok(ShapeSection::Cubic),
        other => {
            let message = format!(
                "dynamicsShape={other:?} is not read; step, linear, sinusoidal or cubic is"
            );
            Err(dynamics.wrong(&message))
        }
    }
}

fn lane_change(
    action: &Element<'_>,
    name: &str,
    context: &Context<'_>,
) -> Result<Act, ConvertError> {
    action.only(&["LaneChangeActionDynamics", "LaneChangeTarget"])?;
    let offset_m = action.number_or_0("targetLaneOffset")?;
    let target = action.need("LaneChangeTarget")?.only_child()?;
    let lane = match target.name() {
        "AbsoluteTargetLane" => target.whole("value")?,
        "RelativeTargetLane" => {
            let of = target.text("entityRef")?;
            let count = target.whole("value")?;
            let entity = context
                .entities
                .get(&of)
                .ok_or_else(|| target.wrong(&format!("there is no entity {of:?}")))?;
            // The lane is that after the changes that were read so far. The direction is that of
            // the start.
            let spot = entity.place.and_then(|place| place.spot);
            let Some((lane, spot)) = entity.lane.zip(spot) else {
                return Err(target.wrong(&format!("{of:?} is on no lane")));
            };
            if of == context.ego && context.is_in_story {
                target.note(&format!(
                    "counts from the lane on which {of:?} starts: lane {lane}; the agent may have left it"
                ));
            } else if of != name && context.is_in_story {
                target.note(&format!("counts from lane {lane}, on which {of:?} is then"));
            }
            // A relative lane counts to the left of the vehicle, while ids count to the left of the
            // road.
            shifted_id(lane, if spot.is_up { count } else { -count })
        }
        _ => return Err(target.unread()),
    };
    let dynamics = action.need("LaneChangeActionDynamics")?;
    let profile = dynamics_from(&dynamics)?;
    if profile.rate == Some(0.0) {
        return Err(dynamics.wrong("a rate of 0 never arrives; give a larger one"));
    }
    Ok(Act::Lane { lane, offset_m, profile })
}

fn offset_change(action: &Element<'_>) -> Result<ProfileSection, ConvertError> {
    action.only(&["LaneOffsetActionDynamics", "LaneOffsetTarget"])?;
    if action.find_flag("continuous")?.unwrap_or(false) {
        // An offset from the own lane stays as it is.
        action.need("LaneOffsetTarget")?.only(&["AbsoluteTargetLaneOffset"])?;
    }
    let target = action.need("LaneOffsetTarget")?.only_child()?;
    if target.name() != "AbsoluteTargetLaneOffset" {
        return Err(target.unread());
    }
    let to = target.number("value")?;
    let dynamics = action.need("LaneOffsetActionDynamics")?;
    let shape = shape_from(&dynamics)?;
    let acceleration = dynamics.find_number("maxLateralAcc")?;
    if shape == ShapeSection::Step {
        return Ok(ProfileSection { to, ..NOWHERE });
    }
    let acceleration = acceleration.ok_or_else(|| dynamics.wrong("maxLateralAcc is missing"))?;
    Ok(ProfileSection { to, shape, acceleration: Some(acceleration), ..NOWHERE })
}

/// The line of a `<FollowTrajectoryAction>`.
pub(super) fn trajectory_line(
    follow: &Element<'_>,
    context: &Context<'_>,
) -> Result<Line, ConvertError> {
    follow.only(&[
        "Trajectory",
        "CatalogReference",
        "TrajectoryRef",
        "TimeReference",
        "TrajectoryFollowingMode",
    ])?;
    if follow.number_or_0("initialDistanceOffset")? != 0.0 {
        return Err(follow.wrong("initialDistanceOffset is not read; begin the trajectory there"));
    }
    if let Some(mode) = follow.find("TrajectoryFollowingMode")? {
        mode.expect("followingMode", &["position", "follow"])?;
    }
    // In 1.0 the action itself has the trajectory, later a <TrajectoryRef> in it.
    let holder = follow.find("TrajectoryRef")?.unwrap_or_else(|| follow.clone());
    let trajectory = match holder.find("CatalogReference")? {
        Some(reference) => context.catalogs.entry(&reference)?,
        None => catalogs::declared(&holder.need("Trajectory")?)?,
    };
    let mut line = trajectory::line_from(&trajectory, context)?;
    // An entry of a catalog is in another file, which the check of the scenario does not visit.
    if holder.find("CatalogReference")?.is_some() {
        trajectory.check_read()?;
    }
    let reference = follow.find("TimeReference")?.map(|reference| reference.only_child());
    let Some(reference) = reference.transpose()? else {
        // Without a time reference, the times of the points do not count.
        line.times_s = None;
        return Ok(line);
    };
    match reference.name() {
        "None" => line.times_s = None,
        "Timing" => {
            reference.expect("domainAbsoluteRelative", &["absolute", "relative"])?;
            reference.expect("scale", &["1", "1.0"])?;
            let offset_s = reference.number_or_0("offset")?;
            let Some(times_s) = &mut line.times_s else {
                return Err(reference.wrong("a <Vertex> has no time; give all of them one"));
            };
            times_s.iter_mut().for_each(|time_s| *time_s += offset_s);
        }
        _ => return Err(reference.unread()),
    }
    Ok(line)
}
