//! Where a twin lies on the earth: latitude, longitude and heading of poses in its world.
//!
//! A twin's world is flat: x east, y north, z up, in metres. An anchor says which flat world. With a WGS84 origin it
//! is the tangent plane there (ENU): a point is `X0 + E (x, y, z)` in earth-centred coordinates, which is exact at any
//! distance, and "up" is that of the origin. With a UTM zone, x and y are differences of easting and northing: grid
//! metres, 0.04 % shorter than metres on the ground in the zone's middle, and north is the grid's.
//!
//! The transverse Mercator projection is Krüger's series in the third flattening n to order 6 (Karney,
//! "Transverse Mercator with an accuracy of a few nanometers", 2011, equations 35 and 36), which is exact to 5 nm
//! within 3,900 km of the central meridian. Tests compare both with values from PROJ.

use std::str::FromStr;

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

use crate::geometry::Pose;

/// Semi-major axis of WGS84, in metres.
const A_M: f64 = 6_378_137.0;

/// Flattening of WGS84.
const F: f64 = 1.0 / 298.257_223_563;

/// Square of the first eccentricity.
const E2: f64 = F * (2.0 - F);

/// Third flattening.
const N: f64 = F / (2.0 - F);

/// Scale of UTM on its central meridian.
const UTM_SCALE: f64 = 0.9996;

/// False easting of UTM, in metres.
const UTM_EASTING_M: f64 = 500_000.0;

/// False northing of UTM in the southern hemisphere, in metres.
const UTM_SOUTH_NORTHING_M: f64 = 1e7;

/// Where the origin of a twin's world lies.
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
    /// The place.
    pub point: GeoPoint,
    /// Direction of the rig's x axis, in degrees from true north to the east, 0 to 360.
    pub heading_deg: f64,
}

/// Why an anchor was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GeoError {
    /// A number is out of range.
    #[error("geo.{field} is {value}; {least} to {most} are accepted")]
    Range {
        /// The field.
        field: &'static str,
        /// The refused value.
        value: f64,
        /// The least accepted.
        least: f64,
        /// The largest accepted.
        most: f64,
    },
    /// The text is not an anchor.
    #[error(
        "{text:?} is not LATITUDE,LONGITUDE[,ALTITUDE] (degrees, metres) or \
         EPSG:CODE,EASTING,NORTHING[,ALTITUDE]"
    )]
    Malformed {
        /// The text.
        text: String,
    },
    /// The projection is not known.
    #[error(
        "geo.projection is {name:?}; UTM zones are accepted, EPSG:32601 to EPSG:32660 and EPSG:32701 to \
         EPSG:32760: give the latitude and longitude of the origin instead"
    )]
    Projection {
        /// The refused name.
        name: String,
    },
}

/// A UTM zone.
#[derive(Clone, Copy, Debug, PartialEq)]
struct UtmZone {
    /// 1 to 60.
    number: u32,
    is_south: bool,
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
                in_range("easting_m", origin.easting_m, 1e5, 9e5)?;
                in_range("northing_m", origin.northing_m, 0.0, 1e7)?;
                in_range("altitude_m", origin.altitude_m, -12_000.0, 100_000.0)
            }
        }
    }

    /// The place of a rig on the earth, and its heading. The anchor has passed [`GeoAnchor::check`].
    ///
    /// # Errors
    /// As [`GeoAnchor::check`], for an anchor that has not.
    pub fn locate(&self, world_from_rig: &Pose) -> Result<GeoPose, GeoError> {
        let at_m = world_from_rig.position_m;
        let forward = world_from_rig.rotation * DVec3::X;
        match self {
            Self::Origin(origin) => {
                let point = to_geodetic(to_ecef(origin) + enu_axes(origin) * at_m);
                let here = enu_axes(&point).transpose() * (enu_axes(origin) * forward);
                Ok(GeoPose { point, heading_deg: heading_deg(here.x, here.y) })
            }
            Self::Projected(origin) => {
                let zone = UtmZone::named(&origin.projection)?;
                let easting_m = origin.easting_m + at_m.x;
                let northing_m = origin.northing_m + at_m.y;
                let (mut point, convergence_rad) = zone.to_geodetic(easting_m, northing_m);
                point.altitude_m = origin.altitude_m + at_m.z;
                let grid_deg = heading_deg(forward.x, forward.y);
                let heading_deg = within_turn(grid_deg + convergence_rad.to_degrees());
                Ok(GeoPose { point, heading_deg })
            }
        }
    }

    /// Position in the world, in metres, of a point of the earth: the inverse of [`GeoAnchor::locate`].
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
                let [easting_m, northing_m] = zone.of_geodetic(point);
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

