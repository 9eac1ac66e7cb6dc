//! A part of a route as a list of poses.

use super::{Route, RouteError, positive};
use crate::geometry::Pose;

/// A pose of a route.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoutePose {
    /// Its station, in metres.
    pub station_m: f64,
    /// Time on the drive's clock, in microseconds.
    pub time_us: i64,
    /// Pose of the rig in the world.
    pub world_from_rig: Pose,
}

/// Which poses of a route.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RouteSection {
    /// The first station, in metres; 0 if absent.
    pub from_m: Option<f64>,
    /// The last station, in metres. The end of the route if absent, or if the route is shorter.
    pub to_m: Option<f64>,
    /// Distance between two poses along the route, in metres. The recorded keyframes if absent.
    pub every_m: Option<f64>,
}

/// Largest number of poses of a [`RouteSection`]: 10 km at 1 m. As JSON they take 2 MB.
pub const MAX_SECTION_POSES: usize = 10_000;

impl Route<'_> {
    /// The poses of a part of the route: the recorded keyframes in it, or interpolated ones at its
    /// start and every `every_m` from there.
    ///
    /// # Errors
    /// [`RouteError::Value`] if a station is not on the route, the spacing is not positive, or
    /// there are more than [`MAX_SECTION_POSES`] poses.
    pub fn section(&self, section: RouteSection) -> Result<Vec<RoutePose>, RouteError> {
        let RouteSection { from_m, to_m, every_m } = section;
        let length_m = self.length_m();
        let first_m = from_m.unwrap_or(0.0);
        if !(0.0..=length_m).contains(&first_m) {
            let must = "it is from 0 to the length of the trajectory";
            return Err(RouteError::Value { field: "from_m", value: first_m, must });
        }
        let last_m = to_m.unwrap_or(length_m);
        // Before the minimum, which a NaN would pass as the length.
        if !(first_m..).contains(&last_m) {
            let must = "it is not less than from_m";
            return Err(RouteError::Value { field: "to_m", value: last_m, must });
        }
        let last_m = last_m.min(length_m);
        match every_m {
            Some(every_m) => self.interpolated(first_m, last_m, every_m),
            None => self.recorded(first_m, last_m),
        }
    }

    fn interpolated(
        &self,
        first_m: f64,
        last_m: f64,
        every_m: f64,
    ) -> Result<Vec<RoutePose>, RouteError> {
        positive("every_m", every_m)?;
        // A tolerance of one micrometre: a drive of 10 m has 11 poses at 1 m in spite of rounding.
        let spaces = ((last_m - first_m + 1e-6) / every_m).floor();
        if spaces >= MAX_SECTION_POSES as f64 {
            let must = "a section has at most 10000 poses: ask for fewer, or for a shorter section";
            return Err(RouteError::Value { field: "every_m", value: every_m, must });
        }
        let pose = |index: usize| {
            // The tolerance may put the last station a micrometre beyond the end of the section.
            let station_m = (first_m + index as f64 * every_m).min(last_m);
            let keyframe = self.at(station_m);
            let time_us = keyframe.time_us;
            let world_from_rig = keyframe.world_from_rig;
            RoutePose { station_m, time_us, world_from_rig }
        };
        Ok((0..=spaces as usize).map(pose).collect())
    }

    fn recorded(&self, first_m: f64, last_m: f64) -> Result<Vec<RoutePose>, RouteError> {
        // Half-open range of keyframes, with those exactly at either end.
        let first = self.stations_m.partition_point(|&station_m| station_m < first_m);
        let end = self.stations_m.partition_point(|&station_m| station_m <= last_m);
        if end - first > MAX_SECTION_POSES {
            let must = "the section has more than 10000 keyframes up to there: ask for a shorter one, or \
                        set every_m";
            return Err(RouteError::Value { field: "to_m", value: last_m, must });
        }
        let keyframes = &self.trajectory.keyframes[first..end];
        let pose = |(keyframe, &station_m): (&crate::trajectory::Keyframe, &f64)| RoutePose {
            station_m,
            time_us: keyframe.time_us,
            world_from_rig: keyframe.world_from_rig,
        };
        Ok(keyframes.iter().zip(&self.stations_m[first..end]).map(pose).collect())
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::Trajectory;
    use crate::trajectory::Keyframe;

    /// A drive of 9 m along x, a metre every 0.1 s.
    fn drive() -> Trajectory {
        let keyframe = |i: i64| Keyframe {
            time_us: 100_000 * i,
            world_from_rig: Pose { position_m: i as f64 * DVec3::X, ..Pose::IDENTITY },
        };
        Trajectory { name: "log".into(), keyframes: (0..10).map(keyframe).collect() }
    }

    #[test]
    fn keyframes_are_exact_and_other_poses_lie_between_them() {
        let drive = drive();
        let route = Route::new(&drive).unwrap();
        let all = route.section(RouteSection::default()).unwrap();
        let times: Vec<i64> = all.iter().map(|pose| pose.time_us).collect();
        assert_eq!(times, (0..10).map(|i| 100_000 * i).collect::<Vec<_>>());
        let some = RouteSection { from_m: Some(1.5), to_m: Some(4.0), every_m: None };
        let stations: Vec<f64> = route.section(some).unwrap().iter().map(|p| p.station_m).collect();
        assert_eq!(stations, [2.0, 3.0, 4.0]);
        let between = RouteSection { from_m: Some(1.5), to_m: Some(3.0), every_m: Some(0.5) };
        let poses = route.section(between).unwrap();
        assert_eq!(
            poses.iter().map(|p| p.time_us).collect::<Vec<_>>(),
            [150_000, 200_000, 250_000, 300_000]
        );
        assert_eq!(poses[1].world_from_rig, drive.keyframes[2].world_from_rig);
        assert_eq!(poses[2].world_from_rig.position_m, 2.5 * DVec3::X);
        let beyond = RouteSection { from_m: Some(9.0), to_m: Some(1e9), every_m: Some(2.0) };
        assert_eq!(route.section(beyond).unwrap().len(), 1);
    }

    #[test]
    fn what_is_not_on_the_route_is_refused() {
        let drive = drive();
        let route = Route::new(&drive).unwrap();
        let field = |from_m: f64, to_m: f64, every_m: f64| {
            let section =
                RouteSection { from_m: Some(from_m), to_m: Some(to_m), every_m: Some(every_m) };
            match route.section(section) {
                Err(RouteError::Value { field, .. }) => field,
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(field(-0.1, 3.0, 1.0), "from_m");
        assert_eq!(field(9.5, 12.0, 1.0), "from_m");
        assert_eq!(field(f64::NAN, 3.0, 1.0), "from_m");
        assert_eq!(field(3.0, 2.0, 1.0), "to_m");
        assert_eq!(field(3.0, f64::NAN, 1.0), "to_m");
        assert_eq!(field(0.0, 3.0, 0.0), "every_m");
        assert_eq!(field(0.0, 3.0, f64::INFINITY), "every_m");
        // 9 m / 0.8 mm are 11,250 poses.
        assert_eq!(field(0.0, 9.0, 8e-4), "every_m");
    }
}
