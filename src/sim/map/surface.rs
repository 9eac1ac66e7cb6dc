//! The surface of lanes: the ground where no recorded drive is near.

use glam::{DVec2, DVec3};

use super::file::{Lane, LaneKind};
use crate::plane::Plane;

/// Horizontal length below which two points have no direction, in metres.
const DIRECTION_M: f64 = 1e-6;

/// The surface of lanes: their middle lines, each point with the normal of the road there.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LaneSurface {
    lines: Vec<SurfaceLine>,
}

/// The middle line of a lane.
#[derive(Clone, Debug, PartialEq)]
struct SurfaceLine {
    points: Vec<SurfacePoint>,
    min_m: DVec3,
    max_m: DVec3,
}

/// A point of a road.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Where it is, in metres in the world.
    pub position_m: DVec3,
    /// Unit normal of the road.
    pub up: DVec3,
}

impl LaneSurface {
    /// The surface of the lanes for vehicles among these.
    pub(super) fn from_driving_lanes(lanes: &[Lane]) -> Self {
        Self::from_lanes(lanes.iter().filter(|lane| lane.kind == LaneKind::Driving))
    }

    /// The surface of some lanes.
    pub(super) fn from_lanes<'a>(lanes: impl Iterator<Item = &'a Lane>) -> Self {
        Self::from_lines(lanes.map(surface_points))
    }

    /// The surface of middle lines, each of points in driving direction.
    pub fn from_lines(lines: impl IntoIterator<Item = Vec<SurfacePoint>>) -> Self {
        Self { lines: lines.into_iter().map(SurfaceLine::new).collect() }
    }

    /// The middle lines of the lanes, with the normal of the road at each point.
    pub fn lines(&self) -> impl Iterator<Item = &[SurfacePoint]> {
        self.lines.iter().map(|line| line.points.as_slice())
    }

    /// The tangent plane at the place of a middle line that is nearest to a point in 3D, if one is
    /// nearer than `within_m`.
    pub(crate) fn plane_near(&self, point_m: DVec3, within_m: f64) -> Option<Plane> {
        let mut nearest_m = within_m;
        let mut plane = None;
        for line in &self.lines {
            // The distance to the box is a lower bound for that to the line, so most lanes are
            // skipped without a look at their points.
            if line.box_distance_m(point_m) >= nearest_m {
                continue;
            }
            for pair in line.points.windows(2) {
                let from = pair[0];
                let to = pair[1];
                let way_m = to.position_m - from.position_m;
                // The parameter of the foot of the perpendicular, clamped to the segment. The
                // minimum of 1e-12 m² makes a segment without length a point.
                let along =
                    (point_m - from.position_m).dot(way_m) / way_m.length_squared().max(1e-12);
                let t = along.clamp(0.0, 1.0);
                let there_m = from.position_m + t * way_m;
                let distance_m = there_m.distance(point_m);
                if distance_m < nearest_m {
                    nearest_m = distance_m;
                    // Interpolated, so that a car does not tilt at once where two segments meet.
                    let between = from.up.lerp(to.up, t);
                    // Normals of a flat road stay exact.
                    let up = if from.up == to.up { from.up } else { between.normalize() };
                    plane = Some(Plane { point_m: there_m, up });
                }
            }
        }
        plane
    }
}

impl SurfaceLine {
    fn new(points: Vec<SurfacePoint>) -> Self {
        let positions = || points.iter().map(|point| point.position_m);
        let min_m = positions().fold(DVec3::INFINITY, DVec3::min);
        let max_m = positions().fold(DVec3::NEG_INFINITY, DVec3::max);
        Self { points, min_m, max_m }
    }

    fn box_distance_m(&self, point_m: DVec3) -> f64 {
        point_m.distance(point_m.clamp(self.min_m, self.max_m))
    }
}

