//! The recorded drive ahead of the ego, in the plane of the ground.

use glam::{DVec2, DVec3};

use wildcity_scene::geometry::Pose;

use crate::wire::common::Vec3;

/// Number of waypoints of a route, and their reach, as AlpaSim sends them.
const WAYPOINTS: usize = 20;
const AHEAD_M: f64 = 80.0;

/// Search range of the next station around the last one, because a drive may cross itself.
const NEAR_M: f64 = 40.0;

/// The polyline through the poses of a recorded drive.
pub(super) struct Route {
    points: Vec<DVec2>,
    stations_m: Vec<f64>,
    /// Station of the point that was nearest to the ego.
    at_m: Option<f64>,
}

impl Route {
    /// A route through positions with their stations along the drive.
    pub(super) fn new(points: impl Iterator<Item = (f64, [f64; 3])>) -> Self {
        let (stations_m, points) =
            points.map(|(station_m, [x, y, _])| (station_m, DVec2::new(x, y))).unzip();
        Self { points, stations_m, at_m: None }
    }

    /// 20 points of the drive from where the ego is to 80 m ahead, in the rig frame, at height 0.
    /// After the end of the drive they continue straight, because a driver stops at the end of a
    /// route.
    pub(super) fn ahead(&mut self, world_from_rig: &Pose) -> Vec<Vec3> {
        let ego = world_from_rig.position_m.truncate();
        // The search continues from the place of the call before, so that the ego stays on its
        // branch where a drive crosses itself.
        let at_m = self.nearest_m(ego);
        self.at_m = Some(at_m);
        let forward = (world_from_rig.rotation * DVec3::X).truncate().normalize_or(DVec2::X);
        let left = forward.perp();
        // 20 points have 19 gaps of 4.21 m.
        let spacing_m = AHEAD_M / (WAYPOINTS - 1) as f64;
        let stations_m = (0..WAYPOINTS).map(|k| at_m + k as f64 * spacing_m);
        stations_m
            .map(|station_m| {
                // From the world to the rig in the plane: x is along `forward`, and y along `left`.
                let offset = self.at(station_m) - ego;
                let x = offset.dot(forward) as f32;
                let y = offset.dot(left) as f32;
                Vec3 { x, y, z: 0.0 }
            })
            .collect()
    }

    /// Station of the nearest point of the polyline.
    fn nearest_m(&self, ego: DVec2) -> f64 {
        // By both ends: the segment that holds the last station is near, however long it is.
        let is_near = |stations_m: &[f64]| {
            self.at_m
                .is_none_or(|at_m| stations_m[0] - NEAR_M <= at_m && at_m <= stations_m[1] + NEAR_M)
        };
        let segments = self.points.windows(2).zip(self.stations_m.windows(2));
        let nearest = segments
            .filter(|(_, stations_m)| is_near(stations_m))
            .map(|(points, stations_m)| {
                let along = points[1] - points[0];
                // The foot of the perpendicular, as a share of the segment, and clamped to its
                // ends. A segment of length 0 gives its first point.
                let t = ((ego - points[0]).dot(along) / along.length_squared().max(1e-12))
                    .clamp(0.0, 1.0);
                let distance_m = (points[0] + t * along).distance(ego);
                (distance_m, stations_m[0] + t * (stations_m[1] - stations_m[0]))
            })
            .min_by(|a, b| a.0.total_cmp(&b.0));
        nearest.map_or(0.0, |(_, station_m)| station_m)
    }

    /// The point at a station; straight on beyond the ends.
    fn at(&self, station_m: f64) -> DVec2 {
        let last = self.points.len() - 1;
        // The segment [after - 1, after] holds the station. The clamp takes the first or the last
        // segment for stations outside, which the line below then extends. A drive has two points
        // or more.
        let after = self.stations_m.partition_point(|&s_m| s_m < station_m).clamp(1, last);
        let from = self.points[after - 1];
        let to = self.points[after];
        let length_m = self.stations_m[after] - self.stations_m[after - 1];
        from + (to - from) * ((station_m - self.stations_m[after - 1]) / length_m.max(1e-9))
    }
}

/// The 20 points of a scenario's route, which are in the rig frame and have the same distances, at
/// height 0. A shorter route is extended straight.
pub(super) fn waypoints(points: &[[f64; 3]]) -> Vec<Vec3> {
    let mut ahead: Vec<DVec2> = points.iter().map(|&[x, y, _]| DVec2::new(x, y)).collect();
    let direction = match ahead.as_slice() {
        // Fewer than two points have no direction: straight ahead of the ego.
        [.., before, last] => (*last - *before).normalize_or(DVec2::X),
        _ => DVec2::X,
    };
    let spacing_m = AHEAD_M / (WAYPOINTS - 1) as f64;
    while ahead.len() < WAYPOINTS {
        let next = ahead.last().map_or(DVec2::ZERO, |last| *last + spacing_m * direction);
        ahead.push(next);
    }
    ahead.iter().map(|point| Vec3 { x: point.x as f32, y: point.y as f32, z: 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_route_that_ends_goes_straight_on() {
        // Two points to the left of the ego: the last of 20 is 19 gaps, 80 m, beyond the first at y
        // = 1.
        let spacing_m = 80.0 / 19.0;
        let ahead = waypoints(&[[0.0, 1.0, 2.0], [0.0, 1.0 + spacing_m, 2.0]]);
        assert_eq!(ahead.len(), 20);
        assert!(ahead.iter().all(|point| point.x == 0.0 && point.z == 0.0));
        assert!((ahead[19].y - 81.0).abs() < 1e-4, "{ahead:?}");
        assert_eq!(waypoints(&[])[1].x, spacing_m as f32);
    }

    #[test]
    fn the_route_is_ahead_of_the_ego_and_goes_straight_on() {
        let mut route = Route::new((0..=10).map(|k| (f64::from(k), [f64::from(k), 0.0, 5.0])));
        // A drive of 10 m along x. The ego is beside its station 4, 1 m to the left, and looks
        // along y.
        let yaw = std::f64::consts::FRAC_PI_2;
        let pose = Pose {
            position_m: DVec3::new(4.0, 1.0, 5.0),
            rotation: glam::DQuat::from_rotation_z(yaw),
        };
        let ahead = route.ahead(&pose);
        assert_eq!(ahead.len(), 20);
        // The drive goes to the right of an ego that looks to the left, and begins 1 m behind it.
        assert!((ahead[0].x + 1.0).abs() < 1e-6 && ahead[0].y.abs() < 1e-6, "{ahead:?}");
        assert!((ahead[19].y + 80.0).abs() < 1e-4, "{ahead:?}");
    }

    #[test]
    fn a_route_of_far_keyframes_goes_on_from_the_last_station() {
        // A segment of 200 m: at its station 150 both of its ends are farther than `NEAR_M`.
        let mut route =
            Route::new((0..=2).map(|k| (200.0 * f64::from(k), [200.0 * f64::from(k), 0.0, 0.0])));
        for x_m in [100.0, 150.0, 160.0] {
            let pose = Pose { position_m: DVec3::new(x_m, 0.0, 0.0), ..Pose::IDENTITY };
            let ahead = route.ahead(&pose);
            assert!(ahead[0].x.abs() < 1e-4, "{x_m}: {ahead:?}");
        }
    }
}
