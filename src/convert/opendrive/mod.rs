//! Maps from OpenDRIVE.
//!
//! The crate xodr computes the lanes' centre lines and widths in the file's own axes, in f32: 1 mm
//! at 16 km from the origin. A map that reaches beyond is refused, unless it is moved to an origin
//! of its own first.

mod frame;

use glam::DVec3;
use wildcity_scene::geo::GeoAnchor;
use wildcity_sim::map::{Area, AreaKind, Lane, LaneKind, MapFile};
use xodr::{
    Direction, LanePosition, LaneType, Point, RoadId, RoadNetwork, RoadPosition, SpeedLimit,
};

use crate::{ConvertError, utf8_text};

/// Farthest coordinate, in metres.
pub const FARTHEST_M: f32 = 16_000.0;

/// Lanes narrower than this are left out, in metres: a lane that starts or ends as a wedge has no
/// width at this end.
const NARROW_M: f32 = 0.05;

/// A map, and the elements that the reader ignored or assumed.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    pub map: MapFile,
    /// The place of the origin on the earth, if the file says it.
    pub geo: Option<GeoAnchor>,
    pub warnings: Vec<String>,
}

/// A road network near the origin, and what is known about it.
pub(crate) struct Roads {
    /// The roads and lanes.
    pub(crate) network: RoadNetwork,
    /// What was added to the x and y of the file, in metres. Whatever else has coordinates in the
    /// frame of these roads moves with them.
    pub(crate) shift_m: [f64; 2],
    /// By how much the roads were moved, and why.
    pub(crate) notes: Vec<String>,
    geo: Option<GeoAnchor>,
    warnings: Vec<String>,
}

/// Reads the roads of an OpenDRIVE file, with the place of `origin` as the origin.
pub(crate) fn roads_from(bytes: &[u8], origin: Option<[f64; 2]>) -> Result<Roads, ConvertError> {
    let framed = frame::framed(utf8_text(bytes)?, origin)?;
    let (network, provenance) = xodr::load_str_with_provenance(&framed.text)
        .map_err(|error| ConvertError::new("OpenDRIVE", error.to_string()))?;
    let warnings = provenance.warnings.iter().map(ToString::to_string).collect();
    let frame::Framed { shift_m, geo, notes, .. } = framed;
    Ok(Roads { network, shift_m, notes, geo, warnings })
}

/// Reads an OpenDRIVE file. `origin` is the easting and the northing of the map's origin in the
/// projection of the file; without it, the origin is that of the file, or the offset of the file's
/// header is added where only that brings the roads near it.
///
/// # Errors
/// It is not OpenDRIVE, has no lanes, or reaches beyond [`FARTHEST_M`].
pub fn read(bytes: &[u8], origin: Option<[f64; 2]>) -> Result<Imported, ConvertError> {
    let Roads { network, notes, geo, warnings, .. } = roads_from(bytes, origin)?;
    let warnings = [notes, warnings].concat();
    let mut lanes = Vec::new();
    for lane in network.lanes() {
        if let Some(lane) = lane_from(&network, lane)? {
            lanes.push(lane);
        }
    }
    // Links to lanes that were left out lead nowhere.
    let kept: std::collections::BTreeSet<String> =
        lanes.iter().map(|lane| lane.id.clone()).collect();
    for lane in &mut lanes {
        lane.next.retain(|next| kept.contains(next));
    }
    if lanes.is_empty() {
        return Err(ConvertError::new("OpenDRIVE", "has no lane of any width; check the file"));
    }
    let junctions = network.junction_areas().iter().filter(|area| area.boundary.len() >= 3);
    let areas = junctions.map(|area| Area {
        kind: AreaKind::Intersection,
        outline: area.boundary.iter().map(|point| array(*point)).collect(),
    });
    let map = MapFile::new(lanes, areas.collect());
    map.check().map_err(|error| ConvertError::new(error.path, error.message))?;
    Ok(Imported { map, geo, warnings })
}

