//! A windshield in front of the lens: it refracts rays by two bivariate polynomials of their
//! angles.

use glam::{DVec2, DVec3};
use wildcity_options::camera::WindshieldReference;

use super::CameraError;

/// Number of coefficients of a bivariate polynomial of order 5, the highest supported.
const MOST: usize = 21;

/// The angles `φ = asin(x/|p|)`, `θ = asin(y/|p|)` of a ray outside become `h(φ, θ)`, `v(φ, θ)`
/// inside, or the reverse (NVIDIA's public description of its bivariate windshield model).
///
/// Calibrations give polynomials for both directions; one pair is exact (the reference). Only that
/// is kept here, and inverted by fixed-point iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Windshield {
    reference: WindshieldReference,
    horizontal: Bivariate,
    vertical: Bivariate,
    most_rad: f64,
}

/// `Σ c φ^i θ^j`. Coefficients are ordered by j, and within the same j by i from 0 to order - j.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bivariate {
    coefficients: [f64; MOST],
    count: usize,
}

impl Windshield {
    /// The refraction fades out between these values of z of the unit direction: full above 0.15
    /// (81° off the axis), none below 0.05 (87°). Without a limit, the polynomials would refract
    /// rays far off the axis arbitrarily; with an abrupt one, a Gaussian across it would be torn.
    pub const FADES_Z: [f64; 2] = [0.05, 0.15];

    /// Largest accepted refraction, in radians. Real windshields refract by 0.01.
    const MOST_RAD: f64 = 0.2;

    /// Largest accepted change of the refraction between two rays, per angle between them. With 0.5
    /// the fixed-point inversion at least halves its error in each step. Real windshields have
    /// 0.02, and 0.26 far above and below the image.
    const MOST_CHANGE: f64 = 0.5;

    /// Steps of the inversion: an error of 2^-52 at worst.
    const STEPS: u32 = 52;

    /// Number of angles off the axis, up to 87°, and of azimuths at which a windshield is checked.
    const RINGS: u32 = 128;
    const AZIMUTHS: u32 = 64;

    /// A windshield with coefficients in the order of [`Bivariate`].
    pub fn new(reference: WindshieldReference, horizontal: Bivariate, vertical: Bivariate) -> Self {
        // `turned` does not need the bound, so that it can be sampled on the windshield itself.
        let mut windshield = Self { reference, horizontal, vertical, most_rad: 0.0 };
        windshield.most_rad = windshield.sampled_most_rad();
        windshield
    }

    /// A bound of the angle by which a ray is refracted, in radians: the largest of a thousand
    /// samples, and a fifth more for what lies between them.
    pub fn most_rad(&self) -> f64 {
        self.most_rad
    }

    fn sampled_most_rad(&self) -> f64 {
        let widest_rad = Self::FADES_Z[0].acos();
        let by = |ring: u32, azimuth: u32| {
            // 31 intervals from the axis to the widest angle, both included.
            let (sin, cos) = (widest_rad * f64::from(ring) / 31.0).sin_cos();
            let (y, x) = (std::f64::consts::TAU * f64::from(azimuth) / 32.0).sin_cos();
            let ray = DVec3::new(x * sin, y * sin, cos);
            let to = self.turned(angles(ray));
            let x = to.x.sin();
            let y = to.y.sin();
            DVec3::new(x, y, (1.0 - x * x - y * y).max(0.0).sqrt()).angle_between(ray)
        };
        let samples = (0..32).flat_map(|ring| (0..32).map(move |azimuth| by(ring, azimuth)));
        1.2 * samples.fold(0.0, f64::max)
    }

    /// The direction of the polynomials.
    pub fn reference(&self) -> WindshieldReference {
        self.reference
    }

    /// The polynomial of the angle to the right.
    pub fn horizontal(&self) -> &Bivariate {
        &self.horizontal
    }

    /// The polynomial of the angle downwards.
    pub fn vertical(&self) -> &Bivariate {
        &self.vertical
    }

    /// Checks the refraction of all rays within `corner_rad` of the axis, outside or inside. If it
    /// changes slowly enough everywhere, no two rays are refracted to the same one.
    pub(super) fn check(&self, corner_rad: f64) -> Result<(), CameraError> {
        super::check_numbers("windshield.horizontal", self.horizontal.coefficients())?;
        super::check_numbers("windshield.vertical", self.vertical.coefficients())?;
        let widest_rad = Self::FADES_Z[0].acos();
        // Of the image's corner, but not beyond the fade: rays there are not refracted.
        let least_z = corner_rad.min(widest_rad).cos();
        let ring_rad = widest_rad / f64::from(Self::RINGS);
        let turn_rad = std::f64::consts::TAU / f64::from(Self::AZIMUTHS);
        for ring in 0..=Self::RINGS {
            let (sin, cos) = (f64::from(ring) * ring_rad).sin_cos();
            for azimuth in 0..Self::AZIMUTHS {
                let (y, x) = (f64::from(azimuth) * turn_rad).sin_cos();
                let at = angles(DVec3::new(x * sin, y * sin, cos));
                let within = cos >= least_z || z(self.turned(at)) >= least_z;
                if within {
                    self.check_at(at)?;
                }
            }
        }
        Ok(())
    }

