//! The ellipsoid of WGS84: earth-centred coordinates of its points.

use glam::{DMat3, DVec3};

use super::GeoPoint;

/// Semi-major axis of WGS84, in metres.
pub(super) const A_M: f64 = 6_378_137.0;

/// Flattening of WGS84: by how much of the semi-major axis the poles are nearer.
pub(super) const F: f64 = 1.0 / 298.257_223_563;

/// Square of the first eccentricity.
pub(super) const E2: f64 = F * (2.0 - F);

/// Third flattening, `(a - b)/(a + b)`: the series of UTM are in its powers.
pub(super) const N: f64 = F / (2.0 - F);

/// Earth-centred coordinates of a point, in metres.
pub(super) fn to_ecef(point: &GeoPoint) -> DVec3 {
    let (sin_lat, cos_lat) = point.latitude_deg.to_radians().sin_cos();
    let (sin_lon, cos_lon) = point.longitude_deg.to_radians().sin_cos();
    // Radius of curvature in the prime vertical.
    let radius_m = A_M / (1.0 - E2 * sin_lat * sin_lat).sqrt();
    let across_m = (radius_m + point.altitude_m) * cos_lat;
    let z_m = (radius_m * (1.0 - E2) + point.altitude_m) * sin_lat;
    DVec3::new(across_m * cos_lon, across_m * sin_lon, z_m)
}

/// The east, north and up axes at a point, in earth-centred coordinates.
pub(super) fn enu_axes(point: &GeoPoint) -> DMat3 {
    let (sin_lat, cos_lat) = point.latitude_deg.to_radians().sin_cos();
    let (sin_lon, cos_lon) = point.longitude_deg.to_radians().sin_cos();
    let east = DVec3::new(-sin_lon, cos_lon, 0.0);
    let north = DVec3::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat);
    let up = DVec3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat);
    DMat3::from_cols(east, north, up)
}

/// The point of WGS84 at earth-centred coordinates, by Bowring's iteration on the parametric
/// latitude β: `tan φ = (z + e'² b sin³ β) / (p - e² a cos³ β)`. Three rounds are exact to rounding
/// within 100 km of the ellipsoid.
pub(super) fn to_geodetic(ecef_m: DVec3) -> GeoPoint {
    let minor_m = A_M * (1.0 - F);
    let second_e2 = E2 / (1.0 - E2);
    let p_m = ecef_m.x.hypot(ecef_m.y);
    // The start is exact on the ellipsoid: tan β = z a / (p b), from tan β = (b/a) tan φ and p tan
    // φ (1 - e²) = z.
    let mut beta_rad = (ecef_m.z * A_M).atan2(p_m * minor_m);
    let mut latitude_rad = 0.0;
    for _ in 0..3 {
        let (sin, cos) = beta_rad.sin_cos();
        let rise_m = ecef_m.z + second_e2 * minor_m * sin.powi(3);
        let run_m = p_m - E2 * A_M * cos.powi(3);
        latitude_rad = rise_m.atan2(run_m);
        // tan β = (1 - f) tan φ, by atan2, which has no pole at 90 degrees.
        beta_rad = ((1.0 - F) * latitude_rad.sin()).atan2(latitude_rad.cos());
    }
    let (sin, cos) = latitude_rad.sin_cos();
    // h = p cos φ + z sin φ - a sqrt(1 - e² sin² φ), which is stable at the equator and at the
    // poles, where p / cos φ is not.
    let altitude_m = p_m * cos + ecef_m.z * sin - A_M * (1.0 - E2 * sin * sin).sqrt();
    GeoPoint {
        latitude_deg: latitude_rad.to_degrees(),
        longitude_deg: ecef_m.y.atan2(ecef_m.x).to_degrees(),
        altitude_m,
    }
}
