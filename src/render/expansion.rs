//! When the expansion of a camera around a Gaussian's centre replaces the six points of the
//! unscented transform.
//!
//! The expansion has all terms of second order in the size of a Gaussian: they shift the mean and
//! widen the covariance. The six points have terms of higher order as well, which matter only for
//! Gaussians that are large for their distance. A bound of the difference, in pixels of mean and
//! standard deviation together, decides for each Gaussian (profile field `lens_error_px`). Both
//! fast backends have the same rule; the reference backend always projects six points.
//!
//! With standard deviations as shares of the distance, `s` the largest and `Σ` the sum of their
//! squares, the bound is
//!
//! ```text
//! second Σ + third s³ + term of a rolling shutter
//! ```
//!
//! - `third`: a column of the covariance's root has `t₁(v) + 3 t₃(v)`, where `t₁` and `t₃` are the
//!   terms of first and third order. With the most pixels per radian L, a lens of r pixels at θ has
//!   `|t₃|` of at most about half of `0.6 L + |r″|/2 + |r‴|/6`: perspective alone has `a c²`, at
//!   most 0.385, and the arc tangent `a³/3`.
//! - `second`: second derivatives that the expansion leaves out, of OpenCV's distortion and of
//!   windshields.

use glam::{DVec2, DVec3};

use super::View;
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Bivariate, Lens, Windshield, WindshieldReference};

/// The bound of the difference between expansion and six points, for one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExpansionBound {
    /// Largest difference, in pixels, with which the expansion is used.
    pub max_error_px: f64,
    /// Factor of the sum of squares, in pixels.
    pub second_px: f64,
    /// Factor of the cube of the largest, in pixels.
    pub third_px: f64,
}

impl ExpansionBound {
    /// Samples of a field along each axis.
    const STEPS: u32 = 9;

    /// `None` if the profile asks for six points, or the camera has no expansion: windshields with
    /// polynomials from the inside to the outside, and cameras that turn far during one exposure.
    pub fn new(view: &View, profile: &RenderProfile) -> Option<Self> {
        let camera = &view.camera;
        let backward = camera
            .windshield
            .is_some_and(|windshield| windshield.reference() == WindshieldReference::Backward);
        // As `UnscentedView::moved` has it for a camera in another motion.
        let turns_far = view.shutter_motion().is_some_and(|motion| motion.rotation_rad > 0.5);
        if profile.lens_error_px == 0.0 || backward || turns_far {
            return None;
        }
        let FieldBounds { px_per_rad, mut second_px, third_px } = match &camera.lens {
            Lens::Pinhole | Lens::OpenCv(_) => slopes(camera),
            Lens::Fisheye(lens) => {
                let focal_px = camera.pinhole.fx.max(camera.pinhole.fy);
                round(camera, &|rad| focal_px * lens.radius().at(rad))
            }
            Lens::FTheta(lens) => round(camera, &|rad| lens.radius_px(rad)),
        };
        if let Some(windshield) = &camera.windshield {
            second_px += 0.5 * px_per_rad * windshield_bend(camera, windshield);
        }
        Some(Self { max_error_px: profile.lens_error_px, second_px, third_px: 2.0 * third_px })
    }
}

/// Bounds of a lens' derivatives over its field.
struct FieldBounds {
    /// Most pixels per radian, or per unit of slope.
    px_per_rad: f64,
    /// Bound of second derivatives that the expansion leaves out.
    second_px: f64,
    /// Bound of terms of third order.
    third_px: f64,
}

/// The largest angle off the axis that the image shows, and a margin for Gaussians outside of it,
/// in radians.
fn max_seen_rad(camera: &Camera) -> f64 {
    camera.limit_rad().min(1.25 * camera.corner_rad() + 0.1)
}

/// A lens that is round about its axis, by its radius in pixels.
fn round(camera: &Camera, radius_px: &dyn Fn(f64) -> f64) -> FieldBounds {
    let step_rad = max_seen_rad(camera) / f64::from(ExpansionBound::STEPS);
    // The five angles reach from one end of the step to the other.
    let h = 0.25 * step_rad;
    let mut bounds = FieldBounds { px_per_rad: 0.0, second_px: 0.0, third_px: 0.0 };
    for step in 0..ExpansionBound::STEPS {
        // Differences at five angles within the step.
        let rad = (f64::from(step) + 0.5) * step_rad;
        let [a, b, c, d, e] = [-2.0, -1.0, 0.0, 1.0, 2.0].map(|k| radius_px(rad + k * h));
        // Pixels per radian away from the axis, and around it.
        let slope = ((d - b) / (2.0 * h)).abs().max(c / rad.sin().abs());
        let curvature = (d - 2.0 * c + b) / (h * h);
        // The central difference of third order over four intervals.
        let third = (e - 2.0 * d + 2.0 * b - a) / (2.0 * h * h * h);
        bounds.px_per_rad = bounds.px_per_rad.max(slope);
        let terms = 0.6 * slope + curvature.abs() / 2.0 + third.abs() / 6.0;
        bounds.third_px = bounds.third_px.max(terms);
    }
    bounds
}

