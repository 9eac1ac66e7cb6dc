//! AlpaSim's scores of the ego on the road, including their defects.
//!
//! Source: NVlabs/alpasim 3032e0c, `src/eval/src/eval/scorers/offroad.py`. Lanes farther than 6 m
//! from the ego, which it leaves out, contain no part of the ego either.

use std::f64::consts::PI;

use glam::DVec2;

use wildcity_sim::contact::Footprint;

use super::alpasim_box::RoundedBox;
use super::map::{Lane, LaneMap};
use super::plan::turn_rad;

/// A road edge that is nearer than this is touched, in metres.
const EDGE_M: f64 = 1e-3;
/// Lanes that are no farther apart than this have a seam between them and no edge of the road, in
/// metres: lanes of one road are sampled at different places, and no median is so narrow.
pub const SEAM_M: f64 = 0.2;
/// Half of the length of line that gives its heading, in metres.
const HEADING_M: f64 = 0.01;
/// If headings differ by more, the ego is in the wrong lane, in radians.
const WRONG_RAD: f64 = PI * 2.0 / 3.0;

/// The lanes of a map, each with its bounds.
#[derive(Clone, Debug)]
pub struct Road<'a> {
    lanes: Vec<BoundedLane<'a>>,
}

#[derive(Clone, Copy, Debug)]
struct BoundedLane<'a> {
    lane: &'a Lane,
    least_m: DVec2,
    most_m: DVec2,
}

impl<'a> Road<'a> {
    /// The road of a map.
    pub fn from_map(map: &'a LaneMap) -> Self {
        let bounded = |lane: &'a Lane| {
            // Bounds once per lane: later tests of a far lane then cost one comparison.
            let points_m = lane.outline_m.iter().copied();
            let least_m = points_m.clone().fold(DVec2::INFINITY, DVec2::min);
            BoundedLane { lane, least_m, most_m: points_m.fold(DVec2::NEG_INFINITY, DVec2::max) }
        };
        Self { lanes: map.lanes.iter().map(bounded).collect() }
    }

    /// Whether the ego is off the road: neither one lane nor their union contains it, and it
    /// touches their edge. An ego that is wholly outside is not off the road, because it does not
    /// touch an edge.
    ///
    /// The original uses a map layer with the edges of the road, which our maps lack; this function
    /// uses the edges of all lanes. So a seam between two lanes must not count: an opening of at
    /// most 0.2 m ([`SEAM_M`]). The original tests the whole polygon of the ego; this function
    /// tests its outline and the surroundings of every lane's edge below it, in steps of 0.2 m: a
    /// hole of 0.4 m by 0.4 m is always found.
    pub fn is_off(&self, ego: &RoundedBox) -> bool {
        let near: Vec<&Lane> = self.near(ego.center_m(), ego.reach_m() + SEAM_M).collect();
        let touches = |edge| ego.distance_m(&edge) < EDGE_M;
        // The containment first: it is false for few samples, and edges are tested only then.
        !hold(&near, ego) && near.iter().any(|lane| lane.edges().any(touches))
    }

    /// The lanes whose bounds are within `reach_m` of a point.
    fn near(&self, point_m: DVec2, reach_m: f64) -> impl Iterator<Item = &'a Lane> {
        let is_near = move |bounded: &&BoundedLane<'_>| {
            let within_m = point_m.clamp(bounded.least_m, bounded.most_m);
            within_m.distance(point_m) <= reach_m
        };
        self.lanes.iter().filter(is_near).map(|bounded| bounded.lane)
    }
}

/// Whether one lane contains the ego, or the union of all lanes does.
fn hold(lanes: &[&Lane], ego: &RoundedBox) -> bool {
    // Points no farther apart than a seam, so that no opening wider than a seam fits between two of
    // them.
    let outline_m = ego.outline_m(SEAM_M);
    // A lane has no hole.
    // One lane that has the whole outline contains the box: the fast, usual case.
    if lanes.iter().any(|lane| outline_m.iter().all(|&point_m| lane.holds(point_m))) {
        return true;
    }
    if !outline_m.iter().all(|&point_m| is_on_road(lanes, point_m)) {
        return false;
    }
    // A hole below the ego has edges of lanes around it.
    // A bound by circles first, then the exact distance.
    let below = |edge: &Footprint| {
        let reach_m = ego.reach_m() + 0.5 * edge.length_m;
        edge.center_m.distance(ego.center_m()) <= reach_m && ego.distance_m(edge) == 0.0
    };
    let edges = lanes.iter().flat_map(|lane| lane.edges()).filter(below);
    let mut beside_m = edges.flat_map(points_beside_m).filter(|&at_m| ego.holds(at_m));
    beside_m.all(|point_m| is_on_road(lanes, point_m))
}

/// Points on both sides of an edge, half a seam from it and no farther apart than a seam.
fn points_beside_m(edge: Footprint) -> impl Iterator<Item = DVec2> {
    let Footprint { center_m, forward, length_m, .. } = edge;
    let aside_m = 0.5 * SEAM_M * edge.left();
    let count = (length_m / SEAM_M).ceil().max(1.0) as usize;
    (0..count).flat_map(move |k| {
        let along_m = ((k as f64 + 0.5) / count as f64 - 0.5) * length_m * forward;
        [center_m + along_m - aside_m, center_m + along_m + aside_m]
    })
}

/// Whether a point lies in a lane, or in the seam between two.
fn is_on_road(lanes: &[&Lane], point_m: DVec2) -> bool {
    lanes.iter().any(|lane| lane.holds(point_m)) || is_in_seam(lanes, point_m)
}

/// Whether a point lies between two lanes that are no farther apart than a seam.
fn is_in_seam(lanes: &[&Lane], point_m: DVec2) -> bool {
    // The way from the point to each lane.
    let way_m = |lane: &&Lane| Some(lane.nearest_on_outline_m(point_m)? - point_m);
    let ways_m: Vec<DVec2> = lanes.iter().filter_map(way_m).collect();
    ways_m.iter().any(|a_m| {
        let is_opposite =
            |b_m: &DVec2| a_m.dot(*b_m) < 0.0 && a_m.length() + b_m.length() <= SEAM_M;
        ways_m.iter().any(is_opposite)
    })
}

/// Whether the centre of the ego is in a lane of another direction; `None` if the lanes have no
/// direction.
///
/// Headings from -π to π are subtracted without wrapping: where a lane leads west, an ego that
/// follows it is in the wrong lane as soon as one of the two is beyond ±π.
pub fn is_in_wrong_lane(map: &LaneMap, center_m: DVec2, yaw_rad: f64) -> Option<bool> {
    // From -π to π, as the published code has it.
    let ego_rad = turn_rad(0.0, yaw_rad);
    let mut directed =
        map.lanes.iter().filter_map(|lane| Some((lane, lane.center.as_ref()?))).peekable();
    directed.peek()?;
    Some(directed.any(|(lane, line)| {
        // The heading from two points 2 cm apart; at the ends of the line one side is shorter.
        let station_m = line.project(center_m).station_m;
        let ahead_m = line.at((station_m + HEADING_M).min(line.length_m())).0;
        let behind_m = line.at((station_m - HEADING_M).max(0.0)).0;
        lane.contains(center_m) && ((ahead_m - behind_m).to_angle() - ego_rad).abs() > WRONG_RAD
    }))
}
