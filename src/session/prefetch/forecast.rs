//! Where the ego may be soon, so that what it will see there can be loaded before it is asked for.
//! A guess: it changes when things are in memory, never what is drawn.

use glam::DVec3;

use crate::limits;
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::{Bounds, Pose};
use wildcity_scene::route::BoxIndex;
use wildcity_twin::residency::Urgency;

/// A recorded drive that the ego may follow.
#[derive(Debug)]
pub(crate) struct RecordedDrive {
    poses: Vec<Pose>,
    /// Distance of each pose along the drive, in metres.
    stations_m: Vec<f64>,
    /// The ways from each pose to the next; of one pose, that pose.
    ways: BoxIndex,
}

/// What is known of where the ego goes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct EgoForecast<'a> {
    /// `world_from_rig` now.
    pub(crate) now: Pose,
    /// The way of the last step, in metres along world axes; zero at the start.
    pub(crate) last_step_m: DVec3,
    /// Steps to look ahead.
    pub(crate) steps: usize,
    /// The drive that it may follow.
    pub(crate) route: Option<&'a RecordedDrive>,
    /// Where the agent says that it may go next, in order.
    pub(crate) hint: &'a [Pose],
}

impl EgoForecast<'_> {
    /// Poses (`world_from_rig`), the soonest first: the next steps' own places, then some metres apart
    /// as far as the steps reach, then along the hint.
    ///
    /// Near the drive and not against it, the ego is taken to follow it, as far beside it and as turned
    /// as it is now; else it is taken to go straight on.
    pub(crate) fn places(&self) -> Vec<(Urgency, Pose)> {
        let step_m = self.last_step_m.length();
        let moves = step_m > limits::STANDSTILL_STEP_M;
        let mut places = Vec::new();
        let followed = self.followed();
        let after = |way_m: f64| match followed {
            Some((route, station_m)) => {
                let rig_from_route = route.at(station_m).inverse() * self.now;
                route.at(station_m + way_m) * rig_from_route
            }
            None => {
                let position_m = self.now.position_m + self.last_step_m * (way_m / step_m);
                Pose { position_m, ..self.now }
            }
        };
        let mut way_m = 0.0;
        if moves {
            for _ in 0..self.steps.min(limits::IMMINENT_STEPS) {
                way_m += step_m;
                places.push((Urgency::Imminent, after(way_m)));
            }
        }
        let far_m = match (moves, followed) {
            (true, _) => step_m * self.steps as f64,
            // It stands where a drive goes on.
            (false, Some(_)) => limits::STANDSTILL_AHEAD_M,
            (false, None) => 0.0,
        };
        while way_m < far_m && places.len() < limits::PREFETCH_PLACES {
            way_m += limits::PREFETCH_SPACING_M;
            places.push((Urgency::Speculative, after(way_m)));
        }
        places.extend(along(self.hint).into_iter().map(|pose| (Urgency::Speculative, pose)));
        places
    }

    /// The drive, and where along it the ego is, if it follows it.
    fn followed(&self) -> Option<(&RecordedDrive, f64)> {
        let route = self.route?;
        let (station_m, distance_m) = route.nearest(self.now.position_m)?;
        let on = route.at(station_m + 1.0).position_m - route.at(station_m).position_m;
        let along = on.dot(self.last_step_m) >= 0.0;
        (distance_m <= limits::ROUTE_NEAR_M && along).then_some((route, station_m))
    }
}

/// What is left of a hint for an ego that has come so far: what lies behind the last pose that it is
/// near is done. A pose that is much farther along the hint than from its front to the ego is still to
/// come, however near: a hint may lead back to its start.
pub(crate) fn rest(hint: &[Pose], now: Pose) -> &[Pose] {
    let near_m = 2.0 * limits::PREFETCH_SPACING_M;
    let Some(front) = hint.first() else { return hint };
    let most_m = 2.0 * front.position_m.distance(now.position_m) + near_m;
    let (mut way_m, mut before, mut done) = (0.0, front, 0);
    for (index, pose) in hint.iter().enumerate() {
        way_m += pose.position_m.distance(before.position_m);
        if way_m > most_m {
            break;
        }
        if pose.position_m.distance(now.position_m) <= near_m {
            done = index + 1;
        }
        before = pose;
    }
    &hint[done..]
}

