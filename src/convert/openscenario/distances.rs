//! Actions that depend on another entity's motion: distances that are kept, and arrivals with
//! another.

use glam::DVec2;
use wildcity_sim::limits;
use wildcity_sim::scenario::{ArriveTogetherSection, KeepDistanceSection, SideSection};

use super::element::Element;
use super::ledger::Part;
use super::model::{Act, Context, Entity, Place};
use super::position::place_from;
use super::roads::{RoadMap, Spot};
use crate::ConvertError;

/// Within this a place of `Init` has its distance, in metres.
const NEAR_M: f64 = 1e-4;

/// What an action does; `None` if it is not read, and is left out on request.
pub(super) fn or_left_out(
    action: &Element<'_>,
    act: Result<Act, ConvertError>,
) -> Result<Option<Act>, ConvertError> {
    match act {
        Ok(act) => Ok(Some(act)),
        Err(_) if action.leaves_out(Part::Distances) => {
            action.leave_out(Part::Distances).map(|()| None)
        }
        Err(ConvertError { place, message }) => {
            let part = Part::Distances.name();
            Err(ConvertError::new(place, format!("{message}; or use --leave-out {part}")))
        }
    }
}

/// The distance of a `<LongitudinalDistanceAction>`.
pub(super) fn distance(
    action: &Element<'_>,
    own: &str,
    context: &Context<'_>,
) -> Result<KeepDistanceSection, ConvertError> {
    action.only(&["DynamicConstraints"])?;
    let of = other(action, "entityRef", own, context)?;
    let gap_m = action.find_number("distance")?;
    let headway_s = action.find_number("timeGap")?;
    if gap_m.is_some() == headway_s.is_some() {
        return Err(action.wrong("write exactly one of distance and timeGap"));
    }
    if gap_m.or(headway_s).is_some_and(|value| value < 0.0) {
        return Err(action.wrong("is below 0; write displacement for the side"));
    }
    let on_course = match action.find_text("coordinateSystem")?.as_deref() {
        None | Some("entity") => false,
        Some("road" | "lane") => true,
        Some(other) => {
            return Err(action.wrong(&format!("coordinateSystem={other:?} is not read")));
        }
    };
    let side = match action.find_text("displacement")?.as_deref() {
        Some("any") => None,
        // 1.0 has no such attribute.
        None if context.minor_version == 0 => None,
        None | Some("trailingReferencedEntity") => Some(SideSection::Behind),
        Some("leadingReferencedEntity") => Some(SideSection::Ahead),
        Some(other) => return Err(action.wrong(&format!("displacement={other:?} is not read"))),
    };
    let free = action
        .find_flag("freespace")?
        .ok_or_else(|| action.wrong("the attribute freespace is missing"))?;
    let continuous = action
        .find_flag("continuous")?
        .ok_or_else(|| action.wrong("the attribute continuous is missing"))?;
    let mut section = KeepDistanceSection {
        of: context.actor_name(&of),
        gap_m,
        headway_s,
        side,
        free: free.then_some(true),
        on_course: on_course.then_some(true),
        ahead_m: context.ahead_m(own),
        to_ahead_m: context.ahead_m(&of),
        once: (!continuous).then_some(true),
        ..KeepDistanceSection::default()
    };
    if let Some(constraints) = action.find("DynamicConstraints")? {
        constraints.only(&[])?;
        for name in ["maxAccelerationRate", "maxDecelerationRate"] {
            if constraints.find_number(name)?.is_some() {
                let message = format!("{name} is not read: an acceleration begins at once");
                return Err(constraints.wrong(&message));
            }
        }
        let most = limits::ACTOR_ACCELERATION_M_S2;
        let bound = |name: &str| match constraints.find_number(name)? {
            Some(value) if value > 0.0 => Ok(value.min(most)),
            Some(value) => Err(constraints.wrong(&format!("{name}={value:?}; write more than 0"))),
            None => Ok(most),
        };
        section.acceleration = Some(bound("maxAcceleration")?);
        section.braking = Some(bound("maxDeceleration")?);
        let fastest = constraints.find_number("maxSpeed")?;
        section.fastest = fastest.map(|mps| mps.clamp(0.0, limits::ACTOR_SPEED_M_S));
    }
    Ok(section)
}

/// The place of an entity at its distance, before it moves; `None` if the distance is not along its
/// heading, or is kept within bounds.
pub(super) fn place_at_distance(
    section: &KeepDistanceSection,
    entity: &Entity,
    other: &Entity,
    roads: Option<&RoadMap>,
) -> Option<Place> {
    let to = other.place?;
    let mut place = entity.place?;
    if section.on_course == Some(true) || section.acceleration.is_some() {
        return None;
    }
    // The follower's speed: an entity at a distance without bounds is as fast as the other.
    let gap_m = section.gap_m.unwrap_or(section.headway_s? * other.begin_mps);
    // On a bent road, a way along the road changes the distance by less than its length. Each round
    // moves by what is still missing.
    for _ in 0..100 {
        let missing_m = missing_m(section, gap_m, (entity, &place), (other, &to));
        if missing_m.abs() < NEAR_M {
            return Some(place);
        }
        place = moved(&place, missing_m, roads)?;
    }
    None
}

