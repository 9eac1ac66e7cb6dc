//! Courses: the lines that actors follow, by distance along them.

use glam::{DQuat, DVec3};

use wildcity_scene::Trajectory;
use wildcity_scene::boxes::{BoxTree, Extent};
use wildcity_scene::geometry::Pose;

use crate::Ground;

/// Points of a course that are nearer than this to the previous point are left out, in metres: a
/// recording has thousands of keyframes at one place while the vehicle stood.
const SPACING_M: f64 = 0.01;

/// A line of poses: x along the line, z up from the ground. Beyond both ends it continues straight.
#[derive(Clone, Debug, PartialEq)]
pub struct Course {
    poses: Vec<Pose>,
    /// Distance of each pose from the first, in metres along the line.
    stations_m: Vec<f64>,
    /// The boxes of the segments.
    boxes: BoxTree,
}

/// The nearest place of a course to a point, and the point's offset from it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CourseFootPoint {
    /// Distance along the course, in metres.
    pub station_m: f64,
    /// Distance to the left of the course, in metres.
    pub left_m: f64,
    /// Distance from the course in the horizontal plane, in metres.
    pub distance_m: f64,
}

impl Course {
    /// The course through poses in order. `None` without two different places.
    pub fn from_poses(poses: impl IntoIterator<Item = Pose>) -> Option<Self> {
        let mut kept: Vec<Pose> = Vec::new();
        let mut stations_m: Vec<f64> = Vec::new();
        for pose in poses {
            let before = kept.last().map(|last: &Pose| last.position_m.distance(pose.position_m));
            match before {
                // Skipped points keep no way: the next one is measured from the last that was kept.
                Some(way_m) if way_m < SPACING_M => continue,
                Some(way_m) => stations_m.push(stations_m[stations_m.len() - 1] + way_m),
                None => stations_m.push(0.0),
            }
            kept.push(pose);
        }
        (kept.len() >= 2).then(|| Self::new(kept, stations_m))
    }

    fn new(poses: Vec<Pose>, stations_m: Vec<f64>) -> Self {
        let extents = poses.windows(2).map(|pair| {
            let from_m = pair[0].position_m;
            let to_m = pair[1].position_m;
            // A vertical segment has no place on the ground: it is infinitely far from all.
            let is_vertical = flat(to_m - from_m).length_squared() == 0.0;
            let nowhere = Extent { low_m: DVec3::INFINITY, high_m: DVec3::NEG_INFINITY };
            if is_vertical { nowhere } else { Extent::from_line(from_m, to_m) }
        });
        let boxes = BoxTree::new(extents);
        Self { poses, stations_m, boxes }
    }

    /// The course of a recorded drive.
    pub fn from_drive(drive: &Trajectory) -> Option<Self> {
        Self::from_poses(drive.keyframes.iter().map(|keyframe| keyframe.world_from_rig))
    }

    /// The course through points in order, placed on the ground. A pose faces halfway between the
    /// directions to its neighbours. `None` without two places that differ horizontally.
    pub fn from_points(points_m: &[DVec3], ground: &Ground<'_>) -> Option<Self> {
        let mut kept: Vec<DVec3> = Vec::new();
        for point_m in points_m {
            // Horizontally, because directions and headings are horizontal: two points above each
            // other have none.
            let is_new =
                kept.last().is_none_or(|last: &DVec3| flat(*last - *point_m).length() >= SPACING_M);
            if is_new {
                kept.push(*point_m);
            }
        }
        if kept.len() < 2 {
            return None;
        }
        let direction = |from: usize, to: usize| flat(kept[to] - kept[from]).normalize_or_zero();
        let last = kept.len() - 1;
        let poses = (0..=last).map(|at| {
            // Unit vectors, so that a long neighbour does not outweigh a short one. At the ends
            // only one direction counts.
            let before = if at > 0 { direction(at - 1, at) } else { DVec3::ZERO };
            let after = if at < last { direction(at, at + 1) } else { DVec3::ZERO };
            let sum = before + after;
            // A reversal on the spot has no middle direction: then the next one.
            let ahead = if sum.length() > 1e-6 { sum } else { after + 1e-12 * before };
            let rotation = DQuat::from_rotation_z(ahead.y.atan2(ahead.x));
            ground.place(Pose { position_m: kept[at], rotation })
        });
        // Again by distance: placing may bring two points together, and stations are along the
        // ground.
        Self::from_poses(poses)
    }

    /// This line in the opposite direction.
    pub fn reversed(&self) -> Self {
        // About the own z axis, so that up stays up.
        let half_turn = DQuat::from_rotation_z(std::f64::consts::PI);
        let length_m = self.length_m();
        let turned = |pose: &Pose| Pose {
            rotation: (pose.rotation * half_turn).normalize(),
            position_m: pose.position_m,
        };
        let stations_m = self.stations_m.iter().rev().map(|s_m| length_m - s_m);
        Self::new(self.poses.iter().rev().map(turned).collect(), stations_m.collect())
    }

