//! A windshield before the lens: it turns rays by what two polynomials of their angles say.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use super::CameraError;

/// Most coefficients of a polynomial: order 5.
const MOST: usize = 21;

/// `φ = asin(x/|p|)`, `θ = asin(y/|p|)` outside become `h(φ, θ)`, `v(φ, θ)` inside, or the other way
/// (NVIDIA's public description of its bivariate windshield model).
///
/// Calibrations give polynomials both ways, of which one pair is exact. Only that is kept here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Windshield {
    reference: WindshieldReference,
    horizontal: Bivariate,
    vertical: Bivariate,
}

/// Which way the exact polynomials go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WindshieldReference {
    /// From the world's rays to the lens'.
    Forward,
    /// From the lens' rays to the world's.
    Backward,
}

/// `Σ c φ^i θ^j`, for j from 0 and, within, i from 0 to order - j.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bivariate {
    coefficients: [f64; MOST],
    count: usize,
}

impl Windshield {
    /// It turns rays in full up to 81° off the axis, and not at all from 87° on: z as a share of their
    /// length. Without an end, polynomials would turn what is beside the camera anywhere; with a sudden one,
    /// a Gaussian across it would be torn.
    pub const FADES_Z: [f64; 2] = [0.05, 0.15];

    /// How far it may turn a ray, in radians. Real ones turn by 0.01.
    const MOST_RAD: f64 = 0.2;

    /// How much the turning may differ between two rays, as a share of the angle between them: what
    /// leaves the inversion halving its error at each step. Real ones have 0.02, and 0.26 far above
    /// and below their image.
    const MOST_CHANGE: f64 = 0.5;

    /// Steps of the inversion: 2^-52 at worst.
    const STEPS: u32 = 52;

    /// Angles off the axis, up to 87°, and azimuths at which it is checked.
    const RINGS: u32 = 128;
    const AZIMUTHS: u32 = 64;

    /// With coefficients in the order of [`Bivariate`].
    pub fn new(reference: WindshieldReference, horizontal: Bivariate, vertical: Bivariate) -> Self {
        Self { reference, horizontal, vertical }
    }

    /// Which way the polynomials go.
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

    /// Checks it over every ray that is within an angle off the axis, in radians, on one side or the other:
    /// with all of them turned evenly, none is met twice.
    pub(super) fn check(&self, corner_rad: f64) -> Result<(), CameraError> {
        super::check_numbers("windshield.horizontal", self.horizontal.coefficients())?;
        super::check_numbers("windshield.vertical", self.vertical.coefficients())?;
        let widest_rad = Self::FADES_Z[0].acos();
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

    fn check_at(&self, at: DVec2) -> Result<(), CameraError> {
        let refused =
            |value, must| Err(CameraError::Intrinsic { field: "windshield", value, must });
        let by = |at: DVec2| self.turned(at) - at;
        let most = by(at).length();
        let little = most <= Self::MOST_RAD;
        if !little {
            return refused(most, "a windshield turns rays by at most 0.2 rad");
        }
        let h = 1e-4;
        let change = [DVec2::X, DVec2::Y]
            .map(|axis| (by(at + h * axis) - by(at - h * axis)).length() / (2.0 * h));
        let change = change[0].hypot(change[1]);
        let even = change <= Self::MOST_CHANGE;
        if !even {
            return refused(
                change,
                "neighbouring rays are turned by less than half their angle apart, also where the turning \
                 fades out, from 81 to 87 degrees off the axis; a max_angle below that leaves those out",
            );
        }
        Ok(())
    }

    /// The unit direction inside, of a direction outside.
    #[inline(always)]
    pub(super) fn inside(&self, outside: DVec3) -> DVec3 {
        self.turn(outside, WindshieldReference::Forward)
    }

    /// The unit direction outside, of a direction inside.
    pub(super) fn outside(&self, inside: DVec3) -> DVec3 {
        self.turn(inside, WindshieldReference::Backward)
    }

    fn turn(&self, direction: DVec3, way: WindshieldReference) -> DVec3 {
        let unit = direction.normalize();
        if unit.z < Self::FADES_Z[0] {
            return unit;
        }
        let from = angles(unit);
        let to = if way == self.reference {
            self.turned(from)
        } else {
            // turned(x) = from, where x is nearly from.
            let mut x = from;
            for _ in 0..Self::STEPS {
                let off = self.turned(x) - from;
                x -= off;
                if off.length_squared() <= 1e-32 {
                    break;
                }
            }
            x
        };
        let (x, y) = (to.x.sin(), to.y.sin());
        DVec3::new(x, y, (1.0 - x * x - y * y).max(0.0).sqrt()).normalize()
    }

    /// What becomes of a ray's angles: what the polynomials say, and less of it where the turning fades.
    fn turned(&self, at: DVec2) -> DVec2 {
        let [none, all] = Self::FADES_Z;
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

/// Of the unit direction with these angles; 0 where there is none.
fn z(angles_rad: DVec2) -> f64 {
    (1.0 - angles_rad.x.sin().powi(2) - angles_rad.y.sin().powi(2)).max(0.0).sqrt()
}

impl Bivariate {
    /// From 1, 3, 6, 10, 15 or 21 coefficients: orders 0 to 5.
    ///
    /// # Errors
    /// Another number of them.
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

    /// As they were given.
    pub fn coefficients(&self) -> &[f64] {
        &self.coefficients[..self.count]
    }

    /// That of φ^i θ^j; 0 where there is none.
    pub fn coefficient(&self, i: usize, j: usize) -> f64 {
        let order = self.order();
        // Behind those of smaller j: order + 1, order, ... of them.
        let first = j * (order + 1) - j * j.saturating_sub(1) / 2;
        if i + j <= order { self.coefficients[first + i] } else { 0.0 }
    }

    /// The highest sum of powers.
    pub fn order(&self) -> usize {
        (0..=5).find(|order| (order + 1) * (order + 2) / 2 == self.count).unwrap_or(0)
    }

    fn at(&self, angles_rad: DVec2) -> f64 {
        let order = self.order();
        let (mut sum, mut power, mut rest) = (0.0, 1.0, self.coefficients());
        for j in 0..=order {
            let (row, others) = rest.split_at(order + 1 - j);
            sum += power * row.iter().rev().fold(0.0, |sum, c| sum * angles_rad.x + c);
            (power, rest) = (power * angles_rad.y, others);
        }
        sum
    }
}