/// The middle line of a lane with the normals of its road.
///
/// The normal is perpendicular to the way ahead and to the way from the right edge to the left one.
/// The edges are compared at equal shares of their lengths.
fn surface_points(lane: &Lane) -> Vec<SurfacePoint> {
    let center: Vec<DVec3> = lane.center.iter().map(|point| DVec3::from_array(*point)).collect();
    let left = Edge::new(&lane.left);
    let right = Edge::new(&lane.right);
    // By share and not by index: edges may have other numbers of points than the middle.
    let shares = length_shares(&center);
    let last = center.len() - 1;
    let points = center.iter().zip(shares).enumerate();
    points
        .map(|(index, (position_m, share))| {
            // The central difference; at an end of the line, the only segment there.
            let ahead = center[(index + 1).min(last)] - center[index.saturating_sub(1)];
            let across = left.at(share) - right.at(share);
            SurfacePoint { position_m: *position_m, up: normal(ahead, across) }
        })
        .collect()
}

/// The upward unit normal to two directions. Where one of them has no horizontal part, or both are
/// parallel, that of a road that is level across.
fn normal(ahead: DVec3, across: DVec3) -> DVec3 {
    let is_direction = |way_m: DVec3| way_m.truncate().length() > DIRECTION_M;
    if !is_direction(ahead) {
        return DVec3::Z;
    }
    let level = DVec3::new(-ahead.y, ahead.x, 0.0);
    let across = if is_direction(across) { across } else { level };
    let normal = ahead.cross(across);
    // Edges that are swapped or vertical give a normal that points down or sideways.
    let up = if is_upright(normal) { normal } else { ahead.cross(level) };
    // Exactly vertical on a flat road, so that poses on it stay as they are.
    if up.x == 0.0 && up.y == 0.0 { DVec3::Z } else { up.normalize() }
}

/// Whether a normal points upwards, from a plane that is no wall.
fn is_upright(up: DVec3) -> bool {
    up.z > crate::limits::GROUND_UP * up.length()
}

/// An edge of a lane.
struct Edge {
    points_m: Vec<DVec3>,
    shares: Vec<f64>,
}

impl Edge {
    fn new(points: &[[f64; 3]]) -> Self {
        let points_m: Vec<DVec3> = points.iter().map(|point| DVec3::from_array(*point)).collect();
        let shares = length_shares(&points_m);
        Self { points_m, shares }
    }

