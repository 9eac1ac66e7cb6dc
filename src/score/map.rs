//! Lanes, as scores need them.

use glam::DVec2;

use wildcity_sim::contact::{Footprint, LanePosition};

use super::polyline::Polyline;

/// A lane, or an intersection, seen from above.
#[derive(Clone, Debug, PartialEq)]
pub struct Lane {
    /// Its outline, without repeating the first point. An open set: a point on the outline is not
    /// in it.
    pub outline_m: Vec<DVec2>,
    /// Its middle, in driving direction; `None` for an area, or if the record lacks it.
    pub center: Option<Polyline>,
    /// Whether it belongs to the ego's route.
    pub is_on_route: bool,
    /// Whether it is an intersection.
    pub is_intersection: bool,
}

/// A connector that is closed by a red light for some samples.
#[derive(Clone, Debug, PartialEq)]
pub struct RedArea {
    pub outline_m: Vec<DVec2>,
    /// The samples at which it is red.
    pub samples: std::ops::Range<usize>,
}

/// The road as scores use it. A point in any lane is drivable.
#[derive(Clone, Debug, PartialEq)]
pub struct LaneMap {
    pub lanes: Vec<Lane>,
    /// The middle of the lanes of the ego's route.
    pub centerline: Polyline,
    /// The areas that red lights close.
    pub red: Vec<RedArea>,
}

impl Lane {
    /// Whether a point lies within the lane.
    pub fn contains(&self, point_m: DVec2) -> bool {
        contains(&self.outline_m, point_m)
    }

    /// Whether a point lies within the lane or on its outline.
    pub(crate) fn holds(&self, point_m: DVec2) -> bool {
        side(&self.outline_m, point_m) != Side::Outside
    }

    /// The point of its outline that is nearest to a point; `None` for a lane without points.
    pub(crate) fn nearest_on_outline_m(&self, point_m: DVec2) -> Option<DVec2> {
        let on_edge = |(a, b): (DVec2, DVec2)| {
            let way = b - a;
            // The foot of the perpendicular as a share of the edge; the bound keeps an edge without
            // length from 0/0, and gives its start.
            let share = (point_m - a).dot(way) / way.length_squared().max(f64::MIN_POSITIVE);
            a + share.clamp(0.0, 1.0) * way
        };
        let distance_m = |at_m: &DVec2| at_m.distance_squared(point_m);
        edges(&self.outline_m).map(on_edge).min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)))
    }

    /// Whether the bounds of its outline meet those from `least_m` to `most_m`: a pass over its
    /// points, where each test of a point is one.
    fn is_near(&self, least_m: DVec2, most_m: DVec2) -> bool {
        let points_m = self.outline_m.iter().copied();
        let own_least_m = points_m.clone().fold(DVec2::INFINITY, DVec2::min);
        let own_most_m = points_m.fold(DVec2::NEG_INFINITY, DVec2::max);
        own_least_m.cmple(most_m).all() && own_most_m.cmpge(least_m).all()
    }

    /// The edges of its outline, as boxes without width.
    pub(crate) fn edges(&self) -> impl Iterator<Item = Footprint> {
        edges(&self.outline_m).map(|(a, b)| edge(a, b))
    }
}

impl LaneMap {
    /// The position of the corners of a box.
    pub fn position(&self, ego: &Footprint) -> LanePosition {
        let corners = ego.corners_m();
        let mut lanes_with_corners = 0;
        let mut one_holds_all = false;
        let mut in_any = [false; 4];
        // Bounds of the corners reject most lanes before any point is tested.
        let least_m = corners.into_iter().fold(DVec2::INFINITY, DVec2::min);
        let most_m = corners.into_iter().fold(DVec2::NEG_INFINITY, DVec2::max);
        for lane in self.lanes.iter().filter(|lane| lane.is_near(least_m, most_m)) {
            // A corner on an outline is in neither of two adjacent lanes.
            let inside = corners.map(|corner| lane.contains(corner));
            let count = inside.iter().filter(|&&inside| inside).count();
            // More than one lane has corners, and none has all four: the box straddles.
            lanes_with_corners += usize::from(count > 0);
            one_holds_all |= count == 4;
            for (any, inside) in in_any.iter_mut().zip(inside) {
                *any |= inside;
            }
        }
        LanePosition {
            in_multiple_lanes: lanes_with_corners > 1 && !one_holds_all,
            // A corner in no lane is off the road.
            off_drivable: in_any.contains(&false),
        }
    }