/// So far forward an entity is at its distance, in metres.
fn missing_m(
    section: &KeepDistanceSection,
    gap_m: f64,
    (entity, place): (&Entity, &Place),
    (other, to): (&Entity, &Place),
) -> f64 {
    let forward = |yaw_rad: f64| DVec2::new(yaw_rad.cos(), yaw_rad.sin());
    let ahead = forward(place.yaw_rad);
    let is_free = section.free == Some(true);
    let reference = |entity: &Entity, place: &Place| {
        let [ahead_m, left_m, _] = if is_free { entity.center_m } else { [0.0; 3] };
        let [x, y, _] = place.shifted(ahead_m, left_m).xyz_m;
        DVec2::new(x, y)
    };
    // Half of the extent of a box in the direction `ahead`: (l |cos a| + w |sin a|) / 2, with the
    // angle a between the two.
    let half_m = |entity: &Entity, place: &Place| {
        let [length_m, width_m, _] = entity.size;
        let along = forward(place.yaw_rad);
        0.5 * (length_m * along.dot(ahead).abs() + width_m * along.perp_dot(ahead).abs())
    };
    // Positive if the other is ahead.
    let way_m = (reference(other, to) - reference(entity, place)).dot(ahead);
    let halves_m = if is_free { half_m(entity, place) + half_m(other, to) } else { 0.0 };
    // Without a side, the one on which it is now.
    let is_behind = match section.side {
        Some(side) => side == SideSection::Behind,
        None => way_m >= 0.0,
    };
    let wanted_m = gap_m + halves_m;
    way_m - if is_behind { wanted_m } else { -wanted_m }
}

/// A place so far forward along its lane, or straight on.
fn moved(place: &Place, way_m: f64, roads: Option<&RoadMap>) -> Option<Place> {
    let Some((roads, spot)) = roads.zip(place.spot) else { return Some(place.shifted(way_m, 0.0)) };
    // The angle to the road stays the same.
    let before_rad = roads.heading_rad(spot.at);
    let way_m = if spot.is_up { way_m } else { -way_m };
    let at = roads.moved(spot.at, way_m, false).ok()?;
    let yaw_rad = place.yaw_rad + roads.heading_rad(at) - before_rad;
    let spot = Spot { at, is_up: spot.is_up };
    Some(Place { xyz_m: roads.point(at), yaw_rad, spot: Some(spot) })
}

/// The arrival of a `<SynchronizeAction>`.
pub(super) fn arrival(
    action: &Element<'_>,
    own: &str,
    context: &Context<'_>,
) -> Result<ArriveTogetherSection, ConvertError> {
    action.only(&["TargetPositionMaster", "TargetPosition", "FinalSpeed"])?;
    let of = other(action, "masterEntityRef", own, context)?;
    let place = |name: &str| Ok(place_from(&action.need(name)?, context)?.xyz_m);
    let at = place("TargetPosition");
    let of_at = place("TargetPositionMaster");
    let tolerance = |name: &str| {
        let tolerance_m = action.find_number(name)?;
        if tolerance_m.is_some_and(|tolerance_m| tolerance_m < 0.0) {
            return Err(action.wrong(&format!("{name} is below 0")));
        }
        // A tolerance of 0 is none.
        Ok(tolerance_m.filter(|tolerance_m| *tolerance_m > 0.0))
    };
    let mut section = ArriveTogetherSection {
        at: at?,
        of: context.actor_name(&of),
        of_at: of_at?,
        ahead_m: context.ahead_m(own),
        to_ahead_m: context.ahead_m(&of),
        speed: None,
        factor: None,
        delta: None,
        steady_m: None,
        within_m: tolerance("targetTolerance")?,
        of_within_m: tolerance("targetToleranceMaster")?,
    };
    let Some(last) = action.find("FinalSpeed")? else { return Ok(section) };
    let speed = last.only_child()?;
    speed.only(&["TargetDistanceSteadyState", "TargetTimeSteadyState"])?;
    let value = speed.number("value")?;
    match speed.name() {
        "AbsoluteSpeed" if value < 0.0 => {
            return Err(speed.wrong("is below 0; actors do not drive backwards"));
        }
        "AbsoluteSpeed" => section.speed = Some(value),
        "RelativeSpeedToMaster" => match speed.text("speedTargetValueType")?.as_str() {
            "delta" => section.delta = Some(value),
            "factor" => section.factor = Some(value),
            _ => return Err(speed.wrong("speedTargetValueType is delta or factor")),
        },
        _ => return Err(speed.unread()),
    }
    if let Some(steady) = speed.children().next() {
        steady.only(&[])?;
        section.steady_m = match (steady.name(), section.speed) {
            ("TargetDistanceSteadyState", _) => Some(steady.number("distance")?),
            // At a constant speed v, the last t seconds are v t metres.
            ("TargetTimeSteadyState", Some(speed)) => Some(speed * steady.number("time")?),
            _ => return Err(steady.wrong("a time is read with an absolute speed only")),
        };
    }
    Ok(section)
}

/// The other entity that an attribute names.
fn other(
    action: &Element<'_>,
    attribute: &str,
    own: &str,
    context: &Context<'_>,
) -> Result<String, ConvertError> {
    let name = action.text(attribute)?;
    if !context.entities.contains_key(&name) || name == own {
        return Err(action.wrong(&format!("there is no other entity {name:?}")));
    }
    let has_line = context.entities.get(own).is_some_and(|entity| entity.line.is_some());
    if let Some(reason) = context.missing_roads.as_ref().filter(|_| !has_line) {
        return Err(action.wrong(&format!("is along roads that were not read: {reason}")));
    }
    Ok(name)
}
