//! Positions: in the world, on roads, and relative to an entity.

use super::element::Element;
use super::model::{Context, Place};
use super::roads::RoadMap;
use super::route::place_on_route;
use crate::ConvertError;

/// The place of a `<Position>`.
pub(super) fn place_from(
    position: &Element<'_>,
    context: &Context<'_>,
) -> Result<Place, ConvertError> {
    let kind = position.only_child()?;
    let place = match kind.name() {
        "WorldPosition" => {
            kind.only(&[])?;
            note_tilt(&kind)?;
            let [dx_m, dy_m] = context.shift_m;
            let x_m = kind.number("x")? + dx_m;
            let y_m = kind.number("y")? + dy_m;
            let z_m = kind.find_number("z")?;
            let xyz_m = [x_m, y_m, z_m.unwrap_or(0.0)];
            let mut place = on_roads(xyz_m, kind.number_or_0("h")?, context);
            // Without a height, it is on the road.
            let roads = context.roads.as_ref().filter(|_| z_m.is_none());
            if let Some((roads, at)) =
                roads.and_then(|roads| Some((roads, roads.lane_near(place.xyz_m)?)))
            {
                place.xyz_m[2] = roads.point(at)[2];
            }
            place
        }
        "RelativeWorldPosition" | "RelativeObjectPosition" => relative_place(&kind, context)?,
        "LanePosition" => lane_place(&kind, context)?,
        "RoadPosition" => {
            let roads = roads(&kind, context)?;
            let [s, t] = ["s", "t"].map(|name| kind.number(name));
            let found = roads.road_place(&kind.text("roadId")?, s?, t?);
            // Without an orientation, the heading is that of the road.
            let (xyz_m, yaw_rad, _) = found.map_err(|message| kind.wrong(&message))?;
            on_roads(xyz_m, heading_rad(&kind, yaw_rad, context)?, context)
        }
        "RoutePosition" => {
            let roads = roads(&kind, context)?;
            let at = place_on_route(&kind, context, roads, place_from)?;
            lane_facing(&kind, at, roads, context)?
        }
        "RelativeLanePosition" => relative_lane_place(&kind, context)?,
        "RelativeRoadPosition" => {
            let (name, base) = base_place(&kind, context)?;
            let roads = roads(&kind, context)?;
            let wrong = |message: String| kind.wrong(&message);
            let Some(spot) = base.spot else {
                return Err(kind.wrong(&format!("{name:?} is on no road")));
            };
            let [ds, dt] = ["ds", "dt"].map(|name| kind.number(name));
            let mut at = roads.moved(spot.at, ds?, false).map_err(wrong)?;
            // Both are to the left of the road.
            at.offset += dt?;
            let road_rad = roads.heading_rad(at);
            on_roads(roads.point(at), heading_rad(&kind, road_rad, context)?, context)
        }
        _ => return Err(kind.unread()),
    };
    Ok(place)
}

/// A place with its spot on the roads, if it is on one.
fn on_roads(xyz_m: [f64; 3], yaw_rad: f64, context: &Context<'_>) -> Place {
    let roads = context.roads.as_ref();
    // Beside all lanes, or across one, there is no spot.
    let spot = roads.and_then(|roads| roads.spot(roads.lane_near(xyz_m)?, yaw_rad));
    Place { xyz_m, yaw_rad, spot }
}

fn roads<'c>(kind: &Element<'_>, context: &'c Context<'_>) -> Result<&'c RoadMap, ConvertError> {
    context.roads.as_ref().ok_or_else(|| {
        kind.wrong("needs the roads: name the OpenDRIVE file in <LogicFile>, or with --roads")
    })
}

/// The entity of `entityRef`, and its place at the start.
fn base_place(kind: &Element<'_>, context: &Context<'_>) -> Result<(String, Place), ConvertError> {
    let name = kind.text("entityRef")?;
    let entity = context.entities.get(&name);
    // An event happens when the entity may be elsewhere, and where is known only then.
    if context.is_in_story && entity.is_some_and(|entity| name == context.ego || entity.moves()) {
        let message = format!(
            "is relative to where {name:?} is at that time, which is known only when the scenario runs; give a \
             <LanePosition> or a <WorldPosition>"
        );
        return Err(kind.wrong(&message));
    }
    if context.is_in_story && entity.is_some() {
        kind.note(&format!("is relative to where {name:?} is at the start"));
    }
    let place = entity.and_then(|entity| entity.place).ok_or_else(|| {
        kind.wrong(&format!("{name:?} has no position before this one; place it first"))
    })?;
    Ok((name, place))
}