    /// Number of its places.
    pub fn places(&self) -> usize {
        self.poses.len()
    }

    /// Length of the way through the poses, in metres; above 0.
    pub fn length_m(&self) -> f64 {
        self.stations_m[self.stations_m.len() - 1]
    }

    /// The pose at a station, in metres.
    pub fn at(&self, station_m: f64) -> Pose {
        let (segment, t) = self.segment(station_m);
        let from = &self.poses[segment];
        let to = &self.poses[segment + 1];
        Pose {
            position_m: from.position_m.lerp(to.position_m, t),
            // Position continues straight beyond the ends, but the rotation must not turn on.
            rotation: from.rotation.slerp(to.rotation, t.clamp(0.0, 1.0)).normalize(),
        }
    }

    /// The point at a station, in metres.
    pub fn point_m(&self, station_m: f64) -> DVec3 {
        let (segment, t) = self.segment(station_m);
        self.poses[segment].position_m.lerp(self.poses[segment + 1].position_m, t)
    }

    /// Curvature at a station in 1/m, positive to the left: constant between two poses.
    pub fn curvature_1_m(&self, station_m: f64) -> f64 {
        // Beyond the ends the course is straight. NaN is in no range and has no curvature either.
        if !(0.0..self.length_m()).contains(&station_m) {
            return 0.0;
        }
        let (segment, _) = self.segment(station_m);
        let from = &self.poses[segment];
        let to = &self.poses[segment + 1];
        let way_m = self.stations_m[segment + 1] - self.stations_m[segment];
        turned_rad(from.rotation, to.rotation) / way_m
    }

    /// The nearest place of the whole course to a point, in the horizontal plane.
    pub fn nearest(&self, point_m: DVec3) -> CourseFootPoint {
        self.nearest_between(point_m, 0.0, self.length_m())
    }

    /// The nearest place to a point between two stations.
    pub fn nearest_between(&self, point_m: DVec3, from_m: f64, to_m: f64) -> CourseFootPoint {
        // Whole segments are tested, so that the place may lie a little outside of the two
        // stations.
        let (first, _) = self.segment(from_m);
        let (last, _) = self.segment(to_m);
        let mut best =
            CourseFootPoint { station_m: from_m, left_m: 0.0, distance_m: f64::INFINITY };
        let mut test = |segment: usize| {
            let from = self.poses[segment].position_m;
            let way = flat(self.poses[segment + 1].position_m - from);
            let offset = flat(point_m - from);
            let length_m2 = way.length_squared();
            // Two points above each other have no direction on the ground.
            if length_m2 == 0.0 {
                return best.distance_m;
            }
            let t = (offset.dot(way) / length_m2).clamp(0.0, 1.0);
            let aside = offset - t * way;
            let distance_m = aside.length();
            if distance_m < best.distance_m {
                let station_m = self.stations_m[segment]
                    + t * (self.stations_m[segment + 1] - self.stations_m[segment]);
                // Cross product of the unit direction with the offset: positive to the left.
                let left_m = (way.x * aside.y - way.y * aside.x) / length_m2.sqrt();
                best = CourseFootPoint { station_m, left_m, distance_m };
            }
            best.distance_m
        };
        let away_m = |extent: &Extent| flat(extent.away_m(point_m)).length();
        self.boxes.visit(first..last + 1, f64::INFINITY, &away_m, &mut test);
        best
    }

    /// The extent of the part between two stations, straight on beyond the ends.
    pub(super) fn extent(&self, from_m: f64, to_m: f64) -> Extent {
        let (first, _) = self.segment(from_m);
        let (last, _) = self.segment(to_m);
        let ends = Extent::from_line(self.point_m(from_m), self.point_m(to_m));
        self.boxes.extent(first..last + 1).map_or(ends, |extent| extent.with(ends))
    }

    /// The first station from `from_m` to `to_m` at which the course is within `radius_m` of a
    /// point, in the horizontal plane, to within 0.5 m.
    ///
    /// The distance changes by at most the way along the course, so the search advances by the
    /// distance that is missing: a few steps instead of a test of each segment.
    pub fn first_within(
        &self,
        point_m: DVec3,
        radius_m: f64,
        from_m: f64,
        to_m: f64,
    ) -> Option<f64> {
        let mut station_m = from_m;
        while station_m <= to_m {
            let missing_m = flat(self.point_m(station_m) - point_m).length() - radius_m;
            if missing_m <= 0.0 {
                return Some(station_m);
            }
            // At least 0.5 m, because the missing distance approaches 0 near the circle and the
            // search would not end.
            station_m += missing_m.max(0.5);
        }
        None
    }