    /// Whether a point lies neither in a lane of the route nor in an intersection.
    pub fn is_off_route(&self, point_m: DVec2) -> bool {
        let accepted = |lane: &&Lane| lane.is_on_route || lane.is_intersection;
        !self.lanes.iter().filter(accepted).any(|lane| lane.contains(point_m))
    }

    /// Whether a point lies in an intersection.
    pub fn is_in_intersection(&self, point_m: DVec2) -> bool {
        self.lanes.iter().any(|lane| lane.is_intersection && lane.contains(point_m))
    }

    /// Whether a box touches an area that is red at a sample.
    pub fn touches_red(&self, ego: &Footprint, sample: usize) -> bool {
        let is_red = |area: &&RedArea| area.samples.contains(&sample);
        self.red.iter().filter(is_red).any(|area| touches(&area.outline_m, ego))
    }
}

/// The position of a point relative to an outline.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Side {
    Inside,
    OnOutline,
    Outside,
}

/// Whether a point lies strictly within an outline, without the outline itself.
fn contains(outline_m: &[DVec2], point_m: DVec2) -> bool {
    side(outline_m, point_m) == Side::Inside
}

/// The position of a point relative to an outline, by the even-odd rule.
fn side(outline_m: &[DVec2], point_m: DVec2) -> Side {
    // A ray to the right; each edge that it crosses changes the side.
    let mut inside = false;
    for (a, b) in edges(outline_m) {
        // Most edges lie above the point or below it.
        if a.y.min(b.y) > point_m.y || a.y.max(b.y) < point_m.y {
            continue;
        }
        if is_on_edge(a, b, point_m) {
            return Side::OnOutline;
        }
        let across = (b - a).perp_dot(point_m - a);
        // Half-open in y: a vertex belongs to one of its two edges, so that a ray through it counts
        // once.
        let crosses = (a.y > point_m.y) != (b.y > point_m.y);
        // Whether the crossing is to the right of the point, by the sign of the cross product and
        // not by a division.
        if crosses && (across > 0.0) == (b.y > a.y) {
            inside = !inside;
        }
    }
    if inside { Side::Inside } else { Side::Outside }
}

/// Whether a box and an outline have a point in common; both are closed sets.
fn touches(outline_m: &[DVec2], ego: &Footprint) -> bool {
    // A box that lies within has no edge in common, and an outline within the box has.
    let corner_inside = ego.corners_m().into_iter().any(|corner| contains(outline_m, corner));
    let edge_touches = edges(outline_m).any(|(a, b)| ego.touches(&edge(a, b)));
    corner_inside || edge_touches
}

fn is_on_edge(a: DVec2, b: DVec2, point_m: DVec2) -> bool {
    let across = (b - a).perp_dot(point_m - a);
    // The two vectors to the ends point apart exactly between them.
    let beside = (point_m - a).dot(point_m - b);
    across == 0.0 && beside <= 0.0
}

/// An edge as a box without width.
fn edge(a: DVec2, b: DVec2) -> Footprint {
    let way = b - a;
    Footprint {
        center_m: 0.5 * (a + b),
        forward: way.try_normalize().unwrap_or(DVec2::X),
        length_m: way.length(),
        width_m: 0.0,
    }
}

fn edges(outline_m: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> {
    let next = |k: usize| if k + 1 == outline_m.len() { 0 } else { k + 1 };
    (0..outline_m.len()).map(move |k| (outline_m[k], outline_m[next(k)]))
}