fn relative_place(kind: &Element<'_>, context: &Context<'_>) -> Result<Place, ConvertError> {
    let (_, base) = base_place(kind, context)?;
    let dx = kind.number_or_0("dx")?;
    let dy = kind.number_or_0("dy")?;
    let dz = kind.number_or_0("dz")?;
    let mut xyz_m = match kind.name() {
        "RelativeObjectPosition" => base.shifted(dx, dy).xyz_m,
        // Along the world's axes, whatever the heading of the entity.
        _ => [base.xyz_m[0] + dx, base.xyz_m[1] + dy, base.xyz_m[2]],
    };
    xyz_m[2] += dz;
    Ok(on_roads(xyz_m, heading_rad(kind, base.yaw_rad, context)?, context))
}

fn lane_place(kind: &Element<'_>, context: &Context<'_>) -> Result<Place, ConvertError> {
    let roads = roads(kind, context)?;
    let s = kind.number("s")?;
    let offset = kind.number_or_0("offset")?;
    let lane = kind.whole("laneId")?;
    let at = roads
        .place(&kind.text("roadId")?, lane, s, offset)
        .map_err(|message| kind.wrong(&message))?;
    lane_facing(kind, at, roads, context)
}

/// A place on a lane with the heading of an `<Orientation>`; without one it faces as its traffic
/// does.
fn lane_facing(
    kind: &Element<'_>,
    at: xodr::LanePosition,
    roads: &RoadMap,
    context: &Context<'_>,
) -> Result<Place, ConvertError> {
    // Where traffic drives against s, it turns its back on the direction of the road.
    let half_turn = if roads.drives_up(at.lane) { 0.0 } else { std::f64::consts::PI };
    let traffic_rad = roads.heading_rad(at) + half_turn;
    let yaw_rad = heading_rad(kind, traffic_rad, context)?;
    Ok(Place { xyz_m: roads.point(at), yaw_rad, spot: roads.spot(at, yaw_rad) })
}

fn relative_lane_place(kind: &Element<'_>, context: &Context<'_>) -> Result<Place, ConvertError> {
    let (name, base) = base_place(kind, context)?;
    let roads = roads(kind, context)?;
    let Some(spot) = base.spot else {
        return Err(kind.wrong(&format!("{name:?} is on no lane")));
    };
    let wrong = |message: String| kind.wrong(&message);
    let count = kind.whole("dLane")?;
    let offset_m = kind.number_or_0("offset")?;
    let (way_m, is_along_lane) = match (kind.find_number("ds")?, kind.find_number("dsLane")?) {
        (Some(ds), None) => (ds, false),
        (None, Some(ds)) => (ds, true),
        _ => return Err(kind.wrong("write exactly one of ds and dsLane")),
    };
    // Along a lane, left is that of its traffic; along a road, that of the road.
    let sign = if is_along_lane && !roads.drives_up(spot.at.lane) { -1 } else { 1 };
    // From the middle of the lane: the offset of the other entity is not taken over.
    let from = xodr::LanePosition { offset: 0.0, ..spot.at };
    let moved = roads.moved(from, way_m, is_along_lane).map_err(wrong)?;
    let mut at = roads.beside(moved, sign * count).map_err(wrong)?;
    at.offset = f64::from(sign) * offset_m;
    lane_facing(kind, at, roads, context)
}

/// The heading of an `<Orientation>`: absolute, or relative to a heading, which is returned without
/// an `<Orientation>`.
fn heading_rad(
    kind: &Element<'_>,
    base_rad: f64,
    context: &Context<'_>,
) -> Result<f64, ConvertError> {
    kind.only(&["Orientation", "RouteRef", "InRoutePosition"])?;
    let Some(orientation) = kind.find("Orientation")? else { return Ok(base_rad) };
    note_tilt(&orientation)?;
    let heading_rad = orientation.find_number("h")?;
    // Without a type, a heading is absolute up to version 1.2, and relative from 1.3 on.
    let is_old = context.minor_version <= 2;
    match orientation.find_text("type")?.as_deref() {
        None if is_old => Ok(heading_rad.unwrap_or(base_rad)),
        None | Some("relative") => Ok(base_rad + heading_rad.unwrap_or(0.0)),
        Some("absolute") => Ok(heading_rad.unwrap_or(0.0)),
        Some(other) => Err(orientation.wrong(&format!("type={other:?}; relative or absolute"))),
    }
}

/// Tells that pitch and roll are those of the ground.
fn note_tilt(element: &Element<'_>) -> Result<(), ConvertError> {
    if element.number_or_0("p")? != 0.0 || element.number_or_0("r")? != 0.0 {
        element.note("pitch and roll are those of the ground");
    }
    Ok(())
}
