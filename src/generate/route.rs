//! The street's centre line, and the drive along it.

use glam::{DQuat, DVec3};

use crate::geometry::Pose;
use crate::scene::Trajectory;
use crate::scene::trajectory::Keyframe;

/// How far the street goes on beyond both ends of the drive, in metres.
pub(super) const BEYOND_M: f64 = 80.0;

/// Distance between keyframes, in metres.
const KEYFRAME_M: f64 = 0.5;
/// Time between keyframes: 0.5 m at 10 m/s, in microseconds.
const KEYFRAME_US: i64 = 50_000;
/// Arc length between nodes of the table, in metres.
const NODE_M: f64 = 0.25;
/// The street swings this far to both sides of east, in radians (17°) ...
const SWING_RAD: f64 = 0.30;
/// ... and is back after this length, in metres: the tightest radius is `260 / (2π 0.30)` = 138 m,
/// which hides both ends of the street from nearly everywhere on it.
const SWING_PERIOD_M: f64 = 260.0;

/// An S of constant width in the plane z = 0, by arc length `s` in metres.
///
/// The heading is `0.30 sin(2π s / 260)` rad from east; the position is its integral.
#[derive(Clone, Debug)]
pub(super) struct Route {
    /// Length of the part that is driven, in metres.
    pub(super) length_m: f64,
    first_s_m: f64,
    nodes_m: Vec<DVec3>,
}

/// A point of the centre line with its directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Station {
    /// Where, in metres.
    pub(super) point_m: DVec3,
    /// Unit, along the street.
    pub(super) forward: DVec3,
    /// Unit, to the left of it.
    pub(super) left: DVec3,
}

impl Station {
    /// A point beside the centre line: `t_m` to the left, `z_m` above the road.
    pub(super) fn beside(&self, t_m: f64, z_m: f64) -> DVec3 {
        self.point_m + t_m * self.left + z_m * DVec3::Z
    }
}

impl Route {
    /// The centre line of a street on which `length_m` are driven.
    pub(super) fn new(length_m: f64) -> Self {
        // Midpoint rule; one segment of slack on either side for `at` beyond the ends.
        let first_s_m = -(BEYOND_M + 40.0);
        let count = ((length_m - 2.0 * first_s_m) / NODE_M) as usize;
        let mut nodes_m = vec![DVec3::ZERO; count + 1];
        for i in 0..count {
            let middle_m = first_s_m + (i as f64 + 0.5) * NODE_M;
            nodes_m[i + 1] = nodes_m[i] + NODE_M * direction(middle_m);
        }
        let origin_m = nodes_m[(-first_s_m / NODE_M) as usize];
        for node_m in &mut nodes_m {
            *node_m -= origin_m;
        }
        Self { length_m, first_s_m, nodes_m }
    }

    /// The centre line at arc length `s_m`, clamped to the table.
    pub(super) fn at(&self, s_m: f64) -> Station {
        let last = (self.nodes_m.len() - 1) as f64;
        let node = ((s_m - self.first_s_m) / NODE_M).floor().clamp(0.0, last);
        let node_s_m = self.first_s_m + node * NODE_M;
        let rest_m = s_m - node_s_m;
        let point_m = self.nodes_m[node as usize] + rest_m * direction(node_s_m + 0.5 * rest_m);
        let forward = direction(s_m);
        Station { point_m, forward, left: DVec3::new(-forward.y, forward.x, 0.0) }
    }

    /// How far beyond the driven part a station lies, in metres; 0 on it.
    pub(super) fn beyond_m(&self, s_m: f64) -> f64 {
        (s_m - s_m.clamp(0.0, self.length_m)).abs()
    }

