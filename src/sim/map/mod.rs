//! Maps: lanes and areas of a twin. A twin needs none; what depends on a map is then unknown.
//!
//! | module | what it holds |
//! |---|---|
//! | `file` | `wildcity.map/1` |
//! | `strips` | areas along recorded drives, for twins without a map |
//! | `surface` | the road under lanes |
//!
//! `wildcity_convert` reads OpenDRIVE and GeoJSON.

mod file;
mod strips;
mod surface;

use std::collections::BTreeMap;

use glam::DVec2;

pub use file::{Area, AreaKind, Lane, LaneKind, MapFile, StopLine};
pub use strips::strips_beside;
pub use surface::{LaneSurface, SurfacePoint};

use crate::scenario::FileError;

/// A map with what is looked up in it.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    file: MapFile,
    /// Index of each lane by its id.
    indices: BTreeMap<String, usize>,
    /// Outlines of the lanes, then of the areas, with their boxes.
    lanes: Vec<Outline>,
    areas: Vec<Outline>,
    surface: LaneSurface,
}

/// A polygon seen from above.
#[derive(Clone, Debug, PartialEq)]
struct Outline {
    points_m: Vec<DVec2>,
    min_m: DVec2,
    max_m: DVec2,
}

impl Map {
    /// A map to look things up in.
    ///
    /// # Errors
    /// As [`MapFile::check`].
    pub fn new(file: MapFile) -> Result<Self, FileError> {
        file.check()?;
        let indices =
            file.lanes.iter().enumerate().map(|(index, lane)| (lane.id.clone(), index)).collect();
        let lanes = file.lanes.iter().map(Outline::from_lane).collect();
        let areas =
            file.areas.iter().map(|area| Outline::from_points(area.outline.iter())).collect();
        let surface = LaneSurface::from_driving_lanes(&file.lanes);
        Ok(Self { file, indices, lanes, areas, surface })
    }

    /// The file that the map was made of, unchanged.
    pub fn file(&self) -> &MapFile {
        &self.file
    }

    /// The surface of the lanes for vehicles.
    pub fn surface(&self) -> &LaneSurface {
        &self.surface
    }

    /// A lane by its id.
    pub fn lane(&self, id: &str) -> Option<&Lane> {
        self.indices.get(id).map(|index| &self.file.lanes[*index])
    }

    /// The indices of the lanes for vehicles that contain a point, edges included.
    pub fn lanes_at(&self, point_m: DVec2) -> impl Iterator<Item = usize> {
        // Linear over all lanes: the box of an outline refuses most of them with four comparisons.
        let lanes = self.lanes.iter().zip(&self.file.lanes).enumerate();
        lanes
            .filter(move |(_, (outline, lane))| {
                lane.kind == LaneKind::Driving && outline.contains(point_m)
            })
            .map(|(index, _)| index)
    }

    /// Whether vehicles may be at a point: in a lane for vehicles, or in a drivable area or an
    /// intersection.
    pub fn is_drivable(&self, point_m: DVec2) -> bool {
        self.lanes_at(point_m).next().is_some()
            || self.is_in(point_m, AreaKind::Drivable)
            || self.is_in(point_m, AreaKind::Intersection)
    }

    /// Whether a point is in an area of a kind, or in a lane that leads through an intersection if
    /// that is asked.
    pub fn is_in(&self, point_m: DVec2, kind: AreaKind) -> bool {
        let mut areas = self.areas.iter().zip(&self.file.areas);
        let in_area = areas.any(|(outline, area)| area.kind == kind && outline.contains(point_m));
        let through = kind == AreaKind::Intersection
            && self.lanes_at(point_m).any(|lane| self.file.lanes[lane].intersection);
        in_area || through
    }

    /// The surface of lanes in order. Their middle is the way along them.
    ///
    /// # Errors
    /// There is no such lane: the index within `ids`, and what to write.
    pub(crate) fn lane_surface(&self, ids: &[String]) -> Result<LaneSurface, (usize, String)> {
        let lanes = ids.iter().enumerate().map(|(index, id)| {
            let none = || (index, format!("there is no lane {id:?}; name a lane of the map"));
            self.lane(id).ok_or_else(none)
        });
        Ok(LaneSurface::from_lanes(lanes.collect::<Result<Vec<_>, _>>()?.into_iter()))
    }
}

