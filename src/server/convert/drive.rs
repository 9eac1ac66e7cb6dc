//! Recorded drives.

use wildcity_protocol::message::{Drive, DrivePose, DriveSection, Pose};
use wildcity_scene::route::{Route, RouteError, RouteSection};
use wildcity_session::SessionError;
use wildcity_twin::store::Version;

use crate::fault::Fault;

/// A part of a recorded drive.
#[derive(Clone, Debug)]
pub(crate) struct DriveRequest {
    name: String,
    section: RouteSection,
}

impl From<DriveSection> for DriveRequest {
    fn from(section: DriveSection) -> Self {
        let DriveSection { name, from_m, to_m, every_m } = section;
        Self { name, section: RouteSection { from_m, to_m, every_m } }
    }
}

/// A part of a drive of a version. `prefix` is the path of the section's fields in the request,
/// with its dot.
pub(crate) fn drive(
    version: &Version,
    request: &DriveRequest,
    prefix: &str,
) -> Result<Drive, Fault> {
    let DriveRequest { name, section } = request;
    let drives = &version.manifest.trajectories;
    let recorded = drives.iter().find(|drive| drive.name == *name).ok_or_else(|| {
        let known = drives.iter().map(|drive| drive.name.clone()).collect();
        Fault::UnknownTrajectory { field: format!("{prefix}name"), name: name.clone(), known }
    })?;
    // The stored drive may be damaged, which is no fault of the request.
    let route = Route::new(recorded).map_err(SessionError::from)?;
    let poses = route.section(*section).map_err(|error| match error {
        RouteError::Value { field, value, must } => Fault::OutOfRange {
            field: format!("{prefix}{field}"),
            // The field is named as in the request, of which the route knows nothing.
            must: format!("{value}; {must}"),
        },
        other => SessionError::from(other).into(),
    })?;
    let poses = poses.into_iter().map(|at| DrivePose {
        station_m: at.station_m,
        time_us: at.time_us,
        pose: Pose { xyz: at.world_from_rig.position_m.to_array(), q: at.world_from_rig.q_wxyz() },
    });
    Ok(Drive {
        name: name.clone(),
        version: version.number,
        version_hash: version.hash.clone(),
        length_m: route.length_m(),
        poses: poses.collect(),
    })
}

/// The answer to `GET /v1/twins/{twin}/trajectories/{name}`, as JSON. Not as a value first, which
/// takes many times its memory.
pub(crate) fn drive_body(version: &Version, request: &DriveRequest) -> Result<Vec<u8>, Fault> {
    let drive = drive(version, request, "")?;
    serde_json::to_vec(&drive).map_err(|error| Fault::Internal(error.to_string()))
}

/// The query of that request: `version`, `from_m`, `to_m` and `every_m`, each at most once.
pub(crate) fn drive_query(name: String, query: &str) -> Result<(Option<u64>, DriveRequest), Fault> {
    let mut section = RouteSection::default();
    let mut version = None;
    // Read by hand, because serde would take the last of two values of a field, and ignore unknown
    // ones.
    for (field, text) in form_urlencoded::parse(query.as_bytes()) {
        let invalid = |reason: &str| Fault::InvalidRequest {
            field: Some(field.clone().into_owned()),
            reason: format!("{field}: {reason}"),
        };
        if field == "version" {
            let number = text.parse().map_err(|_| invalid("not the number of a version"))?;
            if version.replace(number).is_some() {
                return Err(invalid("given twice"));
            }
            continue;
        }
        let target = match &*field {
            "from_m" => &mut section.from_m,
            "to_m" => &mut section.to_m,
            "every_m" => &mut section.every_m,
            _ => return Err(invalid("unknown; there are version, from_m, to_m and every_m")),
        };
        // NaN and infinity are numbers to Rust; the route refuses them by their range.
        let metres = text.parse().map_err(|_| invalid("not a number of metres"))?;
        if target.replace(metres).is_some() {
            return Err(invalid("given twice"));
        }
    }
    Ok((version, DriveRequest { name, section }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queries_are_decoded_and_each_field_is_there_once() {
        let read = |query: &str| drive_query("log".to_owned(), query);
        let (version, request) =
            // Escaped digits, an escaped underscore, an exponent, an empty part and an escaped
            // plus.
            read("version=3&from_m=%31%32%2E5&every%5Fm=5e-1&&to_m=%2B13").unwrap();
        let DriveRequest { section, .. } = request;
        assert_eq!(version, Some(3));
        let found = (section.from_m, section.to_m, section.every_m);
        assert_eq!(found, (Some(12.5), Some(13.0), Some(0.5)));
        for (query, field) in [
            ("version=3&version=4", "version"),
            ("from_m=1&from%5Fm=2", "from_m"),
            ("from_m=%ZZ", "from_m"),
            ("from_m", "from_m"),
            ("there%20=1", "there "),
        ] {
            let refused = read(query).unwrap_err();
            let Fault::InvalidRequest { field: Some(named), .. } = &refused else {
                panic!("{refused}")
            };
            assert_eq!(named, field, "{query}");
        }
    }
}
