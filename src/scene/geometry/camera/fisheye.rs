//! OpenCV's fisheye model: the distance from the principal point is a polynomial of the angle off
//! the axis, not of its tangent.

use glam::{DVec2, DVec3};

use super::monotone::{MonotonePolynomial, TERMS};
use super::{CameraError, WIDEST_RAD};

/// `r = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)` for the angle θ off the axis; r is the distance from
/// the principal point in focal lengths (Kannala and Brandt 2006; OpenCV's `fisheye` module).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fisheye {
    k: [f64; 4],
    max_angle_rad: Option<f64>,
    radius: MonotonePolynomial,
}

impl Fisheye {
    /// A lens with coefficients k1 to k4. Its field ends at `max_angle_rad` off the axis, or where
    /// the polynomial stops rising, whichever is less.
    pub fn new(k: [f64; 4], max_angle_rad: Option<f64>) -> Self {
        let mut coefficients = [0.0; TERMS];
        coefficients[1] = 1.0;
        for (k, to) in k.into_iter().zip([3, 5, 7, 9]) {
            coefficients[to] = k;
        }
        // The polynomial has only odd powers, so that it continues smoothly through the axis.
        // Coefficient 1 is 1: r is in focal lengths.
        let radius = MonotonePolynomial::new(coefficients, max_angle_rad.unwrap_or(WIDEST_RAD));
        Self { k, max_angle_rad, radius }
    }

    /// The coefficients k1 to k4 of the angle to the powers 3, 5, 7 and 9.
    pub fn k(&self) -> [f64; 4] {
        self.k
    }

    /// The field's limit as given, in radians off the axis.
    pub fn max_angle_rad(&self) -> Option<f64> {
        self.max_angle_rad
    }

    /// The polynomial: distance from the principal point in focal lengths, by the angle off the
    /// axis in radians.
    pub fn radius(&self) -> &MonotonePolynomial {
        &self.radius
    }

    /// End of the field, in radians off the axis.
    pub fn limit_rad(&self) -> f64 {
        self.radius.end()
    }

    pub(super) fn check(&self) -> Result<(), CameraError> {
        super::check_numbers("lens.k", &self.k)?;
        super::check_max_angle(self.max_angle_rad)?;
        super::check_field("lens", self.limit_rad())
    }

    /// Projects a direction, in focal lengths from the principal point; extrapolates linearly in
    /// the angle beyond the limit.
    #[inline(always)]
    pub(super) fn plane(&self, direction: DVec3) -> DVec2 {
        radial(direction, |angle_rad| self.radius.at(angle_rad), self.radius.slope(0.0))
    }

    /// The unit direction that projects to `plane`, or `None` beyond the limit.
    pub(super) fn direction(&self, plane: DVec2) -> Option<DVec3> {
        at_angle(plane, self.radius.invert(plane.length()), self.limit_rad())
    }
}

/// `r(θ)` along the azimuth of a direction; `central` is the slope of `r` at 0, used where the
/// direction is so close to the axis that the azimuth is numerically undefined.
#[inline(always)]
pub(super) fn radial(direction: DVec3, r: impl Fn(f64) -> f64, central: f64) -> DVec2 {
    let off_axis = direction.truncate().length();
    // Nearer to the axis than 1e-12 the azimuth is rounding noise. The linear term is exact there,
    // since the next one is of third order.
    if off_axis < 1e-12 * direction.z {
        return direction.truncate() * (central / direction.z);
    }
    azimuth(direction) * r(off_axis.atan2(direction.z))
}

/// The unit vector perpendicular to the axis that points towards a direction. Straight behind the
/// camera it is undefined; within 0.001 rad of that it fades to zero, so that the projection of a
/// Gaussian across that point stays continuous.
#[inline(always)]
pub(super) fn azimuth(direction: DVec3) -> DVec2 {
    // In front of the camera the floor is only a guard against 0/0.
    let least = (-1e-3 * direction.z).max(1e-300);
    direction.truncate() / direction.truncate().length().max(least)
}

/// The unit direction at an angle off the axis along an azimuth, or `None` beyond the limit.
pub(super) fn at_angle(azimuth: DVec2, angle_rad: f64, limit_rad: f64) -> Option<DVec3> {
    // A point projected exactly at the limit comes back with a rounding error.
    let seen = angle_rad <= limit_rad * (1.0 + 1e-12);
    let (sin, cos) = angle_rad.sin_cos();
    let azimuth = azimuth.try_normalize().unwrap_or(DVec2::ZERO);
    seen.then(|| (azimuth * sin).extend(cos))
}
