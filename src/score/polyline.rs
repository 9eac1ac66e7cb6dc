//! Lines on the ground.

use glam::DVec2;

/// A line through points on the ground, with the station of each: its distance from the start along
/// the line.
#[derive(Clone, Debug, PartialEq)]
pub struct Polyline {
    points_m: Vec<DVec2>,
    stations_m: Vec<f64>,
}

/// The point of a line that is nearest to a given point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// Its station, in metres.
    pub station_m: f64,
    /// Its distance from the given point, in metres.
    pub distance_m: f64,
    /// Unit vector along the line at this point; zero on a line of one point.
    pub along: DVec2,
    /// Distance to the left of the line, in metres: negative to its right.
    pub left_m: f64,
}

impl Polyline {
    /// A line through points; `None` without a point.
    pub fn new(points_m: Vec<DVec2>) -> Option<Self> {
        if points_m.is_empty() {
            return None;
        }
        let mut station_m = 0.0;
        let steps = points_m.windows(2).map(|pair| {
            station_m += pair[0].distance(pair[1]);
            station_m
        });
        let stations_m = std::iter::once(0.0).chain(steps).collect();
        Some(Self { points_m, stations_m })
    }

    /// Its corners in order, in metres.
    pub fn points_m(&self) -> &[DVec2] {
        &self.points_m
    }

    /// Stations of its points, in metres.
    pub fn stations_m(&self) -> &[f64] {
        &self.stations_m
    }

    /// Its length, in metres.
    pub fn length_m(&self) -> f64 {
        self.stations_m[self.stations_m.len() - 1]
    }

    /// The point at a station, and the unit vector along the line at this point; beyond the ends,
    /// those of the end. The vector is zero on a line of one point.
    pub fn at(&self, station_m: f64) -> (DVec2, DVec2) {
        let last = self.points_m.len() - 1;
        // The segment that ends at or after the station, clamped to an existing one. `last` is 0
        // for a line of one point.
        let after =
            self.stations_m.partition_point(|&at_m| at_m < station_m).clamp(1.min(last), last);
        // Points that coincide have no direction between them: use the direction of the next points
        // that differ, or of the previous ones.
        let differs = |k: &usize| self.stations_m[*k] > self.stations_m[*k - 1];
        let onward = (after.max(1)..=last).find(differs);
        let Some(to) = onward.or_else(|| (1..=after).rev().find(differs)) else {
            return (self.points_m[0], DVec2::ZERO);
        };
        let from = to - 1;
        // Above 0, because the two stations differ.
        let length_m = self.stations_m[to] - self.stations_m[from];
        let t = ((station_m - self.stations_m[from]) / length_m).clamp(0.0, 1.0);
        let a = self.points_m[from];
        let b = self.points_m[to];
        (a.lerp(b, t), (b - a) / length_m)
    }

    /// The nearest point of the line.
    pub fn project(&self, point_m: DVec2) -> Projection {
        self.project_between(point_m, f64::NEG_INFINITY, f64::INFINITY)
    }

    /// The nearest point of the segments that reach into a range of stations. So an ego on a route
    /// that crosses itself stays on its own branch.
    pub fn project_between(&self, point_m: DVec2, from_m: f64, to_m: f64) -> Projection {
        // Stations of the found segment may lie outside of the range; only the segment must reach
        // into it.
        let first = self.points_m[0];
        let alone = Projection {
            station_m: 0.0,
            distance_m: first.distance(point_m),
            along: DVec2::ZERO,
            left_m: 0.0,
        };
        // Linear in the number of points; the range skips most of them before any arithmetic.
        let mut nearest: Option<Projection> = None;
        for k in 1..self.points_m.len() {
            if self.stations_m[k] < from_m || self.stations_m[k - 1] > to_m {
                continue;
            }
            let start = self.points_m[k - 1];
            let way = self.points_m[k] - start;
            let Some(along) = way.try_normalize() else { continue };
            let ahead_m = (point_m - start).dot(along).clamp(0.0, way.length());
            let distance_m = (start + ahead_m * along).distance(point_m);
            // Strictly nearer: of equal places the first one stays.
            if nearest.is_none_or(|nearest| distance_m < nearest.distance_m) {
                let station_m = self.stations_m[k - 1] + ahead_m;
                let left_m = along.perp().dot(point_m - start);
                nearest = Some(Projection { station_m, distance_m, along, left_m });
            }
        }
        nearest.unwrap_or(alone)
    }
}