/// The same longitude from -180 to below 180 degrees.
fn wrapped_deg(longitude_deg: f64) -> f64 {
    (longitude_deg + 180.0).rem_euclid(360.0) - 180.0
}

/// Degrees from north to the east, 0 to 360.
fn heading_deg(east: f64, north: f64) -> f64 {
    within_turn(east.atan2(north).to_degrees())
}

/// The same angle from 0 to below 360 degrees.
fn within_turn(angle_deg: f64) -> f64 {
    // The remainder of a tiny negative angle rounds to 360.
    Some(angle_deg.rem_euclid(360.0)).filter(|angle_deg| *angle_deg < 360.0).unwrap_or(0.0)
}

/// Earth-centred coordinates of a point, in metres.
fn to_ecef(point: &GeoPoint) -> DVec3 {
    let (sin_lat, cos_lat) = point.latitude_deg.to_radians().sin_cos();
    let (sin_lon, cos_lon) = point.longitude_deg.to_radians().sin_cos();
    // Radius of curvature in the prime vertical.
    let radius_m = A_M / (1.0 - E2 * sin_lat * sin_lat).sqrt();
    let across_m = (radius_m + point.altitude_m) * cos_lat;
    let z_m = (radius_m * (1.0 - E2) + point.altitude_m) * sin_lat;
    DVec3::new(across_m * cos_lon, across_m * sin_lon, z_m)
}

/// The east, north and up axes at a point, in earth-centred coordinates.
fn enu_axes(point: &GeoPoint) -> DMat3 {
    let (sin_lat, cos_lat) = point.latitude_deg.to_radians().sin_cos();
    let (sin_lon, cos_lon) = point.longitude_deg.to_radians().sin_cos();
    let east = DVec3::new(-sin_lon, cos_lon, 0.0);
    let north = DVec3::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat);
    let up = DVec3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat);
    DMat3::from_cols(east, north, up)
}

/// The point of WGS84 at earth-centred coordinates, by Bowring's iteration on the parametric latitude β:
/// `tan φ = (z + e'² b sin³ β) / (p - e² a cos³ β)`. Three rounds are exact to rounding within 100 km of the ellipsoid.
fn to_geodetic(ecef_m: DVec3) -> GeoPoint {
    let minor_m = A_M * (1.0 - F);
    let second_e2 = E2 / (1.0 - E2);
    let p_m = ecef_m.x.hypot(ecef_m.y);
    let mut beta_rad = (ecef_m.z * A_M).atan2(p_m * minor_m);
    let mut latitude_rad = 0.0;
    for _ in 0..3 {
        let (sin, cos) = beta_rad.sin_cos();
        let rise_m = ecef_m.z + second_e2 * minor_m * sin.powi(3);
        let run_m = p_m - E2 * A_M * cos.powi(3);
        latitude_rad = rise_m.atan2(run_m);
        beta_rad = ((1.0 - F) * latitude_rad.sin()).atan2(latitude_rad.cos());
    }
    let (sin, cos) = latitude_rad.sin_cos();
    let altitude_m = p_m * cos + ecef_m.z * sin - A_M * (1.0 - E2 * sin * sin).sqrt();
    GeoPoint {
        latitude_deg: latitude_rad.to_degrees(),
        longitude_deg: ecef_m.y.atan2(ecef_m.x).to_degrees(),
        altitude_m,
    }
}

