//! OpenCV's fisheye: the angle off the axis, not its tangent, decides how far from the principal point
//! a ray lands.

use glam::{DVec2, DVec3};

use super::monotone::{MonotonePolynomial, TERMS};
use super::{CameraError, WIDEST_RAD};

/// `r = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`, in focal lengths (Kannala and Brandt 2006; OpenCV's
/// `fisheye` module), for the angle θ off the axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fisheye {
    k: [f64; 4],
    max_angle_rad: Option<f64>,
    radius: MonotonePolynomial,
}

impl Fisheye {
    /// With coefficients k1 to k4, up to `max_angle_rad` off the axis, or as far as the polynomial
    /// rises.
    pub fn new(k: [f64; 4], max_angle_rad: Option<f64>) -> Self {
        let mut coefficients = [0.0; TERMS];
        coefficients[1] = 1.0;
        for (k, to) in k.into_iter().zip([3, 5, 7, 9]) {
            coefficients[to] = k;
        }
        let radius = MonotonePolynomial::new(coefficients, max_angle_rad.unwrap_or(WIDEST_RAD));
        Self { k, max_angle_rad, radius }
    }

    /// k1 to k4.
    pub fn k(&self) -> [f64; 4] {
        self.k
    }

    /// The angle off the axis that was asked for, if one was.
    pub fn max_angle_rad(&self) -> Option<f64> {
        self.max_angle_rad
    }

    /// The distance from the axis in focal lengths, by the angle off it in radians.
    pub fn radius(&self) -> &MonotonePolynomial {
        &self.radius
    }

    /// How far off the axis it sees.
    pub fn limit_rad(&self) -> f64 {
        self.radius.end()
    }

    pub(super) fn check(&self) -> Result<(), CameraError> {
        super::check_numbers("lens.k", &self.k)?;
        super::check_max_angle(self.max_angle_rad)?;
        super::check_field("lens", self.limit_rad())
    }

    /// Where a direction lands, in focal lengths; beyond the limit it goes on straight.
    #[inline(always)]
    pub(super) fn plane(&self, direction: DVec3) -> DVec2 {
        radial(direction, |angle_rad| self.radius.at(angle_rad), self.radius.slope(0.0))
    }

    /// The unit direction that lands there, if it is within the limit.
    pub(super) fn direction(&self, plane: DVec2) -> Option<DVec3> {
        at_angle(plane, self.radius.invert(plane.length()), self.limit_rad())
    }
}

/// `r(θ)` along the direction's own azimuth; `central` is the slope of `r` at 0.
#[inline(always)]
pub(super) fn radial(direction: DVec3, r: impl Fn(f64) -> f64, central: f64) -> DVec2 {
    let off_axis = direction.truncate().length();
    if off_axis < 1e-12 * direction.z {
        return direction.truncate() * (central / direction.z);
    }
    azimuth(direction) * r(off_axis.atan2(direction.z))
}

/// The unit vector across the axis towards which a direction lies. Straight behind there is none: within a
/// thousandth of that it goes to 0, so that what reaches there on either side is no tear.
#[inline(always)]
pub(super) fn azimuth(direction: DVec3) -> DVec2 {
    let least = (-1e-3 * direction.z).max(1e-300);
    direction.truncate() / direction.truncate().length().max(least)
}

/// The unit direction at an angle off the axis along an azimuth, if that is within a limit.
pub(super) fn at_angle(azimuth: DVec2, angle_rad: f64, limit_rad: f64) -> Option<DVec3> {
    // What was projected at the very limit comes back off by some ulps.
    let seen = angle_rad <= limit_rad * (1.0 + 1e-12);
    let (sin, cos) = angle_rad.sin_cos();
    let azimuth = azimuth.try_normalize().unwrap_or(DVec2::ZERO);
    seen.then(|| (azimuth * sin).extend(cos))
}