/// Poses along straight lines between others, some metres apart.
fn along(corners: &[Pose]) -> Vec<Pose> {
    let mut poses: Vec<Pose> = corners.first().copied().into_iter().collect();
    for pair in corners.windows(2) {
        let length_m = pair[0].position_m.distance(pair[1].position_m);
        let parts = (length_m / limits::PREFETCH_SPACING_M).ceil().max(1.0);
        let left = limits::PREFETCH_PLACES.saturating_sub(poses.len());
        let between = (1..=(parts as usize).min(left)).map(|part| part as f64 / parts);
        poses.extend(between.map(|t| pair[0].interpolate(&pair[1], t)));
    }
    poses.truncate(limits::PREFETCH_PLACES);
    poses
}

impl RecordedDrive {
    /// Of a trajectory.
    pub(crate) fn new(log: &Trajectory) -> Self {
        let poses: Vec<Pose> = log.keyframes.iter().map(|frame| frame.world_from_rig).collect();
        let mut stations_m = Vec::with_capacity(poses.len());
        let mut way_m = 0.0;
        for (index, pose) in poses.iter().enumerate() {
            let before = poses[index.saturating_sub(1)];
            way_m += pose.position_m.distance(before.position_m);
            stations_m.push(way_m);
        }
        let way = |index: usize| {
            let mut bounds = Bounds::EMPTY;
            for pose in &poses[index..poses.len().min(index + 2)] {
                bounds.add(pose.position_m, DVec3::ZERO);
            }
            bounds
        };
        let count = poses.len().saturating_sub(1).max(poses.len().min(1));
        let ways: Vec<Bounds> = (0..count).map(way).collect();
        Self { poses, stations_m, ways: BoxIndex::new(&ways) }
    }

    /// The place along the drive that is nearest to a point, and how near: both in metres.
    fn nearest(&self, point_m: DVec3) -> Option<(f64, f64)> {
        // How far along a way the nearest place is, and how near.
        let on_way = |index: usize| {
            let from_m = self.poses[index].position_m;
            let to_m = self.poses.get(index + 1).map_or(from_m, |next| next.position_m);
            let (way_m, to_point_m) = (to_m - from_m, point_m - from_m);
            let t = (to_point_m.dot(way_m) / way_m.length_squared().max(1e-12)).clamp(0.0, 1.0);
            (t * way_m.length(), (to_point_m - t * way_m).length())
        };
        // No less than the distance to the way's box but for rounding, which may prefer an equal one.
        let (index, distance_m) = self.ways.min_cost(point_m, |index| on_way(index).1)?;
        Some((self.stations_m[index] + on_way(index).0, distance_m))
    }

    /// The pose at a distance along the drive, in metres. It goes straight on beyond its end.
    fn at(&self, station_m: f64) -> Pose {
        let after = self.stations_m.partition_point(|&m| m < station_m);
        let last = self.poses.len() - 1;
        if after > last {
            let end = self.poses[last];
            let beyond_m = station_m - self.stations_m[last];
            return Pose { position_m: end.position_m + end.rotation * DVec3::X * beyond_m, ..end };
        }
        let before = after.saturating_sub(1);
        let length_m = self.stations_m[after] - self.stations_m[before];
        let t = if length_m > 0.0 { (station_m - self.stations_m[before]) / length_m } else { 1.0 };
        self.poses[before].interpolate(&self.poses[after], t)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use wildcity_scene::trajectory::Keyframe;

    /// 100 m east, then 100 m north.
    fn route() -> RecordedDrive {
        let pose = |i: i64| {
            let way_m = i as f64;
            let (position_m, yaw) = if way_m <= 100.0 {
                (DVec3::new(way_m, 0.0, 0.0), 0.0)
            } else {
                (DVec3::new(100.0, way_m - 100.0, 0.0), std::f64::consts::FRAC_PI_2)
            };
            Pose { position_m, rotation: DQuat::from_rotation_z(yaw) }
        };
        let keyframe = |i| Keyframe { time_us: i, world_from_rig: pose(i) };
        RecordedDrive::new(&Trajectory {
            name: "log".into(),
            keyframes: (0..=200).map(keyframe).collect(),
        })
    }

    fn at(x_m: f64, y_m: f64) -> Pose {
        Pose { position_m: DVec3::new(x_m, y_m, 0.0), rotation: DQuat::IDENTITY }
    }

    fn ahead<'a>(
        now: Pose,
        step_m: DVec3,
        route: Option<&'a RecordedDrive>,
        hint: &'a [Pose],
    ) -> Vec<Pose> {
        let ahead = EgoForecast { now, last_step_m: step_m, steps: 20, route, hint };
        ahead.places().into_iter().map(|(_, pose)| pose).collect()
    }