/// Krüger's coefficients α, which take the conformal sphere to the plane (Karney 2011, equation 35).
const ALPHA: [[f64; 6]; 6] = [
    [0.5, -2.0 / 3.0, 5.0 / 16.0, 41.0 / 180.0, -127.0 / 288.0, 7_891.0 / 37_800.0],
    [0.0, 13.0 / 48.0, -3.0 / 5.0, 557.0 / 1_440.0, 281.0 / 630.0, -1_983_433.0 / 1_935_360.0],
    [0.0, 0.0, 61.0 / 240.0, -103.0 / 140.0, 15_061.0 / 26_880.0, 167_603.0 / 181_440.0],
    [0.0, 0.0, 0.0, 49_561.0 / 161_280.0, -179.0 / 168.0, 6_601_661.0 / 7_257_600.0],
    [0.0, 0.0, 0.0, 0.0, 34_729.0 / 80_640.0, -3_418_889.0 / 1_995_840.0],
    [0.0, 0.0, 0.0, 0.0, 0.0, 212_378_941.0 / 319_334_400.0],
];

/// Krüger's coefficients β, which take the plane to the conformal sphere (Karney 2011, equation 36).
const BETA: [[f64; 6]; 6] = [
    [0.5, -2.0 / 3.0, 37.0 / 96.0, -1.0 / 360.0, -81.0 / 512.0, 96_199.0 / 604_800.0],
    [0.0, 1.0 / 48.0, 1.0 / 15.0, -437.0 / 1_440.0, 46.0 / 105.0, -1_118_711.0 / 3_870_720.0],
    [0.0, 0.0, 17.0 / 480.0, -37.0 / 840.0, -209.0 / 4_480.0, 5_569.0 / 90_720.0],
    [0.0, 0.0, 0.0, 4_397.0 / 161_280.0, -11.0 / 504.0, -830_251.0 / 7_257_600.0],
    [0.0, 0.0, 0.0, 0.0, 4_583.0 / 161_280.0, -108_847.0 / 3_991_680.0],
    [0.0, 0.0, 0.0, 0.0, 0.0, 20_648_693.0 / 638_668_800.0],
];

/// The coefficients at the flattening of WGS84.
fn at_n(series: &[[f64; 6]; 6]) -> [f64; 6] {
    series.map(|row| row.iter().rev().fold(0.0, |sum, coefficient| (sum + coefficient) * N))
}

/// Radius of the sphere whose meridian is as long as that of WGS84, in metres (Karney 2011, equation 14).
fn rectifying_radius_m() -> f64 {
    let n2 = N * N;
    A_M / (1.0 + N) * (1.0 + n2 / 4.0 + n2 * n2 / 64.0 + n2 * n2 * n2 / 256.0)
}

impl UtmZone {
    fn named(name: &str) -> Result<Self, GeoError> {
        let code = name.strip_prefix("EPSG:").and_then(|code| code.parse::<u32>().ok());
        match code {
            Some(code @ 32_601..=32_660) => Ok(Self { number: code - 32_600, is_south: false }),
            Some(code @ 32_701..=32_760) => Ok(Self { number: code - 32_700, is_south: true }),
            _ => Err(GeoError::Projection { name: name.to_owned() }),
        }
    }

    fn central_meridian_deg(self) -> f64 {
        6.0 * f64::from(self.number) - 183.0
    }

    fn false_northing_m(self) -> f64 {
        if self.is_south { UTM_SOUTH_NORTHING_M } else { 0.0 }
    }

