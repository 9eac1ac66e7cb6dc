//! Where the ego may be in the next steps.

use glam::DVec3;

use wildcity_scene::geometry::Pose;
use wildcity_twin::residency::Urgency;

use super::recorded_drive::RecordedDrive;
use crate::limits;

/// The data from which the ego's future poses are predicted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct EgoForecast<'a> {
    /// Where the ego is now.
    pub(crate) world_from_rig: Pose,
    /// The displacement of one step at the current velocity, in metres along world axes.
    pub(crate) last_step_m: DVec3,
    /// How many steps to look ahead.
    pub(crate) steps: usize,
    /// The recorded drive that the ego may follow.
    pub(crate) drive: Option<&'a RecordedDrive>,
    /// The agent's announced path (`prefetch`): poses (`world_from_rig`), in order.
    pub(crate) hint: &'a [Pose],
}

/// A place along a recorded drive that the ego follows.
#[derive(Clone, Copy)]
struct FollowedDrive<'a> {
    drive: &'a RecordedDrive,
    /// Distance along the drive, in metres.
    station_m: f64,
}

impl EgoForecast<'_> {
    /// Poses (`world_from_rig`) to prefetch, the soonest first: the exact poses of the next steps,
    /// then poses some metres apart as far as the steps reach, then poses along the hint.
    ///
    /// The exact poses matter: levels of detail change at exact distances, so that a pose two
    /// metres away may need a different section. Near a recorded drive and not against its
    /// direction, the ego is assumed to follow it, at its current offset and angle; otherwise it is
    /// assumed to drive straight.
    pub(crate) fn places(&self) -> Vec<(Urgency, Pose)> {
        let step_m = self.last_step_m.length();
        let moves = step_m > limits::STANDSTILL_STEP_M;
        let followed = self.followed_drive();
        let pose_after = |distance_m: f64| match followed {
            Some(FollowedDrive { drive, station_m }) => {
                // Offset and angle to the drive stay as they are now.
                let drive_from_rig = drive.pose_at(station_m).inverse() * self.world_from_rig;
                drive.pose_at(station_m + distance_m) * drive_from_rig
            }
            None => {
                // An ego that stands has a drive or no distance to go, so that the divisor is not
                // 0.
                let moved_m = self.last_step_m * (distance_m / step_m);
                let position_m = self.world_from_rig.position_m + moved_m;
                Pose { position_m, ..self.world_from_rig }
            }
        };

        let mut places = Vec::new();
        let mut distance_m = 0.0;
        if moves {
            for _ in 0..self.steps.min(limits::IMMINENT_STEPS) {
                distance_m += step_m;
                places.push((Urgency::Imminent, pose_after(distance_m)));
            }
        }

        let reach_m = match (moves, followed) {
            (true, _) => step_m * self.steps as f64,
            // The ego stands on a drive and is likely to start along it.
            (false, Some(_)) => limits::STANDSTILL_AHEAD_M,
            (false, None) => 0.0,
        };
        while distance_m < reach_m && places.len() < limits::PREFETCH_PLACES {
            // The first one is a spacing beyond the last exact pose.
            distance_m += limits::PREFETCH_SPACING_M;
            places.push((Urgency::Speculative, pose_after(distance_m)));
        }

        // In addition to the forecast: an agent that turns off announces it here.
        let hinted = sample_polyline(self.hint);
        places.extend(hinted.into_iter().map(|pose| (Urgency::Speculative, pose)));
        places
    }

    /// The drive, if the ego is near it and does not move against its direction.
    fn followed_drive(&self) -> Option<FollowedDrive<'_>> {
        let drive = self.drive?;
        let nearest = drive.nearest(self.world_from_rig.position_m)?;
        let station_m = nearest.station_m;
        // The drive continues straight beyond its end, so that there is a direction everywhere.
        let ahead_m = drive.pose_at(station_m + 1.0).position_m;
        let direction_m = ahead_m - drive.pose_at(station_m).position_m;
        let is_near = nearest.distance_m <= limits::ROUTE_NEAR_M;
        // The product is 0 for an ego that stands, which may start along the drive.
        let is_along = direction_m.dot(self.last_step_m) >= 0.0;
        (is_near && is_along).then_some(FollowedDrive { drive, station_m })
    }
}

/// The part of a hint that is still ahead of an ego at `now`: the poses after the last one that the
/// ego is near.
///
/// A hint may lead back to its start. So a pose counts as passed only if it is not much farther
/// along the hint than the ego is from the hint's first pose.
pub(crate) fn remaining_hint(hint: &[Pose], now: Pose) -> &[Pose] {
    // Two places that are prefetched: 16 m.
    let near_m = 2.0 * limits::PREFETCH_SPACING_M;
    let Some(first) = hint.first() else { return hint };
    // The way here may be up to twice as long as the straight line.
    let passable_m = 2.0 * first.position_m.distance(now.position_m) + near_m;
    let mut along_m = 0.0;
    let mut previous = first;
    let mut passed = 0;
    for (index, pose) in hint.iter().enumerate() {
        along_m += pose.position_m.distance(previous.position_m);
        if along_m > passable_m {
            break;
        }
        if pose.position_m.distance(now.position_m) <= near_m {
            // The last pose near the ego counts, even if one before it is farther away.
            passed = index + 1;
        }
        previous = pose;
    }
    &hint[passed..]
}