    /// The segment of a station, and the place on it: below 0 or above 1 beyond the ends.
    fn segment(&self, station_m: f64) -> (usize, f64) {
        // A course has at least two points, so there is a segment.
        let last = self.stations_m.len() - 2;
        let after = self.stations_m.partition_point(|&s_m| s_m <= station_m);
        // Stations rise strictly, so the division below is safe. The clamp extends the first and
        // the last segment.
        let segment = after.saturating_sub(1).min(last);
        let from_m = self.stations_m[segment];
        let to_m = self.stations_m[segment + 1];
        (segment, (station_m - from_m) / (to_m - from_m))
    }
}

/// The vector without its vertical part.
pub(super) fn flat(vector: DVec3) -> DVec3 {
    DVec3::new(vector.x, vector.y, 0.0)
}

/// The rotation about the own z axis from one orientation to another, in radians within ±π.
pub(super) fn turned_rad(from: DQuat, to: DQuat) -> f64 {
    let turn = from.inverse() * to;
    // The swing-twist decomposition: twice the angle of the (w, z) part. q and -q are one rotation.
    let half_rad = if turn.w < 0.0 { (-turn.z).atan2(-turn.w) } else { turn.z.atan2(turn.w) };
    2.0 * half_rad
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A quarter circle of radius 20 m to the left, from the origin to the east.
    fn arc() -> Course {
        let pose = |i: i32| {
            // A hundred chords of 0.9°: their length is short of the arc by 1e-5 of it.
            let angle_rad = f64::from(i) * std::f64::consts::FRAC_PI_2 / 100.0;
            let (sin, cos) = angle_rad.sin_cos();
            Pose {
                position_m: 20.0 * DVec3::new(sin, 1.0 - cos, 0.0),
                rotation: DQuat::from_rotation_z(angle_rad),
            }
        };
        Course::from_poses((0..=100).map(pose)).unwrap()
    }

    #[test]
    fn an_arc_has_its_length_curvature_and_sides() {
        let arc = arc();
        assert!((arc.length_m() - 10.0 * std::f64::consts::PI).abs() < 1e-3);
        assert!((arc.curvature_1_m(12.0) - 0.05).abs() < 1e-5);
        let middle = arc.at(5.0 * std::f64::consts::PI).position_m;
        // At 0.9 of the radius, 2 m towards the centre, which is to the left.
        let beside = arc.nearest(DVec3::new(0.0, 20.0, 0.0) + 0.9 * (middle - 20.0 * DVec3::Y));
        assert!((beside.left_m - 2.0).abs() < 1e-2 && beside.distance_m >= 1.99, "{beside:?}");
        let back = arc.reversed();
        assert!((back.at(0.0).position_m - arc.at(arc.length_m()).position_m).length() < 1e-9);
        assert!(
            (back.at(3.0).rotation * DVec3::X + arc.at(arc.length_m() - 3.0).rotation * DVec3::X)
                .length()
                < 1e-9
        );
        assert!((back.curvature_1_m(12.0) + 0.05).abs() < 1e-5);
    }

    #[test]
    fn the_search_ahead_agrees_with_the_nearest_place() {
        let arc = arc();
        for (station_m, left_m) in [(0.5, 0.0), (10.0, 1.4), (20.0, -1.9), (31.0, 0.3)] {
            let pose = arc.at(station_m);
            let point_m = pose.transform_point(DVec3::Y * left_m);
            let found = arc.first_within(point_m, 2.0, 0.0, 40.0).unwrap();
            let beside = arc.nearest_between(point_m, found, found + 4.0);
            assert!((beside.station_m - station_m).abs() < 0.02, "{station_m}: {beside:?}");
            assert!((beside.left_m - left_m).abs() < 0.01, "{left_m}: {beside:?}");
        }
        assert_eq!(arc.first_within(DVec3::new(-30.0, 0.0, 0.0), 2.0, 0.0, 40.0), None);
    }

    #[test]
    fn points_face_along_the_line_and_standing_is_left_out() {
        let points = [DVec3::ZERO, DVec3::ZERO, DVec3::X * 10.0, DVec3::new(10.0, 10.0, 0.0)];
        let course = Course::from_points(&points, &Ground::from_drives(&[])).unwrap();
        // The repeated first point adds nothing: 10 m east and 10 m north.
        assert_eq!(course.length_m(), 20.0);
        let facing = course.at(10.0).rotation * DVec3::X;
        assert!((facing - DVec3::new(1.0, 1.0, 0.0).normalize()).length() < 1e-12, "{facing}");
        assert_eq!(Course::from_points(&points[..2], &Ground::from_drives(&[])), None);
    }

    #[test]
    fn turns_are_small_across_half_a_turn() {
        let yaw = DQuat::from_rotation_z;
        // From 3.1 to -3.1 the short way is 2π - 6.2, and -q is the same rotation as q.
        assert!((turned_rad(yaw(3.1), yaw(-3.1)) - 0.08318530717958605).abs() < 1e-12);
        assert!((turned_rad(yaw(3.1), -yaw(3.0)) + 0.1).abs() < 1e-12);
    }
}