fn lane_from(network: &RoadNetwork, lane: &xodr::Lane) -> Result<Option<Lane>, ConvertError> {
    let Some(id) = lane_id(network, lane.id) else { return Ok(None) };
    let Some(kind) = lane_kind(lane.kind) else { return Ok(None) };
    let points = lane.center.points();
    let tangents = lane.center.tangents();
    // If there are fewer widths than points, the last one goes on.
    let width_m =
        |at: usize| lane.widths.get(at).or(lane.widths.last()).copied().unwrap_or(lane.width);
    // The widest place decides, so that a lane that only begins as a wedge is kept.
    let widest_m = (0..points.len()).map(width_m).fold(0.0, f32::max);
    if points.len() < 2 || widest_m < NARROW_M {
        return Ok(None);
    }
    let mut center = Vec::with_capacity(points.len());
    let mut left = Vec::with_capacity(points.len());
    let mut right = Vec::with_capacity(points.len());
    for (at, point) in points.iter().enumerate() {
        let is_near = [point.x, point.y, point.z].iter().all(|axis| axis.abs() <= FARTHEST_M);
        if !is_near {
            let message = format!(
                "reaches ({:?}, {:?}); at most {FARTHEST_M} m from the origin is exact: choose another --origin, or a \
                 part of the map",
                point.x, point.y
            );
            return Err(ConvertError::new(format!("lane {id}"), message));
        }
        let middle = DVec3::from_array(array(*point));
        // Across the road, if its place is known; else across the lane's own middle.
        let left_m = across_lane(network, lane, *point).unwrap_or_else(|| {
            let tangent = tangents.get(at).copied().unwrap_or_default();
            DVec3::new(-f64::from(tangent.y), f64::from(tangent.x), 0.0).normalize_or_zero()
        });
        // Half of the width along the bank, across the road.
        let half_m = 0.5 * f64::from(width_m(at));
        let bank_rad = f64::from(lane.bank.get(at).or(lane.bank.last()).copied().unwrap_or(0.0));
        let aside_m = half_m * (bank_rad.cos() * left_m + bank_rad.sin() * DVec3::Z);
        center.push(middle.to_array());
        left.push((middle + aside_m).to_array());
        right.push((middle - aside_m).to_array());
    }
    // The file's points are in the order of s. A lane against it is turned, so that its lines run
    // with the traffic, and its left is then its right.
    if lane.direction == Direction::Backward {
        center.reverse();
        left.reverse();
        right.reverse();
        std::mem::swap(&mut left, &mut right);
    }
    // A lane of a map has one limit: the one where the lane begins.
    let limit_mps = network.speed_limit_at(lane.id, 0.0).and_then(|limit| match limit {
        SpeedLimit::Max(mps) if mps > 0.1 => Some(f64::from(mps)),
        _ => None,
    });
    let road = network.road_lane(lane.id).and_then(|of| network.road(of.road));
    let intersection = road.is_some_and(|road| road.junction().is_some());
    let next = lane.successors.iter().filter_map(|next| lane_id(network, *next)).collect();
    Ok(Some(Lane { id, kind, center, left, right, next, intersection, limit_mps }))
}

/// The horizontal direction across the road to its left, at a point of the lane's middle: lanes are
/// cut across the road, also where they become wider and their middle is no parallel to the road.
fn across_lane(network: &RoadNetwork, lane: &xodr::Lane, point: Point) -> Option<DVec3> {
    let road = network.road_lane(lane.id)?.road;
    let at = network.road_position_on(road, point)?;
    // On a road that crosses itself, the nearest place may be another one.
    let found = network.lane_point(LanePosition { lane: lane.id, s: at.s, offset: 0.0 })?;
    if found.distance_to(point) > 0.01 {
        return None;
    }
    across_road(network, road, at.s)
}

/// The horizontal direction across a road to its left.
pub(crate) fn across_road(network: &RoadNetwork, road: RoadId, s: f64) -> Option<DVec3> {
    /// Far enough apart that rounding to f32 does not matter.
    const ASIDE_M: f64 = 10.0;
    // Two points 20 m apart: rounding by 1 mm turns their direction by 5e-5 rad at most.
    let [left, right] =
        [ASIDE_M, -ASIDE_M].map(|t| network.road_point(RoadPosition { road, s, t }));
    let apart = left? - right?;
    let across = DVec3::new(f64::from(apart.x), f64::from(apart.y), 0.0);
    (across.length() > ASIDE_M).then(|| across.normalize())
}

/// `ROAD/SECTION/LANE`, as the file numbers them.
fn lane_id(network: &RoadNetwork, lane: xodr::LaneId) -> Option<String> {
    let of = network.road_lane(lane)?;
    let road = network.road(of.road)?;
    Some(format!("{}/{}/{}", road.od_id(), of.section, of.od_id))
}

/// The kind of a lane; `None` for lanes that are not a surface to move on.
fn lane_kind(kind: LaneType) -> Option<LaneKind> {
    use LaneType as From;
    if kind.is_drivable() {
        return Some(LaneKind::Driving);
    }
    match kind {
        From::None | From::Median | From::Curb => None,
        From::Biking => Some(LaneKind::Bicycle),
        From::Sidewalk => Some(LaneKind::Sidewalk),
        From::Parking => Some(LaneKind::Parking),
        _ => Some(LaneKind::Other),
    }
}

pub(crate) fn array(point: Point) -> [f64; 3] {
    [point.x, point.y, point.z].map(f64::from)
}
