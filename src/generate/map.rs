//! The map of a street or a city: lanes, parking bays, pavements, crosswalks and intersections,
//! from the same plan as the Gaussians.

use glam::DVec3;

use wildcity_sim::map::{Area, AreaKind, Lane, LaneKind, MapFile, StopLine};

use super::road::{
    FRONT_M, KERB_M, LANE_T_M, LANES_M, PAVEMENT_M, SIDE_LANES_M, SIDE_REACH_M, STOP_M, ZEBRA_M,
};
use super::route::Route;

/// Distance between two points of a line, in metres.
const SPACING_M: f64 = 2.0;
/// Speed limit of every street, in m/s: 50 km/h.
const LIMIT_MPS: f64 = 50.0 / 3.6;

/// Edges of a lane and its middle, in metres to the left of the centre line.
struct Strip {
    name: &'static str,
    kind: LaneKind,
    inner_m: f64,
    middle_m: f64,
    outer_m: f64,
    height_m: f64,
}

/// The strips on one side of the street, from its centre line outwards.
const STRIPS: [Strip; 3] = [
    Strip {
        name: "lane",
        kind: LaneKind::Driving,
        inner_m: 0.0,
        middle_m: -LANE_T_M,
        outer_m: LANES_M,
        height_m: 0.0,
    },
    Strip {
        name: "bays",
        kind: LaneKind::Parking,
        inner_m: LANES_M,
        middle_m: 0.5 * (LANES_M + KERB_M),
        outer_m: KERB_M,
        height_m: 0.0,
    },
    Strip {
        name: "pavement",
        kind: LaneKind::Sidewalk,
        inner_m: KERB_M,
        middle_m: 0.5 * (KERB_M + FRONT_M),
        outer_m: FRONT_M,
        height_m: PAVEMENT_M,
    },
];

/// A street with the middle of its crossing.
pub(super) struct MappedStreet<'a> {
    pub(super) route: &'a Route,
    pub(super) crossing_m: f64,
}

