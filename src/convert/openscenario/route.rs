//! Routes: places that a vehicle passes, and the lanes between them.

use std::collections::{HashMap, VecDeque};

use xodr::{LaneId, LanePosition};

use super::catalogs::declared;
use super::element::Element;
use super::model::{Context, Place};
use super::roads::RoadMap;
use crate::ConvertError;

/// Most way-points of a route.
const WAYPOINTS: usize = 1000;

/// What reads the place of a `<Position>`: positions may be on routes themselves.
pub(super) type ReadPlace = fn(&Element<'_>, &Context<'_>) -> Result<Place, ConvertError>;

/// The places of a `<Route>`, or of the one that a reference names.
pub(super) fn waypoints(
    holder: &Element<'_>,
    context: &Context<'_>,
    place_from: ReadPlace,
) -> Result<Vec<LanePosition>, ConvertError> {
    holder.only(&["Route", "CatalogReference"])?;
    let (route, is_entry) = match holder.find("CatalogReference")? {
        Some(reference) => (context.catalogs.entry(&reference)?, true),
        None => (declared(&holder.need("Route")?)?, false),
    };
    route.only(&["ParameterDeclarations", "Waypoint"])?;
    if route.find_flag("closed")?.unwrap_or(false) {
        return Err(route.wrong("closed=\"true\" is not read; repeat the way-points"));
    }
    let mut places = Vec::new();
    for waypoint in route.all("Waypoint") {
        waypoint.only(&["Position"])?;
        // There is one shortest way on most maps; a random one is none that could be repeated.
        waypoint.expect("routeStrategy", &["shortest", "fastest", "leastIntersections"])?;
        let place = place_from(&waypoint.need("Position")?, context)?;
        let spot = place.spot.ok_or_else(|| waypoint.wrong("is on no lane"))?;
        places.push(spot.at);
        if places.len() > WAYPOINTS {
            return Err(route.wrong(&format!("at most {WAYPOINTS} way-points are read")));
        }
    }
    if places.len() < 2 {
        return Err(route.wrong("needs two way-points"));
    }
    if is_entry {
        route.check_read()?;
    }
    Ok(places)
}

/// The place of a `<RoutePosition>`: the road, the lane and the s.
pub(super) fn place_on_route(
    kind: &Element<'_>,
    context: &Context<'_>,
    roads: &RoadMap,
    place_from: ReadPlace,
) -> Result<LanePosition, ConvertError> {
    kind.only(&["RouteRef", "InRoutePosition", "Orientation"])?;
    let waypoints = waypoints(&kind.need("RouteRef")?, context, place_from)?;
    let place = kind.need("InRoutePosition")?.only_child()?;
    if place.name() != "FromLaneCoordinates" {
        return Err(place.unread());
    }
    let way_m = place.number("pathS")?;
    let lane = place.whole("laneId")?;
    let offset_m = place.number_or_0("laneOffset")?;
    let wrong = |message: String| place.wrong(&message);
    let lanes = lanes_between(&waypoints, roads).map_err(wrong)?;
    let at = roads.along(&waypoints, &lanes, way_m).map_err(wrong)?;
    let (road, s) = at;
    roads.place(&road, lane, s, offset_m).map_err(wrong)
}

/// The lanes from way-point to way-point: the fewest, with changes to lanes beside.
pub(super) fn lanes_between(
    waypoints: &[LanePosition],
    roads: &RoadMap,
) -> Result<Vec<LaneId>, String> {
    let mut lanes: Vec<LaneId> = Vec::new();
    for pair in waypoints.windows(2) {
        let way = shortest(pair[0].lane, pair[1].lane, roads)?;
        // A way begins with the last lane of the way before it.
        let skipped = usize::from(lanes.last() == way.first());
        lanes.extend(way.into_iter().skip(skipped));
    }
    Ok(lanes)
}

fn shortest(from: LaneId, to: LaneId, roads: &RoadMap) -> Result<Vec<LaneId>, String> {
    // Breadth first: the first way that arrives has the fewest lanes. `before` also marks the lanes
    // that were seen.
    let mut before: HashMap<LaneId, LaneId> = HashMap::new();
    let mut open = VecDeque::from([from]);
    while let Some(lane) = open.pop_front() {
        if roads.is_beside(lane, to) {
            // From the end back to the start, by the lane from which each was reached.
            let mut way = vec![lane];
            while let Some(lane) =
                way.last().filter(|lane| **lane != from).and_then(|lane| before.get(lane))
            {
                way.push(*lane);
            }
            way.reverse();
            if way.last() != Some(&to) {
                way.push(to);
            }
            return Ok(way);
        }
        for next in roads.reachable(lane) {
            if next != from && !before.contains_key(&next) {
                before.insert(next, lane);
                open.push_back(next);
            }
        }
    }
    let [from, to] = [from, to].map(|lane| roads.ids(lane).unwrap_or_default());
    Err(format!(
        "no way leads from road {:?}, lane {} to road {:?}, lane {}",
        from.0, from.1, to.0, to.1
    ))
}
