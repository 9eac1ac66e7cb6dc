//! What AlpaSim scores of an ego on the road, with its faults.
//!
//! Source: NVlabs/alpasim 3032e0c, `src/eval/src/eval/scorers/offroad.py`. Lanes farther than 6 m from the ego, which
//! it leaves out, contain no part of the ego either.

use std::f64::consts::PI;

use glam::DVec2;

use super::alpasim_box::RoundedBox;
use super::map::LaneMap;
use super::plan::turn_rad;

/// A road edge that is nearer than this is touched, in metres.
const EDGE_M: f64 = 1e-3;
/// Half of the length of line that gives its heading, in metres.
const HEADING_M: f64 = 0.01;
/// Headings that differ by more are of the wrong lane, in radians.
const WRONG_RAD: f64 = PI * 2.0 / 3.0;

/// Whether the ego is off the road: the lanes together do not hold it, and it touches their edge. An ego that is wholly
/// outside is not off the road: it touches nothing.
pub fn is_off_road(map: &LaneMap, ego: &RoundedBox) -> bool {
    let outline_m = ego.outline_m();
    let inside = outline_m.map(|point_m| map.lanes.iter().any(|lane| lane.holds(point_m)));
    if !inside.contains(&false) {
        return false;
    }
    let touches = |edge| ego.distance_m(&edge) < EDGE_M;
    map.lanes.iter().any(|lane| lane.edges().any(touches))
}

/// Whether the centre of the ego is in a lane of another direction; `None` if the lanes have no direction.
///
/// Headings from -π to π are subtracted as they are: where a lane leads west, an ego that follows it is in the wrong
/// lane as soon as one of the two is beyond ±π.
pub fn is_in_wrong_lane(map: &LaneMap, center_m: DVec2, yaw_rad: f64) -> Option<bool> {
    let ego_rad = turn_rad(0.0, yaw_rad);
    let mut directed =
        map.lanes.iter().filter_map(|lane| Some((lane, lane.center.as_ref()?))).peekable();
    directed.peek()?;
    Some(directed.any(|(lane, line)| {
        let station_m = line.project(center_m).station_m;
        let ahead_m = line.at((station_m + HEADING_M).min(line.length_m())).0;
        let behind_m = line.at((station_m - HEADING_M).max(0.0)).0;
        lane.contains(center_m) && ((ahead_m - behind_m).to_angle() - ego_rad).abs() > WRONG_RAD
    }))
}
