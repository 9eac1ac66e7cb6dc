//! The street's centre line, and the drive along it.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3};

use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;

/// Length of the street beyond both ends of the drive, in metres.
pub(super) const BEYOND_M: f64 = 80.0;

/// Spacing of keyframes, in metres.
const KEYFRAME_M: f64 = 0.5;
/// Speed of the recorded drive of a street, in m/s.
const SPEED_M_S: f64 = 10.0;
/// Distance of the drive from both ends of the driven part, in metres.
const INDENT_M: f64 = 8.0;
/// Length of the centre line's table beyond the houses, in metres.
const SLACK_M: f64 = 40.0;
/// Arc length between nodes of the table, in metres.
const NODE_M: f64 = 0.25;
/// Largest angle between the street and east, to both sides, in radians (17°).
const SWING_RAD: f64 = 0.30;
/// Period of the street's bends, in metres: the smallest radius is `260 / (2π 0.30)` = 138 m, which
/// hides both ends of the street from nearly every point of it.
const SWING_PERIOD_M: f64 = 260.0;

/// A street of constant width in the plane z = 0, by arc length `s` in metres.
#[derive(Clone, Debug)]
pub(super) struct Route {
    /// Start and end of the part that is driven, in metres along the route.
    pub(super) driven_m: [f64; 2],
    /// Start and end of the part with houses, in metres along the route: the driven part, or more.
    pub(super) ends_m: [f64; 2],
    /// Whether a house across the street closes the view at either end.
    pub(super) closed: [bool; 2],
    bends: Bends,
    first_s_m: f64,
    nodes_m: Vec<DVec3>,
}

/// The bends of a street. Its heading from east is `0.30 sin(2π s / 260)` rad plus the additional
/// waves; its position is the integral.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Bends {
    /// Additional waves of the heading.
    pub(super) wide: [Wave; 2],
}

/// A sine wave of the heading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Wave {
    /// Largest turn of the heading to either side, in radians.
    pub(super) swing_rad: f64,
    /// Arc length of a whole wave, in metres.
    pub(super) period_m: f64,
    /// Phase at s = 0, in radians.
    pub(super) phase_rad: f64,
}

/// A point of the centre line with its directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Station {
    /// Its position, in metres.
    pub(super) point_m: DVec3,
    /// Unit, along the street.
    pub(super) forward: DVec3,
    /// Unit, to the left of it.
    pub(super) left: DVec3,
}

impl Station {
    /// A point `t_m` to the left of the centre line and `z_m` above the road.
    pub(super) fn beside(&self, t_m: f64, z_m: f64) -> DVec3 {
        self.point_m + t_m * self.left + z_m * DVec3::Z
    }
}

impl Route {
    /// The centre line of a street on which `length_m` are driven, from the origin to the east.
    pub(super) fn new(length_m: f64) -> Self {
        let ends_m = [-BEYOND_M, length_m + BEYOND_M];
        let line = Self::line(Bends::default(), ends_m, 0.0, DVec3::ZERO);
        Self { driven_m: [0.0, length_m], closed: [true; 2], ..line }
    }

    /// The centre line from station to station, both multiples of 0.25 m, all of it driven and open
    /// at both ends; at station `at_s_m`, a multiple too, it passes `at_m`.
    pub(super) fn line(bends: Bends, ends_m: [f64; 2], at_s_m: f64, at_m: DVec3) -> Self {
        // Midpoint rule; one segment of slack on either side for `at` beyond the ends.
        let first_s_m = ends_m[0] - SLACK_M;
        let count = ((ends_m[1] + SLACK_M - first_s_m) / NODE_M) as usize;
        let mut nodes_m = vec![DVec3::ZERO; count + 1];
        for i in 0..count {
            let middle_m = first_s_m + (i as f64 + 0.5) * NODE_M;
            nodes_m[i + 1] = nodes_m[i] + NODE_M * bends.direction(middle_m);
        }
        let offset_m = nodes_m[((at_s_m - first_s_m) / NODE_M) as usize];
        for node_m in &mut nodes_m {
            *node_m = *node_m - offset_m + at_m;
        }
        Self { driven_m: ends_m, ends_m, closed: [false; 2], bends, first_s_m, nodes_m }
    }

    /// The centre line at arc length `s_m`, clamped to the table.
    pub(super) fn at(&self, s_m: f64) -> Station {
        let last = (self.nodes_m.len() - 1) as f64;
        // Exact at the nodes; from the node on, one more midpoint step.
        let node = ((s_m - self.first_s_m) / NODE_M).floor().clamp(0.0, last);
        let node_s_m = self.first_s_m + node * NODE_M;
        let rest_m = s_m - node_s_m;
        let point_m =
            self.nodes_m[node as usize] + rest_m * self.bends.direction(node_s_m + 0.5 * rest_m);
        let forward = self.bends.direction(s_m);
        Station { point_m, forward, left: DVec3::new(-forward.y, forward.x, 0.0) }
    }