/// The map of streets that follow each other.
pub(super) fn build_map(streets: &[MappedStreet<'_>]) -> MapFile {
    let mut map = MapFile::new(Vec::new(), Vec::new());
    for (index, street) in streets.iter().enumerate() {
        let is_last = index + 1 == streets.len();
        for strip in &STRIPS {
            street.add_strip(&mut map, index, is_last, strip);
        }
        street.add_crossing(&mut map);
    }
    map
}

impl MappedStreet<'_> {
    /// Adds a strip to both sides. Lanes for vehicles are cut at the intersection; other strips
    /// leave it out.
    fn add_strip(&self, map: &mut MapFile, index: usize, is_last: bool, strip: &Strip) {
        let [from_m, to_m] = self.route.driven_m;
        let before_m = self.crossing_m - STOP_M[1];
        let after_m = self.crossing_m + STOP_M[1];
        // Before, in and after the intersection: a lane of the map lies in it or does not.
        let parts = [[from_m, before_m], [before_m, after_m], [after_m, to_m]];
        let id = |street: usize, side: &str, part: usize| {
            format!("street-{street}/{}-{side}/{part}", strip.name)
        };
        for (part, span_m) in parts.into_iter().enumerate() {
            let through = part == 1;
            if through && strip.kind != LaneKind::Driving {
                continue;
            }
            let drives = strip.kind == LaneKind::Driving;
            // Eastwards in the right lane, to the right of the centre line.
            let following = match part {
                2 if is_last => None,
                2 => Some(id(index + 1, "right", 0)),
                _ => Some(id(index, "right", part + 1)),
            };
            let next = following.into_iter().filter(|_| drives).collect();
            // The right side of the street runs with s, so its left edge is the inner one.
            let edges_m = [-strip.inner_m, -strip.middle_m, -strip.outer_m];
            let [left, center, right] = edges_m.map(|t_m| self.line(span_m, t_m, strip.height_m));
            let limit_mps = drives.then_some(LIMIT_MPS);
            let kind = strip.kind;
            map.lanes.push(Lane {
                id: id(index, "right", part),
                kind,
                center,
                left,
                right,
                next,
                intersection: through,
                limit_mps,
            });
            // And back.
            let following = match (part, index) {
                (0, 0) => None,
                (0, _) => Some(id(index - 1, "left", 2)),
                _ => Some(id(index, "left", part - 1)),
            };
            let next = following.into_iter().filter(|_| drives).collect();
            let edges_m = [strip.inner_m, strip.middle_m, strip.outer_m];
            // Against s: the same points in the opposite order.
            let [left, center, right] = edges_m.map(|t_m| {
                let mut line = self.line(span_m, t_m, strip.height_m);
                line.reverse();
                line
            });
            map.lanes.push(Lane {
                id: id(index, "left", part),
                kind,
                center,
                left,
                right,
                next,
                intersection: through,
                limit_mps,
            });
        }
    }

    /// Adds the intersection, its crosswalks and stop lines, and the side street.
    fn add_crossing(&self, map: &mut MapFile) {
        let s_m = self.crossing_m;
        let rectangle = |span_m: [f64; 2], across_m: [f64; 2]| {
            let corner = |s_m: f64, t_m: f64| self.point(s_m, t_m, 0.0);
            vec![
                corner(span_m[0], across_m[0]),
                corner(span_m[1], across_m[0]),
                corner(span_m[1], across_m[1]),
                corner(span_m[0], across_m[1]),
            ]
        };
        let kerbs_m = [-KERB_M, KERB_M];
        let span_m = [s_m - STOP_M[0], s_m + STOP_M[0]];
        let outline = rectangle(span_m, kerbs_m);
        map.areas.push(Area { kind: AreaKind::Intersection, outline });
        for side in [-1.0, 1.0] {
            let span_m = ZEBRA_M.map(|off_m| s_m + side * off_m);
            map.areas.push(Area { kind: AreaKind::Crosswalk, outline: rectangle(span_m, kerbs_m) });
            // The stop line of the traffic that comes from this side.
            let at_m = s_m + side * STOP_M[0];
            let line = [self.point(at_m, 0.0, 0.0), self.point(at_m, side * LANES_M, 0.0)];
            map.stop_lines.push(StopLine { line, lights: Vec::new() });
            // The side street leaves at a right angle and is straight.
            let middle = self.route.at(s_m);
            let corner = |along_m: f64, across_m: f64| {
                let point_m =
                    middle.point_m + along_m * side * middle.left + across_m * middle.forward;
                point_m.to_array()
            };
            let outline = vec![
                corner(KERB_M, -SIDE_LANES_M),
                corner(SIDE_REACH_M, -SIDE_LANES_M),
                corner(SIDE_REACH_M, SIDE_LANES_M),
                corner(KERB_M, SIDE_LANES_M),
            ];
            map.areas.push(Area { kind: AreaKind::Drivable, outline });
        }
    }

    /// Points along the street at a distance from its centre line, both ends included.
    fn line(&self, [from_m, to_m]: [f64; 2], t_m: f64, height_m: f64) -> Vec<[f64; 3]> {
        // Equal steps of at most 2 m, so that both ends are points of the line.
        let count = ((to_m - from_m) / SPACING_M).ceil().max(1.0) as usize;
        let station_m = |at: usize| from_m + (to_m - from_m) * at as f64 / count as f64;
        (0..=count).map(|at| self.point(station_m(at), t_m, height_m)).collect()
    }

    fn point(&self, s_m: f64, t_m: f64, height_m: f64) -> [f64; 3] {
        let point_m: DVec3 = self.route.at(s_m).beside(t_m, height_m);
        point_m.to_array()
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;
    use wildcity_sim::map::{AreaKind, LaneKind, Map};

    use crate::{CitySettings, StreetSettings, city_drive, city_map, street_map};

    #[test]
    fn the_recorded_drive_is_in_the_right_lanes() {
        let settings =
            CitySettings { seed: 4, length_m: 700.0, millions_per_km: 1.0, speed_m_s: 10.0 };
        let map = Map::new(city_map(&settings).unwrap()).unwrap();
        let drive = city_drive(&settings).unwrap();
        for keyframe in &drive.keyframes {
            let pose = keyframe.world_from_rig;
            let point_m = pose.position_m.truncate();
            let lanes: Vec<_> = map.lanes_at(point_m).collect();
            assert!(!lanes.is_empty(), "{point_m}");
            let in_right =
                lanes.iter().any(|lane| map.file().lanes[*lane].id.contains("lane-right"));
            assert!(in_right, "{point_m}");
            // The drive is 1.75 m right of the centre line, and each lane 3.6 m wide.
            // 1.85 m to the right and 5.35 m to the left are the edges of the carriageway.
            let at = |left_m: f64| pose.transform_point(left_m * glam::DVec3::Y).truncate();
            assert!(map.is_drivable(at(-1.8)) && map.is_drivable(at(5.3)), "{point_m}");
        }
        // Every lane leads on, to the end.
        let mut lane = map.lane("street-0/lane-right/0").unwrap();
        let mut count = 1;
        while let Some(next) = lane.next.first() {
            lane = map.lane(next).unwrap();
            count += 1;
        }
        // Three parts of each street, and 700 m have at least three streets.
        assert!(count >= 9 && count % 3 == 0, "{count} parts");
        assert!(
            lane.center.last().unwrap()[0]
                > drive.keyframes.last().unwrap().world_from_rig.position_m.x
        );
    }

    #[test]
    fn the_street_has_its_crosswalks_bays_and_pavements() {
        let settings = StreetSettings::default();
        let map = Map::new(street_map(&settings).unwrap()).unwrap();
        let kinds =
            |kind: LaneKind| map.file().lanes.iter().filter(|lane| lane.kind == kind).count();
        let counts = [LaneKind::Driving, LaneKind::Parking, LaneKind::Sidewalk].map(kinds);
        // Lanes have three parts on both sides; bays and pavements two, as they leave the
        // intersection out.
        assert_eq!(counts, [6, 4, 4]);
        let crosswalk = map.file().areas.iter().find(|area| area.kind == AreaKind::Crosswalk);
        let corners = crosswalk.unwrap().outline.iter();
        let middle = corners.map(|[x, y, _]| DVec2::new(*x, *y)).sum::<DVec2>() / 4.0;
        assert!(map.is_drivable(middle) && map.is_in(middle, AreaKind::Intersection));
    }
}