    /// The arc length whose cross-section holds a point, and how far left of the centre line the
    /// point lies there, both in metres. For points within about 100 m of the line.
    pub(super) fn project(&self, point_m: DVec3) -> (f64, f64) {
        // Coarse search over the table, then Newton steps on the offset along the line.
        let squared_m2 = |node: &DVec3| (node.x - point_m.x).powi(2) + (node.y - point_m.y).powi(2);
        let nearest = (0..self.nodes_m.len())
            .step_by(16)
            .min_by(|&a, &b| squared_m2(&self.nodes_m[a]).total_cmp(&squared_m2(&self.nodes_m[b])))
            .unwrap_or(0);
        let mut s_m = self.first_s_m + nearest as f64 * NODE_M;
        for _ in 0..3 {
            let station = self.at(s_m);
            let offset_m = point_m - station.point_m;
            let shrink = 1.0 - curvature_per_m(s_m) * offset_m.dot(station.left);
            s_m += offset_m.dot(station.forward) / shrink.max(0.3);
        }
        (s_m, (point_m - self.at(s_m).point_m).dot(self.at(s_m).left))
    }

    /// Drives the lane `t_m` to the left of the centre line at 10 m/s, from `start_s_m` to as far
    /// before the route's end.
    pub(super) fn drive(&self, name: &str, t_m: f64, start_s_m: f64) -> Trajectory {
        let mut keyframes = Vec::new();
        let mut s_m = start_s_m;
        while s_m <= self.length_m - start_s_m {
            let station = self.at(s_m);
            keyframes.push(Keyframe {
                time_us: KEYFRAME_US * keyframes.len() as i64,
                world_from_rig: Pose {
                    position_m: station.beside(t_m, 0.0),
                    rotation: DQuat::from_rotation_z(heading_rad(s_m)),
                },
            });
            // A lane t to the left of a line of curvature k is (1 - k t) as long as the line.
            let half_m = 0.5 * KEYFRAME_M;
            s_m += KEYFRAME_M / (1.0 - curvature_per_m(s_m + half_m) * t_m);
        }
        Trajectory { name: name.into(), keyframes }
    }
}

/// Angle from east at arc length `s_m`, counter-clockwise.
fn heading_rad(s_m: f64) -> f64 {
    SWING_RAD * (std::f64::consts::TAU * s_m / SWING_PERIOD_M).sin()
}

/// Derivative of the heading; positive turns left.
fn curvature_per_m(s_m: f64) -> f64 {
    let rate_per_m = std::f64::consts::TAU / SWING_PERIOD_M;
    SWING_RAD * rate_per_m * (rate_per_m * s_m).cos()
}

fn direction(s_m: f64) -> DVec3 {
    let (sin, cos) = heading_rad(s_m).sin_cos();
    DVec3::new(cos, sin, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arc_length_is_a_length_and_the_tangent_a_derivative() {
        let route = Route::new(300.0);
        assert_eq!(route.at(0.0).point_m, DVec3::ZERO);
        for i in -100..700 {
            let s_m = 0.5 * f64::from(i) + 0.1;
            let (before, after) = (route.at(s_m - 0.05), route.at(s_m + 0.05));
            let step_m = after.point_m - before.point_m;
            assert!((step_m.length() - 0.1).abs() < 1e-6, "at {s_m}");
            assert!((step_m / 0.1 - route.at(s_m).forward).length() < 1e-4, "at {s_m}");
        }
    }

    #[test]
    fn project_inverts_beside() {
        let route = Route::new(300.0);
        for (s_m, t_m) in [(3.0, 2.0), (65.0, -9.0), (151.3, 12.0), (299.0, -30.0)] {
            let (s_back_m, t_back_m) = route.project(route.at(s_m).beside(t_m, 1.0));
            assert!((s_back_m - s_m).abs() < 1e-3 && (t_back_m - t_m).abs() < 1e-3, "{s_m} {t_m}");
        }
    }

    #[test]
    fn the_drive_has_even_keyframes_that_face_ahead() {
        let drive = Route::new(300.0).drive("log", -1.75, 8.0);
        assert!(drive.length_m() > 250.0, "{} m", drive.length_m());
        assert_eq!(drive.check(), Ok(()));
        for pair in drive.keyframes.windows(2) {
            let [from, to] = [pair[0].world_from_rig, pair[1].world_from_rig];
            let step_m = to.position_m - from.position_m;
            assert!((step_m.length() - 0.5).abs() < 1e-3, "{step_m}");
            assert!((step_m.normalize() - from.rotation * DVec3::X).length() < 3e-3);
            assert_eq!(pair[1].time_us - pair[0].time_us, 50_000);
        }
    }
}