/// A lens of slopes, by differences of its projection.
fn slopes(camera: &Camera) -> FieldBounds {
    let bare = Camera { windshield: None, ..*camera };
    let most = max_seen_rad(camera).tan().clamp(0.0, camera.extrapolation_slope());
    let h = 1e-3;
    let at = |slope: DVec2| bare.project_extrapolated(DVec3::new(slope.x, slope.y, 1.0));
    let mut bounds = FieldBounds { px_per_rad: 0.0, second_px: 0.0, third_px: 0.0 };
    // The grid is a square, the field a disc.
    for slope in grid(most) {
        if slope.length() > most {
            continue;
        }
        let here = at(slope);
        // Along both axes and the diagonal: a mixed derivative shows along the diagonal only.
        let second = |by: DVec2| (at(slope + h * by) - 2.0 * here + at(slope - h * by)).length();
        let first = |by: DVec2| (at(slope + h * by) - at(slope - h * by)).length() / (2.0 * h);
        let diagonal = DVec2::ONE.normalize();
        let bend = second(DVec2::X).max(second(DVec2::Y)).max(second(diagonal)) / (h * h);
        bounds.px_per_rad = bounds.px_per_rad.max(first(DVec2::X).max(first(DVec2::Y)));
        bounds.second_px = bounds.second_px.max(0.5 * bend);
    }
    // Perspective only: `second_px` stands for the distortion.
    bounds.third_px = 0.6 * bounds.px_per_rad;
    // Differences that are rounding errors and not distortion.
    if bare.is_pinhole() {
        bounds.second_px = 0.0;
    }
    bounds
}

/// A bound of a windshield's second derivatives within the image, per rad².
///
/// Where its change of the angles φ, θ is ε per radian, it also has `ε tan φ` of the derivatives
/// that these coordinates have on a sphere.
fn windshield_bend(camera: &Camera, windshield: &Windshield) -> f64 {
    let bend = |polynomial: &Bivariate, identity: [f64; 2], at: DVec2| {
        let mut first = -DVec2::from_array(identity);
        let mut second = [0.0; 3];
        let order = polynomial.order();
        for j in 0..=order {
            for i in 0..=order - j {
                let c = polynomial.coefficient(i, j);
                // The derivative of x^n: n (n - 1) ... x^(n - times); 0 if times exceeds n.
                let power = |x: f64, n: usize, times: u32| {
                    let factor: f64 = (0..times as usize).map(|k| n as f64 - k as f64).product();
                    if n < times as usize {
                        0.0
                    } else {
                        factor * x.powi((n - times as usize) as i32)
                    }
                };
                first += c * DVec2::new(
                    power(at.x, i, 1) * power(at.y, j, 0),
                    power(at.x, i, 0) * power(at.y, j, 1),
                );
                second[0] += c * power(at.x, i, 2) * power(at.y, j, 0);
                second[1] += c * power(at.x, i, 1) * power(at.y, j, 1);
                second[2] += c * power(at.x, i, 0) * power(at.y, j, 2);
            }
        }
        let curved = at.abs().max_element().tan() * first.length();
        // The form d^2 of both angles, with the mixed term twice.
        second[0].abs() + 2.0 * second[1].abs() + second[2].abs() + 2.0 * curved
    };
    // The rays of a grid of pixels.
    let rays = grid(0.5).filter_map(|at| camera.unproject((at + 0.5) * camera.size_px()));
    let angles_rad = rays.map(|ray| DVec2::new(ray.x.asin(), ray.y.asin()));
    angles_rad.fold(0.0, |most, at| {
        let horizontal = bend(windshield.horizontal(), [1.0, 0.0], at);
        let vertical = bend(windshield.vertical(), [0.0, 1.0], at);
        most.max(horizontal.hypot(vertical))
    })
}

/// Points of a square grid from -`most` to `most`.
fn grid(most: f64) -> impl Iterator<Item = DVec2> {
    let steps = ExpansionBound::STEPS;
    let at = move |i: u32| most * (2.0 * f64::from(i) / f64::from(steps - 1) - 1.0);
    (0..steps * steps).map(move |i| DVec2::new(at(i % steps), at(i / steps)))
}