impl Outline {
    fn from_points<'a>(points: impl Iterator<Item = &'a [f64; 3]>) -> Self {
        let points_m: Vec<DVec2> = points.map(|[x, y, _]| DVec2::new(*x, *y)).collect();
        // An outline without points has an inverted box, and contains nothing.
        let none = DVec2::INFINITY;
        let min_m = points_m.iter().fold(none, |min_m, point_m| min_m.min(*point_m));
        let max_m = points_m.iter().fold(-none, |max_m, point_m| max_m.max(*point_m));
        Self { points_m, min_m, max_m }
    }

    fn from_lane(lane: &Lane) -> Self {
        Self::from_points(lane.left.iter().chain(lane.right.iter().rev()))
    }

    /// Whether a point is inside or on the edge: the winding number is not 0. So a strip that
    /// crosses itself has no hole there.
    fn contains(&self, point_m: DVec2) -> bool {
        let in_box = point_m.cmpge(self.min_m).all() && point_m.cmple(self.max_m).all();
        if !in_box {
            return false;
        }
        let mut winding = 0;
        // Starts with the edge from the last point to the first, which closes the outline.
        let last = self.points_m.last().copied();
        let before = last.into_iter().chain(self.points_m.iter().copied());
        for (from_m, to_m) in before.zip(&self.points_m) {
            // Relative to the point, so that the decision is the same at any distance from the
            // origin.
            let from = from_m - point_m;
            let to = *to_m - point_m;
            let cross = from.perp_dot(to);
            // On the line of an edge, and between its ends: the ways to both ends point in opposite
            // directions.
            let is_on_edge = cross == 0.0 && from.dot(to) <= 0.0;
            if is_on_edge {
                return true;
            }
            // Edges that cross the ray from the point to +x, upwards and downwards.
            let crosses = (from.y > 0.0) != (to.y > 0.0);
            let is_upwards = to.y > from.y;
            // The sign of the cross product says on which side of the edge the point is. Left of an
            // upward edge means that the ray crosses it.
            if crosses && (cross > 0.0) == is_upwards {
                winding += if is_upwards { 1 } else { -1 };
            }
        }
        winding != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lane(id: &str, y_m: f64, next: &[&str]) -> Lane {
        let line = |y_m: f64| vec![[0.0, y_m, 0.0], [50.0, y_m, 0.0], [100.0, y_m, 0.0]];
        Lane {
            id: id.into(),
            kind: LaneKind::Driving,
            center: line(y_m),
            left: line(y_m + 1.75),
            right: line(y_m - 1.75),
            next: next.iter().map(|id| (*id).to_owned()).collect(),
            intersection: false,
            limit_mps: Some(13.9),
        }
    }

    #[test]
    fn points_are_in_their_lanes_edges_included() {
        let lanes = vec![lane("a", 0.0, &["b"]), lane("b", 3.5, &[])];
        let map = Map::new(MapFile::new(lanes, vec![])).unwrap();
        // The lanes are 3.5 m wide and touch at y = 1.75 m. The shared edge is in both.
        let at = |x, y| map.lanes_at(DVec2::new(x, y)).collect::<Vec<_>>();
        assert_eq!(at(10.0, 0.0), [0]);
        assert_eq!(at(10.0, 1.75), [0, 1]);
        assert_eq!(at(10.0, 5.25), [1]);
        assert_eq!(at(100.0, -1.75), [0]);
        assert!(at(100.1, 0.0).is_empty());
        assert!(!map.is_drivable(DVec2::new(10.0, 5.251)));
        let text = map.file().to_json();
        assert_eq!(MapFile::parse(text.as_bytes()).as_ref(), Ok(map.file()));
    }

    #[test]
    fn a_concave_area_excludes_its_bay() {
        let corners = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 4.0]];
        // At 1e7 m a product of two coordinates has steps of 0.016 m², so that only coordinates
        // relative to the point can decide these.
        let outline = corners.map(|[x, y]| [x + 1e7, y, 0.0]).to_vec();
        let area = Area { kind: AreaKind::Drivable, outline };
        let map = Map::new(MapFile::new(vec![], vec![area])).unwrap();
        let is_in = |x: f64, y: f64| map.is_drivable(DVec2::new(x + 1e7, y));
        assert!(is_in(0.5, 2.0) && is_in(3.5, 2.0) && is_in(2.0, 1.0) && is_in(2.0, 0.0));
        assert!(!is_in(2.0, 1.5) && !is_in(2.0, -0.001) && !is_in(4.1, 2.0));
    }

    #[test]
    fn mistakes_name_their_place() {
        let path = |file: MapFile| Map::new(file).unwrap_err().path;
        assert_eq!(path(MapFile::new(vec![lane("a", 0.0, &["c"])], vec![])), "lanes[0].next[0]");
        let twice = vec![lane("a", 0.0, &[]), lane("a", 0.0, &[])];
        assert_eq!(path(MapFile::new(twice, vec![])), "lanes[1].id");
        let mut short = lane("a", 0.0, &[]);
        short.left.truncate(1);
        assert_eq!(path(MapFile::new(vec![short], vec![])), "lanes[0].left");
        let mut far = lane("a", 0.0, &[]);
        far.right[1][2] = 1e9;
        assert_eq!(path(MapFile::new(vec![far], vec![])), "lanes[0].right[1][2]");
    }
}