    /// Distance of a station from the driven part, in metres; 0 within it.
    pub(super) fn beyond_m(&self, s_m: f64) -> f64 {
        (s_m - s_m.clamp(self.driven_m[0], self.driven_m[1])).abs()
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
            // A step along a curve of radius 1/k is 1/(1 - k t) times as long on the line as at the
            // offset t. At least 0.3 keeps a step from overshooting far inside of a bend.
            let shrink = 1.0 - self.bends.curvature_per_m(s_m) * offset_m.dot(station.left);
            s_m += offset_m.dot(station.forward) / shrink.max(0.3);
        }
        (s_m, (point_m - self.at(s_m).point_m).dot(self.at(s_m).left))
    }

    /// Drives the lane `t_m` to the left of the centre line at 10 m/s, from 8 m after the start to
    /// as far before the end.
    pub(super) fn drive(&self, name: &str, t_m: f64) -> Trajectory {
        let mut station_m = self.driven_m[0] + INDENT_M;
        let poses = self.poses(t_m, &mut station_m, self.driven_m[1] - INDENT_M);
        Trajectory { name: name.into(), keyframes: keyframes(poses, SPEED_M_S) }
    }

    /// Poses every 0.5 m along the lane `t_m` to the left of the centre line, from one station to
    /// another, both in metres. Sets `station_m` to the station of the pose after the last.
    pub(super) fn poses(&self, t_m: f64, station_m: &mut f64, to_s_m: f64) -> Vec<Pose> {
        let mut poses = Vec::new();
        while *station_m <= to_s_m {
            let s_m = *station_m;
            poses.push(Pose {
                position_m: self.at(s_m).beside(t_m, 0.0),
                rotation: DQuat::from_rotation_z(self.bends.heading_rad(s_m)),
            });
            // A lane t to the left of a line of curvature k is (1 - k t) as long as the line.
            let half_m = 0.5 * KEYFRAME_M;
            *station_m += KEYFRAME_M / (1.0 - self.bends.curvature_per_m(s_m + half_m) * t_m);
        }
        poses
    }
}

/// Poses that lie 0.5 m apart, at the times of a constant speed, in m/s.
pub(super) fn keyframes(poses: Vec<Pose>, speed_m_s: f64) -> Vec<Keyframe> {
    let step_us = 1e6 * KEYFRAME_M / speed_m_s;
    let at = |(i, world_from_rig)| Keyframe {
        time_us: (i as f64 * step_us).round() as i64,
        world_from_rig,
    };
    poses.into_iter().enumerate().map(at).collect()
}

impl Bends {
    /// Angle from east at arc length `s_m`, counter-clockwise.
    fn heading_rad(&self, s_m: f64) -> f64 {
        let street_rad = SWING_RAD * (TAU * s_m / SWING_PERIOD_M).sin();
        self.wide.iter().fold(street_rad, |sum_rad, wave| sum_rad + wave.heading_rad(s_m))
    }

    /// Derivative of the heading; positive turns left.
    fn curvature_per_m(&self, s_m: f64) -> f64 {
        let rate_per_m = TAU / SWING_PERIOD_M;
        let street_per_m = SWING_RAD * rate_per_m * (rate_per_m * s_m).cos();
        self.wide.iter().fold(street_per_m, |sum_per_m, wave| sum_per_m + wave.curvature_per_m(s_m))
    }

    fn direction(&self, s_m: f64) -> DVec3 {
        let (sin, cos) = self.heading_rad(s_m).sin_cos();
        DVec3::new(cos, sin, 0.0)
    }
}

impl Wave {
    fn heading_rad(&self, s_m: f64) -> f64 {
        self.swing_rad * (TAU * s_m / self.period_m + self.phase_rad).sin()
    }

    fn curvature_per_m(&self, s_m: f64) -> f64 {
        let rate_per_m = TAU / self.period_m;
        self.swing_rad * rate_per_m * (rate_per_m * s_m + self.phase_rad).cos()
    }
}

impl Default for Wave {
    /// No turn: the street is straight. A period of 0 would divide by 0.
    fn default() -> Self {
        Self { swing_rad: 0.0, period_m: 1.0, phase_rad: 0.0 }
    }
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
            let before = route.at(s_m - 0.05);
            let after = route.at(s_m + 0.05);
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
        let drive = Route::new(300.0).drive("log", -1.75);
        assert!(drive.length_m() > 250.0, "{} m", drive.length_m());
        assert_eq!(drive.check(), Ok(()));
        for pair in drive.keyframes.windows(2) {
            let from = pair[0].world_from_rig;
            let to = pair[1].world_from_rig;
            let step_m = to.position_m - from.position_m;
            assert!((step_m.length() - 0.5).abs() < 1e-3, "{step_m}");
            assert!((step_m.normalize() - from.rotation * DVec3::X).length() < 3e-3);
            assert_eq!(pair[1].time_us - pair[0].time_us, 50_000);
        }
    }
}
