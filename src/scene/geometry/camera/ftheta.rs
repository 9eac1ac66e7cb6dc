//! NVIDIA's f-theta model: a polynomial between the angle off the axis and the distance in pixels.

use glam::{DMat2, DVec2, DVec3};
use wildcity_options::camera::FThetaReference;

use super::CameraError;
use super::fisheye::{at_angle, radial};
use super::monotone::{MonotonePolynomial, TERMS};

/// `pixel = [[c, d], [e, 1]] r(θ) (x, y)/|(x, y)| + principal point`, for the angle
/// `θ = atan2(|(x, y)|, z)` (NVIDIA's public description of its vehicle cameras).
///
/// Calibrations give two polynomials: one is exact (the reference), the other approximates its
/// inverse. Only the reference is kept here; it is inverted with Newton's method.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FTheta {
    reference: FThetaReference,
    polynomial: [f64; 6],
    linear_cde: [f64; 3],
    max_angle_rad: f64,
    rising: MonotonePolynomial,
}

impl FTheta {
    /// Largest distance from the principal point, in pixels, so that powers of pixels stay within
    /// f64.
    const MOST_PX: f64 = 65_536.0;

    /// A lens from the coefficients of powers 0 to 5 (radians and pixels), `[c, d, e]`, and the
    /// limit of its field in radians off the axis.
    pub fn new(
        reference: FThetaReference,
        polynomial: [f64; 6],
        linear_cde: [f64; 3],
        max_angle_rad: f64,
    ) -> Self {
        let mut coefficients = [0.0; TERMS];
        coefficients[..6].copy_from_slice(&polynomial);
        let rising = match reference {
            FThetaReference::AngleToPixel => MonotonePolynomial::new(coefficients, max_angle_rad),
            FThetaReference::PixelToAngle => {
                // The end is given as an angle, and this polynomial needs it in pixels: invert on
                // the range that rises, and use less if it ends before the angle.
                let whole = MonotonePolynomial::new(coefficients, Self::MOST_PX);
                MonotonePolynomial::new(coefficients, whole.invert(max_angle_rad).min(whole.end()))
            }
        };
        Self { reference, polynomial, linear_cde, max_angle_rad, rising }
    }

    /// The direction of the polynomial.
    pub fn reference(&self) -> FThetaReference {
        self.reference
    }

    /// Coefficients of powers 0 to 5, in radians and pixels.
    pub fn polynomial(&self) -> [f64; 6] {
        self.polynomial
    }

    /// The entries `[c, d, e]` of the matrix [`FTheta::linear`].
    pub fn linear_cde(&self) -> [f64; 3] {
        self.linear_cde
    }

    /// The field's limit as given, in radians off the axis.
    pub fn max_angle_rad(&self) -> f64 {
        self.max_angle_rad
    }

    /// End of the field, in radians off the axis: at most [`FTheta::max_angle_rad`].
    pub fn limit_rad(&self) -> f64 {
        match self.reference {
            FThetaReference::AngleToPixel => self.rising.end(),
            // The range of the polynomial is in pixels; its value at the end is the angle. At an
            // end of 0 the slope is meaningless.
            FThetaReference::PixelToAngle if self.rising.end() > 0.0 => {
                self.rising.at(self.rising.end())
            }
            FThetaReference::PixelToAngle => 0.0,
        }
    }

    /// Focal lengths along x and y at the axis, in pixels.
    pub fn focal_px(&self) -> DVec2 {
        DVec2::new(self.linear_cde[0], 1.0) * self.central_px()
    }

    /// `r(θ)`: distance from the principal point in pixels, before `[[c, d], [e, 1]]`, of an angle
    /// off the axis in radians.
    #[inline(always)]
    pub fn radius_px(&self, angle_rad: f64) -> f64 {
        match self.reference {
            FThetaReference::AngleToPixel => self.rising.at(angle_rad),
            FThetaReference::PixelToAngle => self.rising.invert(angle_rad),
        }
    }

    /// The inverse of [`FTheta::radius_px`], in radians.
    pub fn angle_rad(&self, radius_px: f64) -> f64 {
        match self.reference {
            FThetaReference::AngleToPixel => self.rising.invert(radius_px),
            FThetaReference::PixelToAngle => self.rising.at(radius_px),
        }
    }

    /// The reference polynomial on the range that is used: radians to pixels or pixels to radians.
    pub fn rising(&self) -> &MonotonePolynomial {
        &self.rising
    }

    /// `[[c, d], [e, 1]]`.
    pub fn linear(&self) -> DMat2 {
        let [c, d, e] = self.linear_cde;
        DMat2::from_cols(DVec2::new(c, e), DVec2::new(d, 1.0))
    }

    /// The lens of an image that is `scale.x` times as wide and `scale.y` times as high.
    pub(super) fn scaled(&self, scale: DVec2) -> Self {
        // Scaling multiplies the matrix by diag(sx, sy). The last entry must stay 1, so that sy
        // goes into the polynomial: c and d become c sx/sy and d sx/sy, and e stays.
        let [c, d, e] = self.linear_cde;
        let wider = scale.x / scale.y;
        let mut polynomial = self.polynomial;
        for (power, coefficient) in polynomial.iter_mut().enumerate() {
            // Pixels become sy times as many: an angle polynomial is multiplied by sy; one of
            // pixels takes x / sy, that is sy^-power for each coefficient.
            *coefficient *= match self.reference {
                FThetaReference::AngleToPixel => scale.y,
                FThetaReference::PixelToAngle => scale.y.powi(-(power as i32)),
            };
        }
        Self::new(self.reference, polynomial, [c * wider, d * wider, e], self.max_angle_rad)
    }

    pub(super) fn check(&self) -> Result<(), CameraError> {
        super::check_numbers("lens.polynomial", &self.polynomial)?;
        super::check_numbers("lens.linear_cde", &self.linear_cde)?;
        super::check_max_angle(Some(self.max_angle_rad))?;
        if self.polynomial[0] != 0.0 {
            let must = "the axis lands on the principal point: the first coefficient is 0";
            let field = "lens.polynomial[0]";
            return Err(CameraError::Intrinsic { field, value: self.polynomial[0], must });
        }
        // A determinant near 0 makes the image a line; a negative one mirrors it.
        let upright = self.linear().determinant();
        let usable = self.linear_cde[0] > 0.0 && upright > 1e-3;
        if !usable {
            let must = "the determinant of [[c, d], [e, 1]] is above 0.001, and so is c";
            return Err(CameraError::Intrinsic { field: "lens.linear_cde", value: upright, must });
        }
        super::check_field("lens", self.limit_rad())
    }

    /// Projects a direction, in pixels from the principal point; extrapolates linearly in the angle
    /// beyond the limit.
    #[inline(always)]
    pub(super) fn offset_px(&self, direction: DVec3) -> DVec2 {
        self.linear() * radial(direction, |angle| self.radius_px(angle), self.central_px())
    }

    /// The unit direction that projects to `offset_px`, or `None` beyond the limit.
    pub(super) fn direction(&self, offset_px: DVec2) -> Option<DVec3> {
        let round = self.linear().inverse() * offset_px;
        at_angle(round, self.angle_rad(round.length()), self.limit_rad())
    }

    /// Pixels per radian at the axis.
    fn central_px(&self) -> f64 {
        match self.reference {
            FThetaReference::AngleToPixel => self.polynomial[1],
            FThetaReference::PixelToAngle => 1.0 / self.polynomial[1],
        }
    }
}