    /// The point at a share of the length.
    fn at(&self, share: f64) -> DVec3 {
        // The format demands two points of an edge, so there is a segment.
        let last = self.points_m.len() - 2;
        let after = self.shares.partition_point(|&before| before <= share);
        // The segment that begins at or before the share. At a share of 1 it is the last one.
        let segment = after.saturating_sub(1).min(last);
        let from = self.shares[segment];
        let to = self.shares[segment + 1];
        // A segment without length has equal shares, and its first point is taken.
        let t = ((share - from) / (to - from).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        self.points_m[segment].lerp(self.points_m[segment + 1], t)
    }
}

/// The share of a line's horizontal length up to each point; 0 throughout for a line without
/// length.
fn length_shares(points_m: &[DVec3]) -> Vec<f64> {
    let flat = |point_m: &DVec3| DVec2::new(point_m.x, point_m.y);
    let mut length_m = 0.0;
    let mut shares = vec![0.0];
    for pair in points_m.windows(2) {
        length_m += flat(&pair[0]).distance(flat(&pair[1]));
        shares.push(length_m);
    }
    if length_m > 0.0 {
        shares.iter_mut().for_each(|share| *share /= length_m);
    }
    shares
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A lane along x of 100 m that climbs by `climb` and falls to the right by `cross`, in m per
    /// m.
    fn lane(climb: f64, cross: f64) -> Lane {
        let line = |y_m: f64, xs_m: &[f64]| {
            xs_m.iter().map(|x_m| [*x_m, y_m, climb * x_m + cross * y_m]).collect::<Vec<_>>()
        };
        Lane {
            id: "a".into(),
            kind: LaneKind::Driving,
            center: line(0.0, &[0.0, 30.0, 60.0, 100.0]),
            // The edges have other points than the middle.
            left: line(1.75, &[0.0, 100.0]),
            right: line(-1.75, &[0.0, 10.0, 20.0, 100.0]),
            next: Vec::new(),
            intersection: false,
            limit_mps: None,
        }
    }

    #[test]
    fn a_plane_road_has_its_plane_everywhere() {
        let surface = LaneSurface::from_driving_lanes(&[lane(0.08, 0.025)]);
        // The plane is z = 0.08 x + 0.025 y, whose gradient is (0.08, 0.025).
        let wanted = DVec3::new(-0.08, -0.025, 1.0).normalize();
        // Beside the lane on both sides, and beyond its end, where the nearest point is the last
        // one.
        for point_m in [DVec3::new(45.0, 6.0, 3.0), DVec3::new(0.0, -9.0, 0.0), DVec3::X * 104.0] {
            let plane = surface.plane_near(point_m, 25.0).unwrap();
            assert!((plane.up - wanted).length() < 1e-12, "{}", plane.up);
            let height_m = 0.08 * plane.point_m.x;
            assert!((plane.point_m.z - height_m).abs() < 1e-12, "{}", plane.point_m);
        }
        assert!(surface.plane_near(DVec3::new(45.0, 0.0, 40.0), 25.0).is_none());
    }

    #[test]
    fn a_flat_road_is_exactly_flat() {
        let surface = LaneSurface::from_driving_lanes(&[lane(0.0, 0.0)]);
        let plane = surface.plane_near(DVec3::new(41.3, 2.0, 0.3), 25.0).unwrap();
        assert_eq!((plane.up, plane.point_m.z), (DVec3::Z, 0.0));
    }

    #[test]
    fn the_normal_turns_from_point_to_point_over_a_crest() {
        let mut crest = lane(0.0, 0.0);
        for line in [&mut crest.center, &mut crest.left, &mut crest.right] {
            let y_m = line[0][1];
            *line = [0.0, 50.0, 100.0]
                .map(|x_m: f64| [x_m, y_m, 5.0 - (x_m - 50.0).abs() / 10.0])
                .to_vec();
        }
        let surface = LaneSurface::from_driving_lanes(&[crest]);
        let pitch = |x_m: f64| {
            let point_m = DVec3::new(x_m, 0.0, 5.0 - (x_m - 50.0).abs() / 10.0);
            let plane = surface.plane_near(point_m, 25.0).unwrap();
            -plane.up.x / plane.up.z
        };
        // The slope is 1/10 up to x = 50 m and -1/10 from there. At the crest the central
        // difference is level.
        assert!((pitch(0.0) - 0.1).abs() < 1e-12 && (pitch(100.0) + 0.1).abs() < 1e-12);
        assert_eq!(pitch(50.0), 0.0);
        // 0.2 m around the crest, on segments of 50 m: the pitch changes by 0.1 · 0.2 / 50 = 4e-4.
        assert!((pitch(49.9) - pitch(50.1)).abs() < 1e-3);
    }

    /// Sidewalks are higher than the road, and lanes may have no width or length.
    #[test]
    fn sidewalks_are_no_road_and_degenerate_lanes_are_level_across() {
        let sidewalk = Lane { kind: LaneKind::Sidewalk, ..lane(0.0, 0.0) };
        assert_eq!(LaneSurface::from_driving_lanes(&[sidewalk]), LaneSurface::default());
        let wide = lane(0.08, 0.0);
        let narrow = Lane { left: wide.center.clone(), right: wide.center.clone(), ..wide };
        let plane =
            LaneSurface::from_lanes([narrow].iter()).plane_near(DVec3::X * 50.0, 25.0).unwrap();
        assert!((plane.up - DVec3::new(-0.08, 0.0, 1.0).normalize()).length() < 1e-12);
        let place = vec![[1.0, 2.0, 3.0]; 2];
        let spot =
            Lane { center: place.clone(), left: place.clone(), right: place, ..lane(0.0, 0.0) };
        let plane = LaneSurface::from_lanes([spot].iter()).plane_near(DVec3::ZERO, 25.0).unwrap();
        assert_eq!((plane.point_m, plane.up), (DVec3::new(1.0, 2.0, 3.0), DVec3::Z));
    }
}
