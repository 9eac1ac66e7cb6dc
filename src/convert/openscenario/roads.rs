//! The roads of a scenario: places on lanes, and the lines that vehicles follow along them.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use glam::DVec3;
use xodr::{Direction, Lane, LaneId, LanePosition, LaneType, Point, RoadNetwork, RoadPosition};

use crate::opendrive::{across_road, array};

/// A line is simplified so that it stays this near to its points, in metres.
const NEAR_M: f64 = 0.01;

/// A vehicle whose heading differs from its lane's by more than this does not follow the lane, in radians.
const ALONG_RAD: f64 = 0.5;

/// Most lanes of a line.
const LANES: usize = 2000;

/// The roads of a scenario.
pub(super) struct RoadMap {
    network: RoadNetwork,
    lanes: BTreeMap<(String, i32), Vec<LaneId>>,
}

/// A place on a lane, and the direction in which a vehicle faces there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spot {
    /// The place.
    pub(super) at: LanePosition,
    /// Whether the vehicle faces in the direction of increasing s.
    pub(super) is_up: bool,
}

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
    pub(super) fn new(network: RoadNetwork) -> Self {
        let mut lanes: BTreeMap<(String, i32), Vec<LaneId>> = BTreeMap::new();
        for lane in network.lanes() {
            let Some(of) = network.road_lane(lane.id) else { continue };
            let Some(road) = network.road(of.road) else { continue };
            lanes.entry((road.od_id().to_owned(), of.od_id)).or_default().push(lane.id);
        }
        Self { network, lanes }
    }

    /// A place by the ids of its road and its lane.
    pub(super) fn place(
        &self,
        road: &str,
        lane: i32,
        s: f64,
        offset: f64,
    ) -> Result<LanePosition, String> {
        let length_m = self.road_length_m(road)?;
        // Numbers of files are rounded.
        if !(-0.01..=length_m + 0.01).contains(&s) {
            return Err(format!("s is {s:?}, but road {road:?} is {length_m:?} m long"));
        }
        let s = s.clamp(0.0, length_m);
        let lanes = self.lanes.get(&(road.to_owned(), lane));
        let places = lanes.into_iter().flatten().map(|id| LanePosition { lane: *id, s, offset });
        let mut places = places.filter(|at| self.network.lane_point(*at).is_some());
        places.next().ok_or_else(|| format!("road {road:?} has no lane {lane} at s {s:?}"))
    }

    fn road_length_m(&self, road: &str) -> Result<f64, String> {
        let found = self.network.road_by_od_id(road);
        let road = found.ok_or_else(|| format!("the map has no road {road:?}"))?;
        Ok(road.length())
    }

    /// A place by the coordinates of its road, and the place on a lane there, if there is one.
    pub(super) fn road_place(
        &self,
        road: &str,
        s: f64,
        t: f64,
    ) -> Result<([f64; 3], f64, Option<LanePosition>), String> {
        let length_m = self.road_length_m(road)?;
        let found = self.network.road_by_od_id(road);
        let id = found.ok_or_else(|| format!("the map has no road {road:?}"))?.id();
        let point = self.network.road_point(RoadPosition { road: id, s, t });
        let point =
            point.ok_or_else(|| format!("s is {s:?}, but road {road:?} is {length_m:?} m long"))?;
        let heading_rad = self.road_heading_rad(id, s).unwrap_or(0.0);
        Ok((array(point), heading_rad, self.lane_near(array(point))))
    }

    fn road_heading_rad(&self, road: xodr::RoadId, s: f64) -> Option<f64> {
        let left = across_road(&self.network, road, s)?;
        Some((-left.x).atan2(left.y))
    }

    /// The point of a place.
    pub(super) fn point(&self, at: LanePosition) -> [f64; 3] {
        array(self.network.lane_point(at).unwrap_or_default())
    }

    /// The direction of increasing s, in radians.
    pub(super) fn heading_rad(&self, at: LanePosition) -> f64 {
        let road = self.network.road_lane(at.lane).map(|of| of.road);
        road.and_then(|road| self.road_heading_rad(road, at.s)).unwrap_or(0.0)
    }

    /// Whether the traffic of a lane drives in the direction of increasing s.
    pub(super) fn drives_up(&self, lane: LaneId) -> bool {
        self.network.lane(lane).is_none_or(|lane| lane.direction != Direction::Backward)
    }

    /// The road and the id of a lane.
    pub(super) fn ids(&self, lane: LaneId) -> Option<(String, i32)> {
        let of = self.network.road_lane(lane)?;
        Some((self.network.road(of.road)?.od_id().to_owned(), of.od_id))
    }

    /// The lane that is so many lanes to the left of the road's direction, at the same s.
    pub(super) fn beside(&self, at: LanePosition, count: i32) -> Result<LanePosition, String> {
        let (road, lane) = self.ids(at.lane).ok_or("is on no lane")?;
        self.place(&road, shifted_id(lane, count), at.s, 0.0)
    }

    /// A place so far along the road, or along the lane's traffic.
    pub(super) fn moved(
        &self,
        at: LanePosition,
        way_m: f64,
        is_along_lane: bool,
    ) -> Result<LanePosition, String> {
        let is_up = self.drives_up(at.lane);
        let (road, lane) = self.ids(at.lane).ok_or("is on no lane")?;
        let ds = if is_along_lane && !is_up { -way_m } else { way_m };
        if let Ok(moved) = self.place(&road, lane, at.s + ds, at.offset) {
            return Ok(moved);
        }
        let way_m = if ds == way_m && !is_up { -way_m } else { way_m };
        let ends = self.network.advance(at, way_m);
        match ends.as_slice() {
            [xodr::Advance::Reached(end)] => Ok(*end),
            [] | [xodr::Advance::DeadEnd { .. }] => Err("is beyond the end of the road".to_owned()),
            _ => Err("is beyond a fork of the road; give a <LanePosition>".to_owned()),
        }
    }

    /// The place on a lane at a point: `None` farther than its width, or where there is no lane.
    pub(super) fn lane_near(&self, xyz_m: [f64; 3]) -> Option<LanePosition> {
        let [x, y, z] = xyz_m.map(|axis| axis as f32);
        let at = self.network.lane_position(Point::new(x, y, z))?;
        let lane = self.network.lane(at.lane)?;
        (at.offset.abs() <= 0.5 * f64::from(lane.width) + 0.5).then_some(at)
    }

    /// The spot of a vehicle with a heading; `None` if it stands across its lane.
    pub(super) fn spot(&self, at: LanePosition, yaw_rad: f64) -> Option<Spot> {
        let turned = yaw_rad - self.heading_rad(at);
        let turned = (turned + PI).rem_euclid(2.0 * PI) - PI;
        match turned.abs() {
            off if off < ALONG_RAD => Some(Spot { at, is_up: true }),
            off if off > PI - ALONG_RAD => Some(Spot { at, is_up: false }),
            _ => None,
        }
    }

    /// Whether two lanes are of one section of a road.
    pub(super) fn is_beside(&self, lane: LaneId, other: LaneId) -> bool {
        let place = |lane| self.network.road_lane(lane).map(|of| (of.road, of.section));
        lane == other || place(lane).is_some_and(|at| place(other) == Some(at))
    }

    /// The lanes after a lane, and those beside it in its direction.
    pub(super) fn reachable(&self, lane: LaneId) -> Vec<LaneId> {
        let lane = self.network.lane(lane);
        lane.map_or(Vec::new(), |lane| [lane.successors.as_slice(), &lane.neighbors].concat())
    }

    /// The road and the s that are so far along the roads of a route.
    pub(super) fn along(
        &self,
        waypoints: &[LanePosition],
        lanes: &[LaneId],
        way_m: f64,
    ) -> Result<(String, f64), String> {
        let mut left_m = way_m;
        let mut roads: Vec<(String, bool)> = Vec::new();
        for lane in lanes {
            let Some((road, _)) = self.ids(*lane) else { continue };
            if roads.last().is_none_or(|(last, _)| *last != road) {
                roads.push((road, self.drives_up(*lane)));
            }
        }
        for (index, (road, is_up)) in roads.into_iter().enumerate() {
            let length_m = self.road_length_m(&road)?;
            let from_s = match (index, waypoints.first()) {
                (0, Some(first)) => first.s,
                _ if is_up => 0.0,
                _ => length_m,
            };
            let room_m = if is_up { length_m - from_s } else { from_s };
            if left_m <= room_m {
                return Ok((road, if is_up { from_s + left_m } else { from_s - left_m }));
            }
            left_m -= room_m;
        }
        Err(format!("pathS is {way_m:?}, which is beyond the route"))
    }

    /// The line along the middles of the lanes from a spot, as long as `length_m`; at forks onto lanes of a route, if it
    /// has one.
    pub(super) fn line(&self, from: Spot, length_m: f64, route: &[LaneId]) -> LaneLine {
        let start = LanePosition { offset: 0.0, ..from.at };
        let mut line = LaneLine { points: vec![self.point(start)], ..LaneLine::default() };
        let Some(mut lane) = self.network.lane(from.at.lane) else { return line };
        let mut is_up = from.is_up;
        let mut arc_m = self.network.centerline_s(start).map_or(0.0, f64::from);
        let mut left_m = length_m;
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
            arc_m = if is_up { 0.0 } else { f64::from(lane.center.length()) };
        }
        line.points = simplified(&line.points);
        line
    }

    /// The lane that continues a lane, the straightest of several, and whether it is driven in the direction of s.
    fn next(
        &self,
        lane: &Lane,
        is_up: bool,
        route: &[LaneId],
        forks: &mut Vec<String>,
    ) -> Option<(&Lane, bool)> {
        let is_with_traffic = is_up == self.drives_up(lane.id);
        let linked = if is_with_traffic { &lane.successors } else { &lane.predecessors };
        let end = end_of(lane, is_up)?;
        let mut options: Vec<(f64, &Lane, bool)> = linked
            .iter()
            .filter_map(|id| self.network.lane(*id))
            .filter(|next| is_for_traffic(next.kind) || !is_for_traffic(lane.kind))
            .filter_map(|next| {
                let drives_up = next.direction != Direction::Backward;
                let next_is_up = drives_up == is_with_traffic;
                // The heading at its end tells where it leads.
                let turned = turned_rad(end, end_of(next, next_is_up)?);
                Some((turned.abs(), next, next_is_up))
            })
            .collect();
        options.sort_by(|a, b| a.0.total_cmp(&b.0));
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

    /// The line of the lane beside that has an id on the roads of a line, from the first road that has it on.
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
                if !found.lanes.iter().any(|(id, _)| *id == beside.id) {
                    let (road, _) = self.ids(*id).unwrap_or_default();
                    let message = format!("lane {lane} of road {road:?} is not the one before it");
                    return Err(message);
                }
                continue;
            }
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

