//! The place of a twin on the earth: latitude, longitude and heading of poses in its world.
//!
//! A twin's world is flat: x east, y north, z up, in metres. An anchor defines this flat world.
//! With a WGS84 origin it is the tangent plane at the origin (ENU): a point is `X0 + E (x, y, z)`
//! in earth-centred coordinates, which is exact at any distance, and "up" is that of the origin.
//! With a UTM zone, x and y are differences of easting and northing: grid metres, 0.04 % shorter
//! than metres on the ground in the zone's middle, and north is the grid's.
//!
//! Tests compare both with values from PROJ.

mod ellipsoid;
#[cfg(test)]
mod tests;
mod utm;

use std::str::FromStr;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::geometry::Pose;

use ellipsoid::{enu_axes, to_ecef, to_geodetic};
use utm::UtmZone;
/// The place of the origin of a twin's world on the earth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum GeoAnchor {
    /// The world is the tangent plane at a point: x east, y north, z up.
    Origin(GeoPoint),
    /// The world is a part of a map projection.
    Projected(ProjectedOrigin),
}

/// A point of WGS84.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeoPoint {
    /// Latitude, in degrees, positive to the north.
    pub latitude_deg: f64,
    /// Longitude, in degrees, positive to the east.
    pub longitude_deg: f64,
    /// Height above the ellipsoid, in metres.
    #[serde(default)]
    pub altitude_m: f64,
}

/// The origin of a world in a map projection.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProjectedOrigin {
    /// A UTM zone: `EPSG:32601` to `EPSG:32660` (north) or `EPSG:32701` to `EPSG:32760` (south).
    pub projection: String,
    /// Easting of the origin, in metres.
    pub easting_m: f64,
    /// Northing of the origin, in metres.
    pub northing_m: f64,
    /// Height of the origin above the ellipsoid, in metres.
    #[serde(default)]
    pub altitude_m: f64,
}

/// A place on the earth, and a direction there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GeoPose {
    pub point: GeoPoint,
    /// Direction of the rig's x axis, in degrees from true north to the east, 0 to 360.
    pub heading_deg: f64,
}

/// Why an anchor was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GeoError {
    /// A number is out of range.
    #[error("geo.{field} is {value}; {least} to {most} are accepted")]
    Range { field: &'static str, value: f64, least: f64, most: f64 },
    /// The text is not an anchor.
    #[error(
        "{text:?} is not LATITUDE,LONGITUDE[,ALTITUDE] (degrees, metres) or \
         EPSG:CODE,EASTING,NORTHING[,ALTITUDE]"
    )]
    Malformed { text: String },
    /// The projection is not known.
    #[error(
        "geo.projection is {name:?}; UTM zones are accepted, EPSG:32601 to EPSG:32660 and EPSG:32701 to \
         EPSG:32760: give the latitude and longitude of the origin instead"
    )]
    Projection { name: String },
}

impl GeoAnchor {
    /// Checks the numbers and the name of the projection.
    ///
    /// # Errors
    /// Names the first field that is out of range or unknown.
    pub fn check(&self) -> Result<(), GeoError> {
        match self {
            Self::Origin(point) => {
                in_range("latitude_deg", point.latitude_deg, -89.9, 89.9)?;
                in_range("longitude_deg", point.longitude_deg, -180.0, 180.0)?;
                in_range("altitude_m", point.altitude_m, -12_000.0, 100_000.0)
            }
            Self::Projected(origin) => {
                UtmZone::named(&origin.projection)?;
                // 400 km on both sides of the central meridian; half a zone, 3 degrees, is 334 km
                // at the equator.
                in_range("easting_m", origin.easting_m, 1e5, 9e5)?;
                in_range("northing_m", origin.northing_m, 0.0, 1e7)?;
                in_range("altitude_m", origin.altitude_m, -12_000.0, 100_000.0)
            }
        }
    }

