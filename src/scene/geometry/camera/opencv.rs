//! OpenCV's model of ordinary lenses: a pinhole with radial, tangential and thin prism distortion.

use glam::{DMat2, DVec2, DVec3};

use super::CameraError;
use super::fisheye::azimuth;
use super::monotone::{invert_monotone, largest_valid};

/// `(x, y) -> (x, y) icD + tangential + prism` of the slopes `x/z, y/z`, with
/// `icD = (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶)` (OpenCV, `projectPoints`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OpenCv {
    k: [f64; 6],
    p: [f64; 2],
    s: [f64; 4],
    limit_slope: f64,
}

impl OpenCv {
    /// Largest slope of a ray: 82.9° off the axis, where one radian is `1 + 8²` = 65 times as many
    /// pixels as at the axis.
    pub(super) const MOST_SLOPE: f64 = 8.0;

    /// Smallest radial factor `icD`. A smaller one means that the calibration is used outside of
    /// the range that it was made for (gsplat has the same bound).
    pub(super) const LEAST_FACTOR: f64 = 0.8;

    /// Smallest derivative of the distortion in any direction, as a share of that at the axis (the
    /// same for every lens model).
    const LEAST_RISE: f64 = 0.02;

    /// Largest derivative of the distortion in any direction, as a multiple of that at the axis. A
    /// larger one means that a rational lens is close to a pole, where Gaussians that reach there
    /// would be torn over the image. For a lens with a pole, the image agrees with per-pixel rays
    /// to 49 dB at 8, 33 dB at 16 and 15 dB at 50; an Azure Kinect stays below 2.
    const MOST_RISE: f64 = 8.0;

    /// Number of steps in which the limit is searched.
    const STEPS: u32 = 2048;

    /// A lens with coefficients k1 to k6, p1 and p2, s1 to s4.
    pub fn new(k: [f64; 6], p: [f64; 2], s: [f64; 4]) -> Self {
        let mut lens = Self { k, p, s, limit_slope: 0.0 };
        // The derivative in a direction is between the radial bounds, less and plus the skew. NaN
        // at a pole fails every comparison.
        let usable = |slope: f64| {
            let [across, along] = lens.stretch(slope);
            let [tangential, prism] = lens.skew(slope);
            let skew = tangential + prism;
            across > Self::LEAST_FACTOR
                && across.min(along) - skew >= Self::LEAST_RISE
                && across.max(along) + skew <= Self::MOST_RISE
        };
        lens.limit_slope = largest_valid(usable, Self::MOST_SLOPE, Self::STEPS);
        lens
    }

    /// Whether all coefficients are zero: a pinhole.
    pub fn is_pinhole(&self) -> bool {
        self.k.iter().chain(&self.p).chain(&self.s).all(|&c| c == 0.0)
    }

    /// The radial coefficients k1 to k6.
    pub fn k(&self) -> [f64; 6] {
        self.k
    }

    /// The tangential coefficients p1 and p2.
    pub fn p(&self) -> [f64; 2] {
        self.p
    }

    /// The coefficients s1 to s4 of the thin prism.
    pub fn s(&self) -> [f64; 4] {
        self.s
    }

    /// Limit of the field, as the slope (tangent) of the angle off the axis: the largest slope, at
    /// most 8, up to which `icD` is above 0.8 and the derivative of the distortion is within its
    /// bounds.
    ///
    /// Up to there `distort` is monotone: `(distort(b) - distort(a)) . (b - a) > 0` for any two
    /// slopes, since the symmetric part of its Jacobian is positive definite on the whole disc.
    pub fn limit_slope(&self) -> f64 {
        self.limit_slope
    }

    pub(super) fn check(&self) -> Result<(), CameraError> {
        super::check_numbers("lens.k", &self.k)?;
        super::check_numbers("lens.p", &self.p)?;
        super::check_numbers("lens.s", &self.s)?;
        super::check_field(self.at_fault(), self.limit_slope.atan())
    }

