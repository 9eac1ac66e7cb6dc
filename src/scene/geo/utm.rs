//! Zones of UTM: the transverse Mercator projection is Krüger's series in the third flattening n to
//! order 6 (Karney, "Transverse Mercator with an accuracy of a few nanometers", 2011, equations 35
//! and 36), which is exact to 5 nm within 3,900 km of the central meridian.

use super::ellipsoid::{A_M, E2, N};
use super::{GeoError, GeoPoint};

/// Scale of UTM on its central meridian.
const UTM_SCALE: f64 = 0.9996;

/// False easting of UTM, in metres.
const UTM_EASTING_M: f64 = 500_000.0;

/// False northing of UTM in the southern hemisphere, in metres.
const UTM_SOUTH_NORTHING_M: f64 = 1e7;

/// A UTM zone of one hemisphere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct UtmZone {
    /// From 1 at 180° west to 60, each 6° wide.
    number: u32,
    is_south: bool,
}

/// A longitude as a value from -180 to below 180 degrees.
fn wrapped_deg(longitude_deg: f64) -> f64 {
    (longitude_deg + 180.0).rem_euclid(360.0) - 180.0
}

/// Krüger's coefficients α, which take the conformal sphere to the plane (Karney 2011, equation
/// 35).
const ALPHA: [[f64; 6]; 6] = [
    [0.5, -2.0 / 3.0, 5.0 / 16.0, 41.0 / 180.0, -127.0 / 288.0, 7_891.0 / 37_800.0],
    [0.0, 13.0 / 48.0, -3.0 / 5.0, 557.0 / 1_440.0, 281.0 / 630.0, -1_983_433.0 / 1_935_360.0],
    [0.0, 0.0, 61.0 / 240.0, -103.0 / 140.0, 15_061.0 / 26_880.0, 167_603.0 / 181_440.0],
    [0.0, 0.0, 0.0, 49_561.0 / 161_280.0, -179.0 / 168.0, 6_601_661.0 / 7_257_600.0],
    [0.0, 0.0, 0.0, 0.0, 34_729.0 / 80_640.0, -3_418_889.0 / 1_995_840.0],
    [0.0, 0.0, 0.0, 0.0, 0.0, 212_378_941.0 / 319_334_400.0],
];

/// Krüger's coefficients β, which take the plane to the conformal sphere (Karney 2011, equation
/// 36).
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
    // Horner's scheme from the highest power. The first coefficient belongs to n and not to 1, so
    // that each round also multiplies the sum by n.
    series.map(|row| row.iter().rev().fold(0.0, |sum, coefficient| (sum + coefficient) * N))
}

/// Radius of the sphere whose meridian is as long as that of WGS84, in metres (Karney 2011,
/// equation 14).
fn rectifying_radius_m() -> f64 {
    let n2 = N * N;
    A_M / (1.0 + N) * (1.0 + n2 / 4.0 + n2 * n2 / 64.0 + n2 * n2 * n2 / 256.0)
}

impl UtmZone {
    pub(super) fn named(name: &str) -> Result<Self, GeoError> {
        let code = name.strip_prefix("EPSG:").and_then(|code| code.parse::<u32>().ok());
        match code {
            Some(code @ 32_601..=32_660) => Ok(Self { number: code - 32_600, is_south: false }),
            Some(code @ 32_701..=32_760) => Ok(Self { number: code - 32_700, is_south: true }),
            _ => Err(GeoError::Projection { name: name.to_owned() }),
        }
    }

    fn central_meridian_deg(self) -> f64 {
        // Zone 1 covers 180 to 174 degrees west; its middle is at 177 degrees west.
        6.0 * f64::from(self.number) - 183.0
    }

    fn false_northing_m(self) -> f64 {
        if self.is_south { UTM_SOUTH_NORTHING_M } else { 0.0 }
    }

    /// The point of WGS84 at an easting and a northing, with altitude 0, and the angle from true
    /// north to grid north, clockwise, in radians.
    pub(super) fn to_geodetic(self, easting_m: f64, northing_m: f64) -> (GeoPoint, f64) {
        let scale_m = UTM_SCALE * rectifying_radius_m();
        let xi = (northing_m - self.false_northing_m()) / scale_m;
        let eta = (easting_m - UTM_EASTING_M) / scale_m;
        // The plane to the conformal sphere, and the derivative of that map (Karney 2011, equation
        // 11 and 24).
        let mut xi_sphere = xi;
        let mut eta_sphere = eta;
        let mut p = 1.0;
        let mut q = 0.0;
        // Terms of order 2, 4, .., 12 of ξ and η, and at the same time of their derivative p - i q,
        // whose argument is a part of the convergence.
        for (index, beta) in at_n(&BETA).into_iter().enumerate() {
            let k = 2.0 * (index + 1) as f64;
            xi_sphere -= beta * (k * xi).sin() * (k * eta).cosh();
            eta_sphere -= beta * (k * xi).cos() * (k * eta).sinh();
            p -= k * beta * (k * xi).cos() * (k * eta).cosh();
            q += k * beta * (k * xi).sin() * (k * eta).sinh();
        }
        let sinh = eta_sphere.sinh();
        let cos = xi_sphere.cos();
        let conformal_tan = xi_sphere.sin() / sinh.hypot(cos);
        let longitude_rad = sinh.atan2(cos);
        let latitude_rad = geodetic_latitude(conformal_tan);
        // The convergence of the spherical projection, and the rotation by the series.
        let convergence_rad = (xi_sphere.tan() * eta_sphere.tanh()).atan() + q.atan2(p);
        let point = GeoPoint {
            latitude_deg: latitude_rad.to_degrees(),
            longitude_deg: wrapped_deg(self.central_meridian_deg() + longitude_rad.to_degrees()),
            altitude_m: 0.0,
        };
        (point, convergence_rad)
    }

    /// Easting and northing of a point of WGS84, in metres.
    pub(super) fn project(self, point: &GeoPoint) -> [f64; 2] {
        let longitude_rad = (point.longitude_deg - self.central_meridian_deg()).to_radians();
        let tan = conformal_tan(point.latitude_deg.to_radians());
        let (sin_lon, cos_lon) = longitude_rad.sin_cos();
        // The transverse projection of the sphere; its inverse is at the end of `to_geodetic`.
        let xi_sphere = tan.atan2(cos_lon);
        let eta_sphere = (sin_lon / tan.hypot(cos_lon)).asinh();
        let mut xi = xi_sphere;
        let mut eta = eta_sphere;
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

/// The latitude, in radians, of the tangent of a conformal latitude: Newton's method, which
/// converges to rounding in three rounds (Karney 2011, equations 19 to 21).
fn geodetic_latitude(wanted_tan: f64) -> f64 {
    let mut tan = wanted_tan;
    // One round more than needed, so that the result does not depend on how close the start is.
    for _ in 0..4 {
        let found = conformal_tan(tan.atan());
        let slope =
            (1.0 + (1.0 - E2) * tan * tan) / ((1.0 - E2) * found.hypot(1.0) * tan.hypot(1.0));
        tan += (wanted_tan - found) * slope;
    }
    tan.atan()
}
