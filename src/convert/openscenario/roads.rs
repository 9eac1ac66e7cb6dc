//! The roads of a scenario, and places on their lanes.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use xodr::{Direction, LaneId, LanePosition, Point, RoadNetwork, RoadPosition};

use crate::opendrive::{across_road, array};

/// A vehicle whose heading differs from its lane's by more than this does not follow the lane, in
/// radians.
const ALONG_RAD: f64 = 0.5;

/// The roads of a scenario.
pub(super) struct RoadMap {
    pub(super) network: RoadNetwork,
    lanes: BTreeMap<(String, i32), Vec<LaneId>>,
}

/// A place on a lane, and the direction in which a vehicle faces there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spot {
    pub(super) at: LanePosition,
    /// Whether the vehicle faces in the direction of increasing s.
    pub(super) is_up: bool,
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
        // The lanes of one id in all sections of the road. Only that of the section at s has a
        // point there.
        let mut places = lanes
            .into_iter()
            .flatten()
            .map(|id| LanePosition { lane: *id, s, offset })
            .filter(|at| self.network.lane_point(*at).is_some());
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
        let point = self
            .network
            .road_point(RoadPosition { road: id, s, t })
            .ok_or_else(|| format!("s is {s:?}, but road {road:?} is {length_m:?} m long"))?;
        let heading_rad = self.road_heading_rad(id, s).unwrap_or(0.0);
        Ok((array(point), heading_rad, self.lane_near(array(point))))
    }

    fn road_heading_rad(&self, road: xodr::RoadId, s: f64) -> Option<f64> {
        let left = across_road(&self.network, road, s)?;
        // The left of a heading h is (-sin h, cos h).
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
        // As long as it stays on the road, the lane keeps its id.
        if let Ok(moved) = self.place(&road, lane, at.s + ds, at.offset) {
            return Ok(moved);
        }
        // `advance` follows the traffic of the lane, while a way along the road follows s.
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
        // Half a metre beside the lane still counts.
        (at.offset.abs() <= 0.5 * f64::from(lane.width) + 0.5).then_some(at)
    }

    /// The spot of a vehicle with a heading; `None` if it stands across its lane.
    pub(super) fn spot(&self, at: LanePosition, yaw_rad: f64) -> Option<Spot> {
        let turned = yaw_rad - self.heading_rad(at);
        // The difference of two headings, from -π to π.
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
        // Invariant: `left_m` is what remains of the way where this road begins.
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
}

/// The id of the lane so many lanes to the left of the road's direction: there is no lane 0 to
/// drive on.
pub(super) fn shifted_id(lane: i32, count: i32) -> i32 {
    let shifted = lane.saturating_add(count);
    match (lane < 0, shifted >= 0) {
        (true, true) => shifted + 1,
        (false, _) if shifted <= 0 => shifted - 1,
        _ => shifted,
    }
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
}
