//! The route of the ego: that of its actions, from where it starts.

use glam::DVec2;
use xodr::LanePosition;

use super::actions::trajectory_line;
use super::element::Element;
use super::model::Context;
use super::position::place_from;
use super::roads::{RoadMap, Spot};
use super::route::{lanes_between, waypoints};
use crate::ConvertError;

/// No route is longer than this, in metres.
const LONGEST_M: f64 = 20_000.0;

/// A route ends beside its last way-point, within this distance, in metres: the width of a
/// carriageway.
const BESIDE_M: f64 = 20.0;

/// Two laps of one lane pass a point at distances that differ by less than this, in metres.
const LAP_M: f64 = 0.05;

/// The shortest route, in metres.
const SHORTEST_M: f64 = 1.0;

/// Reads a `<RoutingAction>` of the ego that says where it goes: by way-points, or along a
/// trajectory.
pub(super) fn read_ego_route(
    routing: &Element<'_>,
    context: &mut Context<'_>,
) -> Result<(), ConvertError> {
    let action = routing.only_child()?;
    let ego = context.entities.get(&context.ego);
    let start = ego.and_then(|ego| ego.place).and_then(|place| place.spot);
    if context.ego_route.is_some() {
        return Err(action.wrong("a second route of the ego is not read; keep one"));
    }
    if action.name() == "FollowTrajectoryAction" {
        let line = trajectory_line(&action, context)?;
        if line.times_s.is_some() {
            action.note("is the agent's route, without its times");
        }
        context.ego_route = Some(line.points);
        note_start(&action, context);
        return Ok(());
    }
    let start = start.ok_or_else(|| action.wrong("the ego is on no lane"))?;
    let mut places = vec![start.at];
    match action.name() {
        "AssignRouteAction" => places.extend(waypoints(&action, context, place_from)?),
        "AcquirePositionAction" => {
            action.only(&["Position"])?;
            let place = place_from(&action.need("Position")?, context)?;
            let spot = place.spot.ok_or_else(|| action.wrong("is on no lane"))?;
            places.push(spot.at);
        }
        _ => return Err(action.unread()),
    }
    let roads = context.roads.as_ref().ok_or_else(|| action.wrong("needs the roads"))?;
    let points = along_lanes(start, &places, roads);
    context.ego_route = Some(points.map_err(|message| action.wrong(&message))?);
    note_start(&action, context);
    Ok(())
}

/// Tells that the agent knows a route that an event assigns before the event.
fn note_start(action: &Element<'_>, context: &Context<'_>) {
    if context.is_in_story {
        action.note("is the agent's route from the start on");
    }
}

/// The line along the lanes from the ego's start, up to the last of its places.
fn along_lanes(
    start: Spot,
    places: &[LanePosition],
    roads: &RoadMap,
) -> Result<Vec<[f64; 3]>, String> {
    let lanes = lanes_between(places, roads)?;
    let line = roads.line(start, LONGEST_M, &lanes);
    let last = places.last().ok_or("has no way-points")?;
    let points = up_to(&line.points, roads.point(*last));
    points.ok_or_else(|| "the ego's lane does not lead to the end of its route".to_owned())
}

/// The line up to its place beside a point; `None` if it does not pass it.
fn up_to(points: &[[f64; 3]], point: [f64; 3]) -> Option<Vec<[f64; 3]>> {
    let flat = |point: [f64; 3]| DVec2::new(point[0], point[1]);
    let places = points.windows(2).enumerate().map(|(index, pair)| {
        let from = flat(pair[0]);
        let way = flat(pair[1]) - from;
        // The foot of the point on this piece, as a share of its length. `max` is for two equal
        // points, where 0 / 0 would be NaN.
        let share = (flat(point) - from).dot(way) / way.length_squared().max(1e-12);
        let t = share.clamp(0.0, 1.0);
        ((from + t * way).distance(flat(point)), index, t)
    });
    let places: Vec<(f64, usize, f64)> = places.collect();
    // It starts from `BESIDE_M`: if all places are farther away, none is found below.
    let nearest_m = places.iter().map(|(beside_m, ..)| *beside_m).fold(BESIDE_M, f64::min);
    // The first time that it passes: the road may lead around.
    let (_, index, t) = *places.iter().find(|(beside_m, ..)| *beside_m <= nearest_m + LAP_M)?;
    let mut line = points[..=index].to_vec();
    let from = points[index];
    let to = points[index + 1];
    line.push([0, 1, 2].map(|axis| from[axis] + t * (to[axis] - from[axis])));
    let length_m: f64 = line.windows(2).map(|pair| flat(pair[0]).distance(flat(pair[1]))).sum();
    (length_m >= SHORTEST_M).then_some(line)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_route_ends_beside_its_last_way_point() {
        let line = [[0.0, 0.0, 0.0], [100.0, 0.0, 2.0], [100.0, 100.0, 2.0]];
        // The point is 3 m beside the second piece, at 40 of its 100 m.
        let beside = up_to(&line, [103.0, 40.0, 0.0]).unwrap();
        assert_eq!(beside, [line[0], line[1], [100.0, 40.0, 2.0]]);
        // It is 64 m from the nearest point of the line.
        assert_eq!(up_to(&line, [-50.0, 40.0, 0.0]), None);
        // Both laps pass the point, and the first one counts.
        let lap = [[0.0; 3], [100.0, 0.0, 0.0], [100.0, 50.0, 0.0], [0.0, 50.0, 0.0]];
        let twice: Vec<[f64; 3]> = [lap, lap].concat();
        assert_eq!(up_to(&twice, [70.0, 0.0, 0.0]).unwrap(), [lap[0], [70.0, 0.0, 0.0]]);
    }
}