    /// The place of a rig on the earth, and its heading. The anchor has passed
    /// [`GeoAnchor::check`].
    ///
    /// # Errors
    /// As [`GeoAnchor::check`], for an anchor that has not.
    pub fn locate(&self, world_from_rig: &Pose) -> Result<GeoPose, GeoError> {
        let at_m = world_from_rig.position_m;
        let forward = world_from_rig.rotation * DVec3::X;
        match self {
            Self::Origin(origin) => {
                let point = to_geodetic(to_ecef(origin) + enu_axes(origin) * at_m);
                // The direction goes to earth-centred axes and from there to the axes at the point:
                // east of the origin, the local north is turned.
                let here = enu_axes(&point).transpose() * (enu_axes(origin) * forward);
                Ok(GeoPose { point, heading_deg: heading_deg(here.x, here.y) })
            }
            Self::Projected(origin) => {
                let zone = UtmZone::named(&origin.projection)?;
                let easting_m = origin.easting_m + at_m.x;
                let northing_m = origin.northing_m + at_m.y;
                let (mut point, convergence_rad) = zone.to_geodetic(easting_m, northing_m);
                point.altitude_m = origin.altitude_m + at_m.z;
                // The world's y axis is grid north. Grid north is turned against true north by the
                // convergence, which grows with the distance from the central meridian.
                let grid_deg = heading_deg(forward.x, forward.y);
                let heading_deg = within_turn(grid_deg + convergence_rad.to_degrees());
                Ok(GeoPose { point, heading_deg })
            }
        }
    }

    /// Position in the world, in metres, of a point of the earth: the inverse of
    /// [`GeoAnchor::locate`].
    ///
    /// # Errors
    /// As [`GeoAnchor::check`], for an anchor that has not passed it.
    pub fn position_m(&self, point: &GeoPoint) -> Result<DVec3, GeoError> {
        match self {
            Self::Origin(origin) => {
                Ok(enu_axes(origin).transpose() * (to_ecef(point) - to_ecef(origin)))
            }
            Self::Projected(origin) => {
                let zone = UtmZone::named(&origin.projection)?;
                let [easting_m, northing_m] = zone.project(point);
                Ok(DVec3::new(
                    easting_m - origin.easting_m,
                    northing_m - origin.northing_m,
                    point.altitude_m - origin.altitude_m,
                ))
            }
        }
    }
}

fn in_range(field: &'static str, value: f64, least: f64, most: f64) -> Result<(), GeoError> {
    let accepted = (least..=most).contains(&value);
    if accepted { Ok(()) } else { Err(GeoError::Range { field, value, least, most }) }
}
/// Degrees from north to the east, 0 to 360.
fn heading_deg(east: f64, north: f64) -> f64 {
    within_turn(east.atan2(north).to_degrees())
}

/// An angle as a value from 0 to below 360 degrees.
fn within_turn(angle_deg: f64) -> f64 {
    // The remainder of a tiny negative angle rounds to 360.
    Some(angle_deg.rem_euclid(360.0)).filter(|angle_deg| *angle_deg < 360.0).unwrap_or(0.0)
}

/// Reads `LATITUDE,LONGITUDE[,ALTITUDE]` in degrees and metres, or
/// `EPSG:CODE,EASTING,NORTHING[,ALTITUDE]` in metres.
impl FromStr for GeoAnchor {
    type Err = GeoError;

    fn from_str(text: &str) -> Result<Self, GeoError> {
        let malformed = || GeoError::Malformed { text: text.to_owned() };
        let mut parts = text.split(',').map(str::trim).peekable();
        let projection = parts.next_if(|part| part.starts_with("EPSG:")).map(str::to_owned);
        let numbers: Vec<f64> = parts
            .map(|part| part.parse().map_err(|_| malformed()))
            .collect::<Result<_, GeoError>>()?;
        let ([first, second] | [first, second, _]) = numbers[..] else { return Err(malformed()) };
        let altitude_m = numbers.get(2).copied().unwrap_or(0.0);
        let anchor = match projection {
            None => {
                Self::Origin(GeoPoint { latitude_deg: first, longitude_deg: second, altitude_m })
            }
            Some(projection) => Self::Projected(ProjectedOrigin {
                projection,
                easting_m: first,
                northing_m: second,
                altitude_m,
            }),
        };
        anchor.check()?;
        Ok(anchor)
    }
}