    /// Checks the refraction at a ray's angles: its size, and its derivative by central
    /// differences.
    fn check_at(&self, at: DVec2) -> Result<(), CameraError> {
        let refused =
            |value, must| Err(CameraError::Intrinsic { field: "windshield", value, must });
        let by = |at: DVec2| self.turned(at) - at;
        let most = by(at).length();
        let little = most <= Self::MOST_RAD;
        if !little {
            return refused(most, "a windshield refracts rays by at most 0.2 rad");
        }
        // Central differences have an error of h² times the third derivative, and a rounding error
        // of about 1e-12: both are far below the bound of 0.5.
        let h = 1e-4;
        let by_axis = [DVec2::X, DVec2::Y]
            .map(|axis| (by(at + h * axis) - by(at - h * axis)).length() / (2.0 * h));
        // The Frobenius norm, which bounds the change in any direction.
        let change = by_axis[0].hypot(by_axis[1]);
        let even = change <= Self::MOST_CHANGE;
        if !even {
            return refused(
                change,
                "the refraction of two rays differs by less than half the angle between them, also where it \
                 fades out, from 81 to 87 degrees off the axis; a max_angle below that excludes those rays",
            );
        }
        Ok(())
    }

    /// The unit direction at the lens of a direction outside.
    #[inline(always)]
    pub(super) fn inside(&self, outside: DVec3) -> DVec3 {
        self.turn(outside, WindshieldReference::Forward)
    }

    /// The unit direction outside of a direction at the lens.
    pub(super) fn outside(&self, inside: DVec3) -> DVec3 {
        self.turn(inside, WindshieldReference::Backward)
    }

    fn turn(&self, direction: DVec3, way: WindshieldReference) -> DVec3 {
        let unit = direction.normalize();
        // Here the share of the refraction is 0, and the angles of a ray behind the camera would be
        // those of its mirror image.
        if unit.z < Self::FADES_Z[0] {
            return unit;
        }
        let from = angles(unit);
        let to = if way == self.reference {
            self.turned(from)
        } else {
            // Solve turned(x) = from by fixed-point iteration; x is close to from.
            let mut x = from;
            for _ in 0..Self::STEPS {
                // The residual; with a change of at most one half it halves in each step.
                let off = self.turned(x) - from;
                x -= off;
                if off.length_squared() <= 1e-32 {
                    break;
                }
            }
            x
        };
        // From angles back to a unit direction. The clamp is for angles whose sines exceed the unit
        // circle by rounding.
        let x = to.x.sin();
        let y = to.y.sin();
        DVec3::new(x, y, (1.0 - x * x - y * y).max(0.0).sqrt()).normalize()
    }

    /// The angles after refraction: those of the polynomials, blended with the unchanged angles
    /// where the refraction fades out.
    fn turned(&self, at: DVec2) -> DVec2 {
        let [none, all] = Self::FADES_Z;
        // A linear blend in z, not in the angle: it needs no inverse cosine.
        let share = ((z(at) - none) / (all - none)).clamp(0.0, 1.0);
        at + share * (self.polynomials(at) - at)
    }

    fn polynomials(&self, angles_rad: DVec2) -> DVec2 {
        DVec2::new(self.horizontal.at(angles_rad), self.vertical.at(angles_rad))
    }
}

fn angles(unit: DVec3) -> DVec2 {
    DVec2::new(unit.x.clamp(-1.0, 1.0).asin(), unit.y.clamp(-1.0, 1.0).asin())
}

/// The z component of the unit direction with these angles; 0 where there is no such direction.
fn z(angles_rad: DVec2) -> f64 {
    (1.0 - angles_rad.x.sin().powi(2) - angles_rad.y.sin().powi(2)).max(0.0).sqrt()
}

impl Bivariate {
    /// A polynomial of order 0 to 5 from its 1, 3, 6, 10, 15 or 21 coefficients.
    ///
    /// # Errors
    /// The number of coefficients is not one of these.
    pub fn new(field: &'static str, coefficients: &[f64]) -> Result<Self, CameraError> {
        let count = coefficients.len();
        let whole = (0..=5).any(|order| (order + 1) * (order + 2) / 2 == count);
        if !whole {
            let must =
                "a polynomial of order N has (N + 1)(N + 2)/2 coefficients: 1, 3, 6, 10, 15 or 21";
            return Err(CameraError::Intrinsic { field, value: count as f64, must });
        }
        let mut padded = [0.0; MOST];
        padded[..count].copy_from_slice(coefficients);
        Ok(Self { coefficients: padded, count })
    }

    /// The coefficients as they were given.
    pub fn coefficients(&self) -> &[f64] {
        &self.coefficients[..self.count]
    }

    /// The coefficient of φ^i θ^j; 0 above the order.
    pub fn coefficient(&self, i: usize, j: usize) -> f64 {
        let order = self.order();
        // Coefficients of smaller j come first: order + 1 of j = 0, order of j = 1, and so on.
        let first = j * (order + 1) - j * j.saturating_sub(1) / 2;
        if i + j <= order { self.coefficients[first + i] } else { 0.0 }
    }

    /// The order: the highest sum of powers.
    pub fn order(&self) -> usize {
        (0..=5).find(|order| (order + 1) * (order + 2) / 2 == self.count).unwrap_or(0)
    }

    fn at(&self, angles_rad: DVec2) -> f64 {
        let order = self.order();
        let mut sum = 0.0;
        let mut power = 1.0;
        let mut rest = self.coefficients();
        for j in 0..=order {
            let (row, others) = rest.split_at(order + 1 - j);
            // Horner's scheme in φ, times θ^j.
            sum += power * row.iter().rev().fold(0.0, |sum, c| sum * angles_rad.x + c);
            power *= angles_rad.y;
            rest = others;
        }
        sum
    }
}