    /// The point of WGS84 at an easting and a northing, with altitude 0, and the angle from true north to grid
    /// north, clockwise, in radians.
    fn to_geodetic(self, easting_m: f64, northing_m: f64) -> (GeoPoint, f64) {
        let scale_m = UTM_SCALE * rectifying_radius_m();
        let xi = (northing_m - self.false_northing_m()) / scale_m;
        let eta = (easting_m - UTM_EASTING_M) / scale_m;
        // The plane to the conformal sphere, and the derivative of that map (Karney 2011, equation 11 and 24).
        let mut xi_sphere = xi;
        let mut eta_sphere = eta;
        let (mut p, mut q) = (1.0, 0.0);
        for (index, beta) in at_n(&BETA).into_iter().enumerate() {
            let k = 2.0 * (index + 1) as f64;
            xi_sphere -= beta * (k * xi).sin() * (k * eta).cosh();
            eta_sphere -= beta * (k * xi).cos() * (k * eta).sinh();
            p -= k * beta * (k * xi).cos() * (k * eta).cosh();
            q += k * beta * (k * xi).sin() * (k * eta).sinh();
        }
        let (sinh, cos) = (eta_sphere.sinh(), xi_sphere.cos());
        let conformal_tan = xi_sphere.sin() / sinh.hypot(cos);
        let longitude_rad = sinh.atan2(cos);
        let latitude_rad = of_conformal(conformal_tan);
        let convergence_rad = (xi_sphere.tan() * eta_sphere.tanh()).atan() + q.atan2(p);
        let point = GeoPoint {
            latitude_deg: latitude_rad.to_degrees(),
            longitude_deg: wrapped_deg(self.central_meridian_deg() + longitude_rad.to_degrees()),
            altitude_m: 0.0,
        };
        (point, convergence_rad)
    }

    /// Easting and northing of a point of WGS84, in metres.
    fn of_geodetic(self, point: &GeoPoint) -> [f64; 2] {
        let longitude_rad = (point.longitude_deg - self.central_meridian_deg()).to_radians();
        let tan = conformal_tan(point.latitude_deg.to_radians());
        let (sin_lon, cos_lon) = longitude_rad.sin_cos();
        let xi_sphere = tan.atan2(cos_lon);
        let eta_sphere = (sin_lon / tan.hypot(cos_lon)).asinh();
        let (mut xi, mut eta) = (xi_sphere, eta_sphere);
        for (index, alpha) in at_n(&ALPHA).into_iter().enumerate() {
            let k = 2.0 * (index + 1) as f64;
            xi += alpha * (k * xi_sphere).sin() * (k * eta_sphere).cosh();
            eta += alpha * (k * xi_sphere).cos() * (k * eta_sphere).sinh();
        }
        let scale_m = UTM_SCALE * rectifying_radius_m();
        [UTM_EASTING_M + scale_m * eta, self.false_northing_m() + scale_m * xi]
    }
}

/// Tangent of the conformal latitude (Karney 2011, equations 7 to 9).
fn conformal_tan(latitude_rad: f64) -> f64 {
    let tan = latitude_rad.tan();
    let e = E2.sqrt();
    let sigma = (e * (e * tan / tan.hypot(1.0)).atanh()).sinh();
    tan * sigma.hypot(1.0) - sigma * tan.hypot(1.0)
}

/// The latitude, in radians, of the tangent of a conformal latitude: Newton's method, which converges to rounding
/// in three rounds (Karney 2011, equations 19 to 21).
fn of_conformal(wanted_tan: f64) -> f64 {
    let mut tan = wanted_tan;
    for _ in 0..4 {
        let found = conformal_tan(tan.atan());
        let slope =
            (1.0 + (1.0 - E2) * tan * tan) / ((1.0 - E2) * found.hypot(1.0) * tan.hypot(1.0));
        tan += (wanted_tan - found) * slope;
    }
    tan.atan()
}