/// Poses along the straight lines between `corners`, at most `PREFETCH_SPACING_M` apart and at most
/// `PREFETCH_PLACES` in number.
fn sample_polyline(corners: &[Pose]) -> Vec<Pose> {
    // The first corner; each line adds the poses after its start.
    let mut poses: Vec<Pose> = corners.first().copied().into_iter().collect();
    for pair in corners.windows(2) {
        let length_m = pair[0].position_m.distance(pair[1].position_m);
        let parts = (length_m / limits::PREFETCH_SPACING_M).ceil().max(1.0);
        // A line may have any length, and only as many poses as there is room for.
        let left = limits::PREFETCH_PLACES.saturating_sub(poses.len());
        let fractions = (1..=(parts as usize).min(left)).map(|part| part as f64 / parts);
        poses.extend(fractions.map(|t| pair[0].interpolate(&pair[1], t)));
    }
    poses.truncate(limits::PREFETCH_PLACES);
    poses
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use wildcity_scene::Trajectory;
    use wildcity_scene::trajectory::Keyframe;

    /// 100 m east, then 100 m north.
    fn corner_drive() -> RecordedDrive {
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
        drive: Option<&'a RecordedDrive>,
        hint: &'a [Pose],
    ) -> Vec<Pose> {
        let forecast =
            EgoForecast { world_from_rig: now, last_step_m: step_m, steps: 20, drive, hint };
        forecast.places().into_iter().map(|(_, pose)| pose).collect()
    }

    #[test]
    fn without_a_drive_the_ego_goes_straight_on_step_by_step() {
        let places = ahead(at(10.0, 5.0), DVec3::X * 3.0, None, &[]);
        for (k, pose) in places[..limits::IMMINENT_STEPS].iter().enumerate() {
            let wanted = DVec3::new(13.0 + 3.0 * k as f64, 5.0, 0.0);
            assert!(pose.position_m.distance(wanted) < 1e-9, "{pose:?}");
        }
        let last = places[places.len() - 1].position_m.x;
        // 10 m + 20 x 3 m = 70 m, reached or passed by less than a spacing.
        assert!((70.0..=70.0 + limits::PREFETCH_SPACING_M).contains(&last), "20 steps: {last}");
        assert_eq!(ahead(at(10.0, 5.0), DVec3::ZERO, None, &[]), [], "an ego that stands stays");
    }

    #[test]
    fn along_a_drive_the_ego_keeps_its_offset_around_the_corner() {
        let drive = corner_drive();
        // 60 m: 12 m to the corner, and some 50 m north of it.
        let places = ahead(at(90.0, -2.0), DVec3::X * 3.0, Some(&drive), &[]);
        let after_corner = places.iter().filter(|pose| pose.position_m.y > 5.0);
        for pose in after_corner.clone() {
            assert!((pose.position_m.x - 102.0).abs() < 1e-6, "2 m to its right: {pose:?}");
        }
        assert!(after_corner.count() >= 4, "{places:?}");
        // An ego that moves against it, or is far from it, does not follow it.
        let against = ahead(at(90.0, -2.0), DVec3::X * -3.0, Some(&drive), &[]);
        assert!(against.iter().all(|pose| pose.position_m.x < 90.0));
        let far = ahead(at(90.0, -50.0), DVec3::X * 3.0, Some(&drive), &[]);
        assert!(far.iter().all(|pose| (pose.position_m.y + 50.0).abs() < 1e-9));
        // An ego that stands on it may start.
        let start = ahead(at(0.0, 0.0), DVec3::ZERO, Some(&drive), &[]);
        assert!(start.len() >= 5 && start[0].position_m.x > 0.0);
    }

    #[test]
    fn a_hint_is_prefetched_until_the_ego_has_passed_it() {
        let hint = [at(0.0, 0.0), at(0.0, 40.0), at(40.0, 40.0)];
        let places = ahead(at(-100.0, 0.0), DVec3::ZERO, None, &hint);
        // 80 m / 8 m, and the first corner.
        assert_eq!(places.len(), 11, "every 8 m: {places:?}");
        assert!(places.contains(&hint[1]) && places.contains(&hint[2]));
        assert_eq!(remaining_hint(&hint, at(-100.0, 0.0)), hint);
        assert_eq!(remaining_hint(&hint, at(5.0, 38.0)), &hint[2..]);
        assert_eq!(remaining_hint(&hint, at(40.0, 40.0)), []);
        // Around a block, back to where it began.
        let block = [at(0.0, 0.0), at(0.0, 40.0), at(40.0, 40.0), at(40.0, 0.0), at(0.0, 0.0)];
        assert_eq!(remaining_hint(&block, at(0.0, 0.0)), &block[1..]);
        // The last corner is near as well, but 120 m along the hint. At most 2 x 38 m + 16 m = 92 m
        // can be passed here.
        assert_eq!(remaining_hint(&block[1..], at(0.0, 2.0)), &block[1..]);
        assert_eq!(remaining_hint(&block[1..], at(0.0, 30.0)), &block[2..]);
        assert_eq!(remaining_hint(&block[4..], at(3.0, 0.0)), []);
        // More poses than are prefetched: 1,000 km / 8 m.
        let long = [at(0.0, 0.0), at(1e6, 0.0)];
        assert_eq!(sample_polyline(&long).len(), limits::PREFETCH_PLACES);
    }
}
