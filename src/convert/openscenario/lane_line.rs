//! The lines that vehicles follow along lanes.

use glam::DVec3;
use xodr::{Direction, Lane, LaneId, LanePosition, LaneType, Point};

use super::roads::{RoadMap, Spot};
use super::simplify::simplified;
use crate::opendrive::array;

/// Most lanes of a line.
const LANES: usize = 2000;

/// The way of a vehicle along lanes.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct LaneLine {
    /// Points of the lanes' middle, in metres, from the start on.
    pub(super) points: Vec<[f64; 3]>,
    /// The lanes in order, each with whether the vehicle drives in the direction of increasing s.
    pub(super) lanes: Vec<(LaneId, bool)>,
    /// The lanes at whose ends it chose the straightest of several.
    pub(super) forks: Vec<String>,
    /// Whether the road goes on where the line ends.
    pub(super) is_cut: bool,
}

impl RoadMap {
    /// The line along the middles of the lanes from a spot, as long as `length_m`; at forks onto
    /// lanes of a route, if it has one.
    pub(super) fn line(&self, from: Spot, length_m: f64, route: &[LaneId]) -> LaneLine {
        let start = LanePosition { offset: 0.0, ..from.at };
        let mut line = LaneLine { points: vec![self.point(start)], ..LaneLine::default() };
        let Some(mut lane) = self.network.lane(from.at.lane) else { return line };
        let mut is_up = from.is_up;
        // The place of the start on its lane's middle, in metres from the end where s is least.
        let mut arc_m = self.network.centerline_s(start).map_or(0.0, f64::from);
        let mut left_m = length_m;
        // Lanes may form a ring, so that only the length or the number of lanes ends this.
        while line.lanes.len() < LANES {
            line.lanes.push((lane.id, is_up));
            left_m -= add_points(lane, is_up, arc_m, &mut line.points);
            let next = self.next(lane, is_up, route, &mut line.forks);
            if left_m <= 0.0 || line.lanes.len() == LANES {
                line.is_cut = next.is_some();
                break;
            }
            let Some((next, next_is_up)) = next else { break };
            lane = next;
            is_up = next_is_up;
            // The next lane is entered at its first point, or at its last if it is driven against
            // s.
            arc_m = if is_up { 0.0 } else { f64::from(lane.center.length()) };
        }
        line.points = simplified(&line.points);
        line
    }

    /// The lane that continues a lane, the straightest of several, and whether it is driven in the
    /// direction of s.
    fn next(
        &self,
        lane: &Lane,
        is_up: bool,
        route: &[LaneId],
        forks: &mut Vec<String>,
    ) -> Option<(&Lane, bool)> {
        // Successors are in the direction of traffic. A vehicle against it goes on to the
        // predecessors.
        let is_with_traffic = is_up == self.drives_up(lane.id);
        let linked = if is_with_traffic { &lane.successors } else { &lane.predecessors };
        let end = end_direction(lane, is_up)?;
        let mut options: Vec<(f64, &Lane, bool)> = linked
            .iter()
            .filter_map(|id| self.network.lane(*id))
            // From a lane for traffic, a line does not go on to a shoulder or a sidewalk.
            .filter(|next| is_for_traffic(next.kind) || !is_for_traffic(lane.kind))
            .filter_map(|next| {
                let drives_up = next.direction != Direction::Backward;
                let next_is_up = drives_up == is_with_traffic;
                // The heading at its end tells where it leads.
                let turned = turned_rad(end, end_direction(next, next_is_up)?);
                Some((turned.abs(), next, next_is_up))
            })
            .collect();
        options.sort_by(|a, b| a.0.total_cmp(&b.0));
        // A lane beside one of the route will do, because a vehicle may change lanes on its way.
        let on_route = |lane: &Lane| route.iter().any(|other| self.is_beside(*other, lane.id));
        if let Some((_, next, next_is_up)) = options.iter().find(|(_, next, _)| on_route(next)) {
            return Some((*next, *next_is_up));
        }
        if options.len() > 1 {
            let name = self
                .ids(options[0].1.id)
                .map_or(String::new(), |(road, lane)| format!("road {road:?}, lane {lane}"));
            forks.push(name);
        }
        options.first().map(|(_, next, next_is_up)| (*next, *next_is_up))
    }

