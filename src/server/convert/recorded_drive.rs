//! Recorded drives over HTTP.

use std::str::FromStr;

use serde_json::{Value, json};

use wildcity_protocol::http;
use wildcity_scene::Trajectory;
use wildcity_scene::route::{Route, RouteError};
use wildcity_scene::trajectory::Keyframe;
use wildcity_session::SessionError;
use wildcity_twin::store::Version;

use crate::fault::Fault;
use crate::limits;

use super::answer::pose;

/// The query of `GET /v1/twins/{twin}/trajectories/{trajectory}`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct DriveQuery {
    /// Version of the twin; the latest if absent.
    pub(crate) version: Option<u64>,
    from_m: Option<f64>,
    to_m: Option<f64>,
    /// Distance between poses; the recorded keyframes if absent.
    every_m: Option<f64>,
}

impl DriveQuery {
    /// Parses `from_m=10&to_m=60&every_m=2`.
    ///
    /// # Errors
    /// A key is unknown or occurs twice, or a value is not a number.
    pub(crate) fn parse(query: &str) -> Result<Self, Fault> {
        let mut parsed = Self::default();
        for pair in query.split('&').filter(|pair| !pair.is_empty()) {
            let (key, value) = pair.split_once('=').unwrap_or((pair, ""));
            match key {
                "version" => set(&mut parsed.version, key, value)?,
                "from_m" => set(&mut parsed.from_m, key, value)?,
                "to_m" => set(&mut parsed.to_m, key, value)?,
                "every_m" => set(&mut parsed.every_m, key, value)?,
                _ => {
                    let reason = format!("{key:?}; known are version, from_m, to_m and every_m");
                    return Err(invalid(key, reason));
                }
            }
        }
        Ok(parsed)
    }

    /// The body of the answer.
    ///
    /// # Errors
    /// The version has no such trajectory, a station is not on it, or there are too many poses.
    pub(crate) fn answer(&self, version: &Version, name: &str) -> Result<Value, Fault> {
        let drives = &version.manifest.trajectories;
        let Some(drive) = drives.iter().find(|drive| drive.name == name) else {
            return Err(unknown(drives, name));
        };
        let route = Route::new(drive).map_err(|cause: RouteError| SessionError::from(cause))?;
        let length_m = route.length_m();
        let from_m = self.from_m.unwrap_or(0.0);
        let to_m = self.to_m.unwrap_or(length_m);
        for (field, station_m, least_m) in [("from_m", from_m, 0.0), ("to_m", to_m, from_m)] {
            if !(least_m..=length_m).contains(&station_m) {
                let must = format!("{station_m} m; {least_m} to {length_m} m are accepted");
                return Err(Fault::OutOfRange { field: field.to_owned(), must });
            }
        }
        let keyframes = match self.every_m {
            None => recorded(&route, drive, from_m, to_m)?,
            Some(every_m) => interpolated(&route, from_m, to_m, every_m)?,
        };
        Ok(json!(http::RecordedDrive {
            trajectory: name.to_owned(),
            version: version.number,
            length_m,
            keyframes,
        }))
    }
}

/// The recorded keyframes from one station to another.
fn recorded(
    route: &Route<'_>,
    drive: &Trajectory,
    from_m: f64,
    to_m: f64,
) -> Result<Vec<http::RecordedPose>, Fault> {
    let with_stations = route.stations_m().iter().zip(&drive.keyframes);
    let within = with_stations.filter(|(station_m, _)| (from_m..=to_m).contains(*station_m));
    let poses: Vec<_> =
        within.map(|(&station_m, keyframe)| recorded_pose(station_m, keyframe)).collect();
    check_count(poses.len() as f64)?;
    Ok(poses)
}

/// Poses at a distance of `every_m`, from the first station up to the last.
fn interpolated(
    route: &Route<'_>,
    from_m: f64,
    to_m: f64,
    every_m: f64,
) -> Result<Vec<http::RecordedPose>, Fault> {
    let is_distance = every_m > 0.0 && every_m.is_finite();
    if !is_distance {
        let must = format!("{every_m} m; a positive distance is accepted");
        return Err(Fault::OutOfRange { field: "every_m".to_owned(), must });
    }
    // With 1e-9 more, the pose at the end is not lost to rounding.
    let intervals = ((to_m - from_m) / every_m + 1e-9).floor();
    check_count(intervals + 1.0)?;
    let poses = (0..=intervals as u64).map(|index| {
        let station_m = (from_m + index as f64 * every_m).min(to_m);
        recorded_pose(station_m, &route.at(station_m))
    });
    Ok(poses.collect())
}

fn check_count(poses: f64) -> Result<(), Fault> {
    let most = limits::DRIVE_POSES;
    if poses <= most as f64 {
        return Ok(());
    }
    let must = format!("too small: {poses} poses; {most} are accepted, so ask for a shorter part");
    Err(Fault::OutOfRange { field: "every_m".to_owned(), must })
}

fn recorded_pose(station_m: f64, keyframe: &Keyframe) -> http::RecordedPose {
    let Keyframe { time_us, world_from_rig } = keyframe;
    http::RecordedPose { station_m, time_us: *time_us, pose: pose(world_from_rig) }
}

fn unknown(drives: &[Trajectory], name: &str) -> Fault {
    let names: Vec<&str> = drives.iter().map(|drive| drive.name.as_str()).collect();
    let known = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    Fault::UnknownTrajectory { name: name.to_owned(), known }
}

/// Stores a value, which must be a number and may not be there yet.
fn set<T: FromStr>(target: &mut Option<T>, key: &str, value: &str) -> Result<(), Fault> {
    if target.is_some() {
        return Err(invalid(key, format!("{key} occurs twice")));
    }
    let number =
        value.parse().map_err(|_| invalid(key, format!("{key} is {value:?}, no number")))?;
    *target = Some(number);
    Ok(())
}

fn invalid(key: &str, reason: String) -> Fault {
    Fault::InvalidRequest { field: Some(key.to_owned()), reason }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queries() {
        let parsed = DriveQuery::parse("from_m=1.5&every_m=2&version=3").unwrap();
        let expected =
            DriveQuery { version: Some(3), from_m: Some(1.5), to_m: None, every_m: Some(2.0) };
        assert_eq!(parsed, expected);
        assert_eq!(DriveQuery::parse("").unwrap(), DriveQuery::default());
        for (query, key) in [
            ("from=1", "from"),
            ("from_m=1&from_m=2", "from_m"),
            ("to_m=far", "to_m"),
            ("version=-1", "version"),
            ("every_m", "every_m"),
        ] {
            let Err(Fault::InvalidRequest { field, .. }) = DriveQuery::parse(query) else {
                panic!("{query}");
            };
            assert_eq!(field.as_deref(), Some(key), "{query}");
        }
    }
}