/// Reads `LATITUDE,LONGITUDE[,ALTITUDE]` in degrees and metres, or `EPSG:CODE,EASTING,NORTHING[,ALTITUDE]` in
/// metres.
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

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    /// Origin (latitude, longitude, altitude), position in its tangent plane, and that point: by PROJ 9.5
    /// (`+proj=topocentric`), whose own inverse is exact to about 1e-8 m.
    const TOPOCENTRIC: [([f64; 3], [f64; 3], [f64; 3]); 15] = [
        (
            [52.5162, 13.3777, 34.0],
            [0.0, 0.0, 0.0],
            [52.5162000000000, 13.3777000000000, 34.000000000],
        ),
        (
            [52.5162, 13.3777, 34.0],
            [1500.0, -820.5, 12.25],
            [52.5088245047702, 13.3997922452681, 46.478805781],
        ),
        (
            [52.5162, 13.3777, 34.0],
            [-25000.0, 40000.0, 150.0],
            [52.8750564866755, 13.0064175457977, 358.357379818],
        ),
        ([-33.8568, 151.2153, 5.0], [0.0, 0.0, 0.0], [-33.856_8, 151.215_3, 5.000000000]),
        (
            [-33.8568, 151.2153, 5.0],
            [1500.0, -820.5, 12.25],
            [-33.8641961458479, 151.2315106439513, 17.479165527],
        ),
        (
            [-33.8568, 151.2153, 5.0],
            [-25000.0, 40000.0, 150.0],
            [-33.4958900840567, 150.9462843422943, 329.821766813],
        ),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0000000000000, 0.0000000000000, 0.000000000]),
        (
            [0.0, 0.0, 0.0],
            [1500.0, -820.5, 12.25],
            [-0.0074203369630, 0.0134747031335, 12.479514647],
        ),
        (
            [0.0, 0.0, 0.0],
            [-25000.0, 40000.0, 150.0],
            [0.3617315743570, -0.2245723895259, 325.262725256],
        ),
        (
            [64.1466, -21.9426, 1200.0],
            [0.0, 0.0, 0.0],
            [64.1466000000001, -21.9426000000000, 1200.000000012],
        ),
        (
            [64.1466, -21.9426, 1200.0],
            [1500.0, -820.5, 12.25],
            [64.1392380484639, -21.9117974917613, 1212.478561588],
        ),
        (
            [64.1466, -21.9426, 1200.0],
            [-25000.0, 40000.0, 150.0],
            [64.5044019960229, -22.4627987726903, 1524.068812202],
        ),
        ([-77.85, 166.67, 30.0], [0.0, 0.0, 0.0], [-77.85, 166.67, 29.999999999]),
        (
            [-77.85, 166.67, 30.0],
            [1500.0, -820.5, 12.25],
            [-77.8573418846524, 166.7338540101861, 42.478439325],
        ),
        (
            [-77.85, 166.67, 30.0],
            [-25000.0, 40000.0, 150.0],
            [-77.4897567392669, 165.6365449178389, 353.896703038],
        ),
    ];

    /// UTM zone, easting and northing, latitude and longitude, and meridian convergence in degrees: by PROJ 9.5.
    const UTM: [(&str, [f64; 2], [f64; 2], f64); 6] = [
        ("EPSG:32633", [391779.0, 5820076.5], [52.5200389577798, 13.4049947675464], -1.2658642168),
        (
            "EPSG:32756",
            [334900.0, 6252300.25],
            [-33.8566962673666, 151.2152960012971],
            0.9945149782,
        ),
        ("EPSG:32601", [500000.0, 0.0], [0.0000000000000, -177.0000000000000], -0.0000000000),
        (
            "EPSG:32660",
            [720000.0, 9200000.0],
            [82.5873256548401, -167.5453602366381],
            15.3315832802,
        ),
        (
            "EPSG:32719",
            [166021.5, 1116915.0],
            [-79.5796153662859, -85.7635305730360],
            16.5022155700,
        ),
        ("EPSG:32632", [833000.5, 7300000.0], [65.6488478385064, 16.2503979593914], 6.6113753936),
    ];

    fn point([latitude_deg, longitude_deg, altitude_m]: [f64; 3]) -> GeoPoint {
        GeoPoint { latitude_deg, longitude_deg, altitude_m }
    }

    fn facing(position_m: DVec3, yaw_rad: f64) -> Pose {
        Pose { position_m, rotation: DQuat::from_rotation_z(yaw_rad) }
    }

    #[test]
    fn points_of_a_tangent_plane_are_those_of_proj() {
        for (origin, xyz_m, expected) in TOPOCENTRIC {
            let anchor = GeoAnchor::Origin(point(origin));
            anchor.check().unwrap();
            let at = facing(DVec3::from_array(xyz_m), 0.0);
            let GeoPoint { latitude_deg, longitude_deg, altitude_m } =
                anchor.locate(&at).unwrap().point;
            assert!((latitude_deg - expected[0]).abs() < 2e-12, "{latitude_deg}, {expected:?}");
            assert!((longitude_deg - expected[1]).abs() < 2e-12, "{longitude_deg}, {expected:?}");
            assert!((altitude_m - expected[2]).abs() < 3e-8, "{altitude_m}, {expected:?}");
            let back_m = anchor.position_m(&anchor.locate(&at).unwrap().point).unwrap();
            assert!((back_m - at.position_m).length() < 1e-8, "{back_m}");
        }
    }

    #[test]
    fn points_of_utm_are_those_of_proj() {
        for (zone, [easting_m, northing_m], [latitude_deg, longitude_deg], convergence) in UTM {
            let anchor: GeoAnchor =
                format!("{zone},{},{}", easting_m - 10.0, northing_m).parse().unwrap();
            let at = facing(DVec3::new(10.0, 0.0, 3.0), std::f64::consts::FRAC_PI_2);
            let GeoPose { point, heading_deg } = anchor.locate(&at).unwrap();
            assert!((point.latitude_deg - latitude_deg).abs() < 1e-12, "{zone}: {point:?}");
            assert!((point.longitude_deg - longitude_deg).abs() < 1e-12, "{zone}: {point:?}");
            assert_eq!(point.altitude_m, 3.0);
            // A rig that faces grid north has the convergence as its heading.
            let off_deg = (heading_deg - convergence + 180.0).rem_euclid(360.0) - 180.0;
            assert!(off_deg.abs() < 1e-9, "{zone}: {heading_deg}, {convergence}");
            let back_m = anchor.position_m(&point).unwrap();
            assert!((back_m - at.position_m).length() < 2e-8, "{zone}: {back_m}");
        }
    }

    #[test]
    fn headings_are_from_north_to_the_east() {
        let anchor: GeoAnchor = "52.5,13.4,34".parse().unwrap();
        for (yaw_deg, expected) in
            [(90.0, 0.0), (0.0, 90.0), (180.0, 270.0), (-90.0, 180.0), (45.0, 45.0)]
        {
            let at = facing(DVec3::ZERO, f64::to_radians(yaw_deg));
            let found = anchor.locate(&at).unwrap().heading_deg;
            let off_deg = (found - expected + 180.0).rem_euclid(360.0) - 180.0;
            assert!(off_deg.abs() < 1e-9, "{yaw_deg}: {found}");
        }
        // 40 km to the east, the meridian is turned by 0.59 degrees of longitude times the sine of the latitude.
        let far =
            anchor.locate(&facing(DVec3::new(40_000.0, 0.0, 0.0), std::f64::consts::FRAC_PI_2));
        let far = far.unwrap();
        let turned_deg = (far.point.longitude_deg - 13.4) * 52.5f64.to_radians().sin();
        assert!((far.heading_deg - turned_deg).abs() < 2e-3, "{far:?}, {turned_deg}");
    }

    #[test]
    fn what_is_no_anchor_is_refused() {
        for text in ["", "52.5", "52.5,13.4,1,2", "x,13", "EPSG:32633", "EPSG:32633,1"] {
            let refused = text.parse::<GeoAnchor>().unwrap_err();
            assert!(matches!(refused, GeoError::Malformed { .. }), "{text}: {refused}");
        }
        for (text, named) in [
            ("91,0", "latitude_deg"),
            ("0,181", "longitude_deg"),
            ("0,NaN", "longitude_deg"),
            ("EPSG:3857,0,0", "projection"),
            ("EPSG:32661,500000,0", "projection"),
            ("EPSG:32633,0,0", "easting_m"),
        ] {
            let said = text.parse::<GeoAnchor>().unwrap_err().to_string();
            assert!(said.contains(named), "{text}: {said}");
        }
    }
}