/// The id of the lane so many lanes to the left of the road's direction: there is no lane 0 to drive on.
pub(super) fn shifted_id(lane: i32, count: i32) -> i32 {
    let shifted = lane.saturating_add(count);
    match (lane < 0, shifted >= 0) {
        (true, true) => shifted + 1,
        (false, _) if shifted <= 0 => shifted - 1,
        _ => shifted,
    }
}

fn is_for_traffic(kind: LaneType) -> bool {
    kind.is_drivable()
}

/// Adds the points of a lane from a place on its middle to its end. Returns their length, in metres.
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
    if is_up { length_m - arc_m } else { arc_m }
}

/// The direction at the end of a lane that is driven up or down.
fn end_of(lane: &Lane, is_up: bool) -> Option<DVec3> {
    let tangents = lane.center.tangents();
    let tangent = if is_up { tangents.last() } else { tangents.first() }?;
    let tangent = DVec3::new(f64::from(tangent.x), f64::from(tangent.y), 0.0);
    Some(if is_up { tangent } else { -tangent })
}

fn turned_rad(from: DVec3, to: DVec3) -> f64 {
    from.cross(to).z.atan2(from.dot(to))
}

/// The line without the points that are within [`NEAR_M`] of it, or farther if it is very long.
pub(super) fn simplified(points: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let mut near_m = NEAR_M;
    loop {
        let line = within(points, near_m);
        // As many as a scenario accepts, with some for what a trajectory adds.
        if line.len() <= wildcity_sim::limits::COURSE_POINTS / 2 || near_m > 0.1 {
            return line;
        }
        near_m *= 1.5;
    }
}