    #[test]
    fn straight_on_without_a_drive_the_next_steps_to_the_metre() {
        let places = ahead(at(10.0, 5.0), DVec3::X * 3.0, None, &[]);
        for (k, pose) in places[..limits::IMMINENT_STEPS].iter().enumerate() {
            let wanted = DVec3::new(13.0 + 3.0 * k as f64, 5.0, 0.0);
            assert!(pose.position_m.distance(wanted) < 1e-9, "{pose:?}");
        }
        let last = places[places.len() - 1].position_m.x;
        assert!((70.0..=70.0 + limits::PREFETCH_SPACING_M).contains(&last), "20 steps: {last}");
        assert_eq!(ahead(at(10.0, 5.0), DVec3::ZERO, None, &[]), [], "who stands stays");
    }

    #[test]
    fn around_the_corner_along_a_drive_and_as_far_beside_it() {
        let route = route();
        let places = ahead(at(90.0, -2.0), DVec3::X * 3.0, Some(&route), &[]);
        let after_corner = places.iter().filter(|pose| pose.position_m.y > 5.0);
        for pose in after_corner.clone() {
            assert!((pose.position_m.x - 102.0).abs() < 1e-6, "2 m to its right: {pose:?}");
        }
        assert!(after_corner.count() >= 4, "{places:?}");
        // Against it, or far from it, it is no guide.
        let against = ahead(at(90.0, -2.0), DVec3::X * -3.0, Some(&route), &[]);
        assert!(against.iter().all(|pose| pose.position_m.x < 90.0));
        let far = ahead(at(90.0, -50.0), DVec3::X * 3.0, Some(&route), &[]);
        assert!(far.iter().all(|pose| (pose.position_m.y + 50.0).abs() < 1e-9));
        // Who stands on it may start.
        let start = ahead(at(0.0, 0.0), DVec3::ZERO, Some(&route), &[]);
        assert!(start.len() >= 5 && start[0].position_m.x > 0.0);
    }

    #[test]
    fn a_hint_is_followed_until_it_is_driven() {
        let hint = [at(0.0, 0.0), at(0.0, 40.0), at(40.0, 40.0)];
        let places = ahead(at(-100.0, 0.0), DVec3::ZERO, None, &hint);
        assert_eq!(places.len(), 11, "every 8 m: {places:?}");
        assert!(places.contains(&hint[1]) && places.contains(&hint[2]));
        assert_eq!(rest(&hint, at(-100.0, 0.0)), hint);
        assert_eq!(rest(&hint, at(5.0, 38.0)), &hint[2..]);
        assert_eq!(rest(&hint, at(40.0, 40.0)), []);
        // Around a block, back to where it began.
        let block = [at(0.0, 0.0), at(0.0, 40.0), at(40.0, 40.0), at(40.0, 0.0), at(0.0, 0.0)];
        assert_eq!(rest(&block, at(0.0, 0.0)), &block[1..]);
        assert_eq!(rest(&block[1..], at(0.0, 2.0)), &block[1..]);
        assert_eq!(rest(&block[1..], at(0.0, 30.0)), &block[2..]);
        assert_eq!(rest(&block[4..], at(3.0, 0.0)), []);
        let long = [at(0.0, 0.0), at(1e6, 0.0)];
        assert_eq!(along(&long).len(), limits::PREFETCH_PLACES);
    }
}