    /// The coefficients that determine where the field ends, for error messages.
    pub(super) fn at_fault(&self) -> &'static str {
        let [tangential, prism] = self.skew(self.limit_slope);
        // Without skew the field would be larger: then the skew is at fault, and the larger part of
        // it is named.
        let alone = Self::new(self.k, [0.0; 2], [0.0; 4]).limit_slope;
        if alone <= self.limit_slope {
            "lens"
        } else if tangential >= prism {
            "lens.p"
        } else {
            "lens.s"
        }
    }

    /// Projects a direction, in focal lengths from the principal point. Beyond the limit, or beyond
    /// slope `straight` if that is less, it extrapolates linearly in the angle.
    #[inline(always)]
    pub(super) fn plane(&self, direction: DVec3, straight: f64) -> DVec2 {
        let end = straight.min(self.limit_slope);
        let off_axis = direction.truncate().length();
        let within = off_axis < end * direction.z;
        if within {
            return self.distort(direction.truncate() / direction.z);
        }
        let azimuth = azimuth(direction);
        let edge = azimuth * end;
        // Angle beyond the end; the slope changes by 1 + tan² per radian there, and the Jacobian
        // takes slopes to the plane.
        let beyond_rad = off_axis.atan2(direction.z) - end.atan();
        let slope_per_rad = 1.0 + end * end;
        self.distort(edge) + self.jacobian(edge) * azimuth * (slope_per_rad * beyond_rad)
    }

    /// The unit direction that projects to `plane`, or `None` beyond the limit.
    pub(super) fn direction(&self, plane: DVec2) -> Option<DVec3> {
        let most = self.limit_slope;
        // Damped Newton's method. It starts at the inverse of only the radial part, and halves each
        // step until it reduces the residual.
        // The radial part is nearly the whole distortion, so that Newton's method starts close to
        // the root.
        let mut slope = plane.normalize_or_zero() * self.radial_slope(plane.length());
        let mut off = self.distort(slope) - plane;
        // Newton's method doubles the digits in each round; 32 rounds are for starts near the fold,
        // where steps are halved.
        for _ in 0..32 {
            let mut step = self.jacobian(slope).inverse() * off;
            let mut halved = 0;
            let done = loop {
                // A little beyond the limit, so that a root at the limit is reached from both
                // sides, but not into the fold.
                let next = (slope - step).clamp_length_max(1.01 * most);
                let next_off = self.distort(next) - plane;
                if next_off.length_squared() < off.length_squared() {
                    slope = next;
                    off = next_off;
                    break step.length_squared() <= 1e-30;
                }
                // Give up if the step is negligible; `moves` is also false for NaN.
                let moves = step.length_squared() > 1e-30;
                if !moves || halved == 16 {
                    break true;
                }
                step *= 0.5;
                halved += 1;
            };
            if done {
                break;
            }
        }
        // Three tests: a root was found, it is not the mirrored one behind the fold, and it is
        // within the field.
        let lands = off.length() <= 1e-9 * (1.0 + plane.length());
        let upright = self.jacobian(slope).determinant() > 0.0;
        let seen = lands && upright && slope.length() <= most * (1.0 + 1e-12);
        seen.then(|| slope.extend(1.0).normalize())
    }

    /// The slope `r` at which `r icD(r)` equals `distance`, at most the limit.
    fn radial_slope(&self, distance: f64) -> f64 {
        let first = distance.min(self.limit_slope);
        invert_monotone(distance, first, self.limit_slope, 1e-4, |slope| {
            let [across, along] = self.stretch(slope);
            [slope * across, along]
        })
    }

    /// Derivatives of the radial part at a slope: perpendicular to the radius, and along it.
    #[inline(always)]
    fn stretch(&self, slope: f64) -> [f64; 2] {
        let (factor, rise) = self.radial(slope * slope);
        [factor, factor + 2.0 * slope * slope * rise]
    }

    /// Upper bounds of the derivatives of the tangential and of the prism distortion at a slope,
    /// over all azimuths and directions.
    ///
    /// The tangential part is the gradient of `(p2 x + p1 y) r²`, whose Hessian has eigenvalues of
    /// at most `6 |p| r`. The Jacobian of the prism part is an outer product of two vectors.
    fn skew(&self, slope: f64) -> [f64; 2] {
        let [p1, p2] = self.p;
        let [s1, s2, s3, s4] = self.s;
        let r2 = slope * slope;
        let prism = DVec2::new(s1 + 2.0 * s2 * r2, s3 + 2.0 * s4 * r2).length();
        // The prism's outer product: |(s1 + 2 s2 r², s3 + 2 s4 r²)| times the gradient of r², which
        // is 2 r.
        [6.0 * p1.hypot(p2) * slope, 2.0 * prism * slope]
    }

    /// The distorted slopes (OpenCV, `projectPoints`).
    #[inline(always)]
    fn distort(&self, slope: DVec2) -> DVec2 {
        let DVec2 { x, y } = slope;
        let [p1, p2] = self.p;
        let [s1, s2, s3, s4] = self.s;
        let r2 = x * x + y * y;
        let (factor, _) = self.radial(r2);
        DVec2::new(
            x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + (s1 + s2 * r2) * r2,
            y * factor + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + (s3 + s4 * r2) * r2,
        )
    }

    /// The derivative of [`OpenCv::distort`] by the slope.
    fn jacobian(&self, slope: DVec2) -> DMat2 {
        let DVec2 { x, y } = slope;
        let [p1, p2] = self.p;
        let [s1, s2, s3, s4] = self.s;
        let r2 = x * x + y * y;
        let (factor, rise) = self.radial(r2);
        let prism_x = 2.0 * (s1 + 2.0 * s2 * r2);
        let prism_y = 2.0 * (s3 + 2.0 * s4 * r2);
        let across = 2.0 * x * y * rise;
        DMat2::from_cols(
            DVec2::new(
                factor + 2.0 * x * x * rise + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x,
                across + 2.0 * p1 * x + 2.0 * p2 * y + prism_y * x,
            ),
            DVec2::new(
                across + 2.0 * p1 * x + 2.0 * p2 * y + prism_x * y,
                factor + 2.0 * y * y * rise + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y,
            ),
        )
    }

    /// `icD` and its derivative by r²; NaN where the denominator is not positive.
    #[inline(always)]
    fn radial(&self, r2: f64) -> (f64, f64) {
        let [k1, k2, k3, k4, k5, k6] = self.k;
        let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
        // Behind the pole of a rational lens; NaN makes every later comparison fail.
        if below <= 0.0 {
            return (f64::NAN, f64::NAN);
        }
        let above_rise = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
        let below_rise = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
        (above / below, (above_rise * below - above * below_rise) / (below * below))
    }
}