/// The line without the points that are within a distance of it (Douglas and Peucker), with coordinates in tenths of a
/// millimetre.
fn within(points: &[[f64; 3]], near_m: f64) -> Vec<[f64; 3]> {
    let Some(last) = points.len().checked_sub(1) else { return Vec::new() };
    let at = |index: usize| DVec3::from_array(points[index]);
    let mut is_kept = vec![false; points.len()];
    is_kept[0] = true;
    is_kept[last] = true;
    let mut spans = vec![(0, last)];
    while let Some((from, to)) = spans.pop() {
        let way_m = at(to) - at(from);
        let off_m = |index: usize| {
            let t = (at(index) - at(from)).dot(way_m) / way_m.length_squared().max(1e-12);
            (at(from) + t.clamp(0.0, 1.0) * way_m).distance(at(index))
        };
        let farthest = (from + 1..to).map(|index| (off_m(index), index));
        let Some((off_m, index)) = farthest.max_by(|a, b| a.0.total_cmp(&b.0)) else { continue };
        if off_m > near_m {
            is_kept[index] = true;
            spans.extend([(from, index), (index, to)]);
        }
    }
    let kept = points.iter().zip(is_kept).filter(|(_, is_kept)| *is_kept);
    kept.map(|(point, _)| point.map(|axis| (axis * 1e4).round() / 1e4)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_is_no_lane_0_to_drive_on() {
        assert_eq!(
            [(-2, 1), (-1, 1), (-1, 2), (1, -1), (2, -1), (1, -2)]
                .map(|(lane, count)| { shifted_id(lane, count) }),
            [-1, 1, 2, -1, 1, -2]
        );
    }

    #[test]
    fn a_simplified_line_stays_near_its_points() {
        let line: Vec<[f64; 3]> = (0..=1000).map(|i| [f64::from(i), 0.0, 0.0]).collect();
        assert_eq!(simplified(&line), [[0.0; 3], [1000.0, 0.0, 0.0]]);
        let arc = (0..=1000).map(|i| {
            let angle_rad = f64::from(i) * 1e-3;
            [100.0 * angle_rad.sin(), 100.0 - 100.0 * angle_rad.cos(), 0.0]
        });
        let arc: Vec<[f64; 3]> = arc.collect();
        let kept = simplified(&arc);
        // A chord of 2.8 m is 1 cm from an arc of 100 m.
        assert!((30..70).contains(&kept.len()), "{}", kept.len());
    }
}