    /// The line of the lane beside that has an id on the roads of a line, from the first road that
    /// has it on.
    ///
    /// # Errors
    /// There is none, or the id is that of different lanes on different roads.
    pub(super) fn line_of_lane(
        &self,
        from: &LaneLine,
        start: Spot,
        lane: i32,
        (length_m, route): (f64, &[LaneId]),
    ) -> Result<LaneLine, String> {
        let mut found: Option<LaneLine> = None;
        for (index, (id, is_up)) in from.lanes.iter().enumerate() {
            let Some(of) = self.network.road_lane(*id) else { continue };
            let beside = self.network.lanes().iter().find(|other| {
                self.network.road_lane(other.id).is_some_and(|other| {
                    (other.road, other.section, other.od_id) == (of.road, of.section, lane)
                })
            });
            let Some(beside) = beside else { continue };
            if let Some(found) = &found {
                // On every further road, the id must name the lane that continues the one that was
                // found.
                if !found.lanes.iter().any(|(id, _)| *id == beside.id) {
                    let (road, _) = self.ids(*id).unwrap_or_default();
                    let message = format!("lane {lane} of road {road:?} is not the one before it");
                    return Err(message);
                }
                continue;
            }
            // On its own road from where it is; on a later one from the end at which it arrives.
            let s = match index {
                0 => start.at.s,
                _ => self.end_s(*id, !*is_up),
            };
            let at = LanePosition { lane: beside.id, s, offset: 0.0 };
            if self.network.lane_point(at).is_none() {
                continue;
            }
            found = Some(self.line(Spot { at, is_up: *is_up }, length_m, route));
        }
        found.ok_or_else(|| format!("there is no lane {lane} on its way"))
    }

    /// The s of a lane's end: the last, or the first.
    fn end_s(&self, lane: LaneId, is_last: bool) -> f64 {
        let Some(of) = self.network.lane(lane) else { return 0.0 };
        let points = of.center.points();
        let point = if is_last { points.last() } else { points.first() };
        let road = self.network.road_lane(lane).map(|of| of.road);
        let at =
            road.zip(point).and_then(|(road, point)| self.network.road_position_on(road, *point));
        let s = at.map_or(0.0, |at| at.s);
        // Rounding may put it just beyond the section.
        let inside = [s, s - 1e-3, s + 1e-3, s - 0.01, s + 0.01];
        let exists = |s: &f64| self.network.lane_point(LanePosition { lane, s: *s, offset: 0.0 });
        inside.into_iter().find(|s| exists(s).is_some()).unwrap_or(s)
    }
}

fn is_for_traffic(kind: LaneType) -> bool {
    kind.is_drivable()
}

/// Adds the points of a lane from a place on its middle to its end. Returns their length, in
/// metres.
fn add_points(lane: &Lane, is_up: bool, arc_m: f64, points: &mut Vec<[f64; 3]>) -> f64 {
    let mut at_m = 0.0;
    let mut before: Option<&Point> = None;
    let mut ahead: Vec<[f64; 3]> = Vec::new();
    for point in lane.center.points() {
        at_m += before.map_or(0.0, |before| f64::from(before.distance_to(*point)));
        before = Some(point);
        let is_ahead = if is_up { at_m > arc_m } else { at_m < arc_m };
        if is_ahead {
            ahead.push(array(*point));
        }
    }
    if !is_up {
        ahead.reverse();
    }
    points.extend(ahead);
    let length_m = f64::from(lane.center.length());
    // What is left of the lane from `arc_m` on, in the direction of driving.
    if is_up { length_m - arc_m } else { arc_m }
}

/// The direction at the end of a lane that is driven up or down.
fn end_direction(lane: &Lane, is_up: bool) -> Option<DVec3> {
    let tangents = lane.center.tangents();
    let end = if is_up { tangents.last() } else { tangents.first() }?;
    let tangent = DVec3::new(f64::from(end.x), f64::from(end.y), 0.0);
    Some(if is_up { tangent } else { -tangent })
}

fn turned_rad(from: DVec3, to: DVec3) -> f64 {
    // The signed angle a: the cross product is |from| |to| sin a, and the dot product is |from|
    // |to| cos a.
    from.cross(to).z.atan2(from.dot(to))
}
