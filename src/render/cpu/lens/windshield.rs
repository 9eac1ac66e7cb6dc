//! Refraction of incoming rays by a windshield, 16 at a time.

use fearless_simd::{f32x16, prelude::*};
use glam::DVec3;

use super::max_seen_rad;
use crate::cpu::lanes::Vec3x16;
use crate::cpu::math::{atan2, sin};
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Bivariate, Windshield, WindshieldReference};

/// A windshield with polynomials from outside angles to inside angles. Directions inside are those
/// of [`Windshield`], which fades the refraction out at large angles. Directions outside, and
/// derivatives, are valid where the refraction is complete.
///
/// The polynomials give the change of the angles. A windshield changes a ray by 0.01, so the f32
/// rounding error of the change is a hundredth of that of a ray. This matters at large angles:
/// computed only from `z² = 1 - x² - y²`, z = 0.15 would be off by 1e-6, and the image of a lens of
/// slopes by 0.01 px.
#[derive(Clone, Debug)]
pub(super) struct SimdWindshield {
    horizontal: Polynomial2,
    vertical: Polynomial2,
}

/// A polynomial of two angles: for each power of the second, coefficients of the first angle's
/// powers, highest power first.
#[derive(Clone, Debug)]
struct Polynomial2(Vec<Vec<f32>>);

/// A polynomial of two angles and its derivatives.
struct ValueAndSlopes<S: Simd> {
    value: f32x16<S>,
    by_phi: f32x16<S>,
    by_theta: f32x16<S>,
}

/// Directions behind a windshield.
#[derive(Clone, Copy)]
pub(super) struct Refracted<S: Simd> {
    pub(super) direction: Vec3x16<S>,
    /// Not below 0 where the refraction is complete.
    pub(super) margin: f32x16<S>,
}

/// The refraction around a direction.
pub(super) struct RefractionDerivatives<S: Simd> {
    /// The unit direction inside.
    pub(super) inside: Vec3x16<S>,
    /// Its derivatives by the x and the y of the unit direction outside.
    pub(super) by_x: Vec3x16<S>,
    pub(super) by_y: Vec3x16<S>,
    /// How far the outside z is above the least one at which the refraction is complete: not below
    /// 0 where it is.
    pub(super) margin: f32x16<S>,
}

impl SimdWindshield {
    /// Rounds of the fixed-point search for the direction outside. Each halves the error at worst;
    /// with real windshields it leaves a fiftieth.
    const ROUNDS: u32 = 24;

    /// The largest change of an angle for which [`sine_change`] is accurate, in radians.
    const MAX_RAD: f64 = 0.5;

    /// `None` if the polynomials lead from the inside to the outside, or if they change rays by
    /// more than [`Self::MAX_RAD`].
    pub(super) fn new(windshield: &Windshield) -> Option<Self> {
        let horizontal = Polynomial2::change(windshield.horizontal(), [1, 0]);
        let vertical = Polynomial2::change(windshield.vertical(), [0, 1]);
        let forward = windshield.reference() == WindshieldReference::Forward;
        let described = forward && windshield.most_rad() <= Self::MAX_RAD;
        described.then_some(Self { horizontal, vertical })
    }

    /// Unit directions inside, of directions of any length outside.
    #[inline(always)]
    pub(super) fn inside<S: Simd>(&self, simd: S, outside: Vec3x16<S>) -> Refracted<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        // A windshield is defined by the angles of the direction, whatever its length.
        let unit = outside.scale(splat(1.0) / outside.dot(outside).sqrt());
        let cosines = [cosine(simd, unit.x), cosine(simd, unit.y)];
        let phi = atan2(simd, unit.x, cosines[0]);
        let theta = atan2(simd, unit.y, cosines[1]);
        let [none_z, full_z] = Windshield::FADES_Z;
        let per_z = splat((1.0 / (full_z - none_z)) as f32);
        // From 0 at `none_z` to 1 at `full_z`, linear in z.
        let share = ((unit.z - splat(none_z as f32)) * per_z).max(splat(0.0)).min(splat(1.0));
        let by_phi = self.horizontal.at(simd, phi, theta) * share;
        let by_theta = self.vertical.at(simd, phi, theta) * share;
        let direction = turned(simd, unit, cosines, [by_phi, by_theta]);
        // z follows from the unit length with its sign lost.
        let refracted = share.simd_gt(splat(0.0));
        let direction = Vec3x16 { z: refracted.select(direction.z, unit.z), ..direction };
        // A NaN is not above the limit.
        let full_z = splat(full_z as f32);
        let margin = unit.z.simd_ge(full_z).select(unit.z - full_z, splat(-1.0));
        Refracted { direction, margin }
    }

    /// The refraction around unit directions outside.
    ///
    /// With `x = sin φ` outside and `x′ = sin h(φ, θ)` inside, `∂x′/∂x = cos h ∂h/∂φ / cos φ`, and
    /// likewise for the other three; z′ follows from the unit length.
    #[inline(always)]
    pub(super) fn expand<S: Simd>(&self, simd: S, unit: Vec3x16<S>) -> RefractionDerivatives<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let one = splat(1.0);
        let cosines = [cosine(simd, unit.x), cosine(simd, unit.y)];
        let phi = atan2(simd, unit.x, cosines[0]);
        let theta = atan2(simd, unit.y, cosines[1]);
        let horizontal = self.horizontal.with_slopes(simd, phi, theta);
        let vertical = self.vertical.with_slopes(simd, phi, theta);
        let inside = turned(simd, unit, cosines, [horizontal.value, vertical.value]);
        let Vec3x16 { x, y, z } = inside;
        // Close to a quarter turn the derivatives grow without bound; `margin` is negative there,
        // and the clamp only keeps the lanes finite.
        let per_cos_x = one / cosines[0].max(splat(1e-6));
        let per_cos_y = one / cosines[1].max(splat(1e-6));
        let cos_x = cosine(simd, x);
        let cos_y = cosine(simd, y);
        let per_z = one / z.max(splat(1e-6));
        // From x^2 + y^2 + z^2 = 1: dz = -(x dx + y dy)/z.
        let column = |of_x: f32x16<S>, of_y: f32x16<S>| Vec3x16 {
            x: of_x,
            y: of_y,
            z: -(x.mul_add(of_x, y * of_y) * per_z),
        };
        let [_, full_z] = Windshield::FADES_Z;
        RefractionDerivatives {
            inside,
            by_x: column(
                cos_x * (one + horizontal.by_phi) * per_cos_x,
                cos_y * vertical.by_phi * per_cos_x,
            ),
            by_y: column(
                cos_x * horizontal.by_theta * per_cos_y,
                cos_y * (one + vertical.by_theta) * per_cos_y,
            ),
            margin: unit.z - splat(full_z as f32),
        }
    }

    /// Unit directions outside, of directions of any length inside.
    #[inline(always)]
    pub(super) fn outside<S: Simd>(&self, simd: S, inside: Vec3x16<S>) -> Vec3x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let unit = inside.scale(splat(1.0) / inside.dot(inside).sqrt());
        let inside_phi = atan2(simd, unit.x, cosine(simd, unit.x));
        let inside_theta = atan2(simd, unit.y, cosine(simd, unit.y));
        // The change is nearly the same outside, so that each round is close to the fixed point.
        let mut phi = inside_phi;
        let mut theta = inside_theta;
        // 0.5^24 is 6e-8, the resolution of f32.
        for _ in 0..Self::ROUNDS {
            let by_phi = self.horizontal.at(simd, phi, theta);
            let by_theta = self.vertical.at(simd, phi, theta);
            phi = inside_phi - by_phi;
            theta = inside_theta - by_theta;
        }
        let x = sin(simd, phi);
        let y = sin(simd, theta);
        Vec3x16 { x, y, z: (splat(1.0) - x * x - y * y).max(splat(0.0)).sqrt() }
    }
}

/// Unit directions whose angles φ = asin x and θ = asin y are changed, by their cosines and the
/// changes. z follows from the unit length.
#[inline(always)]
fn turned<S: Simd>(
    simd: S,
    unit: Vec3x16<S>,
    [cos_phi, cos_theta]: [f32x16<S>; 2],
    [by_phi, by_theta]: [f32x16<S>; 2],
) -> Vec3x16<S> {
    let x = sine_change(simd, [unit.x, cos_phi], by_phi);
    let y = sine_change(simd, [unit.y, cos_theta], by_theta);
    // By how much x^2 + y^2 grows: (x + dx)^2 - x^2 = dx (2 x + dx), without cancellation.
    let longer2 = x.mul_add(unit.x + unit.x + x, y * (unit.y + unit.y + y));
    let z = (unit.z * unit.z - longer2).max(f32x16::splat(simd, 0.0)).sqrt();
    Vec3x16 { x: unit.x + x, y: unit.y + y, z }
}

/// The change of a sine with its angle: `sin(φ + δ) - sin φ` is `cos φ sin δ - sin φ (1 - cos δ)`.
/// Taylor's terms up to the 8th power of δ leave 3e-10 of `1 - cos δ` up to
/// [`SimdWindshield::MAX_RAD`].
#[inline(always)]
fn sine_change<S: Simd>(simd: S, [sine, cosine]: [f32x16<S>; 2], by_rad: f32x16<S>) -> f32x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let square = by_rad * by_rad;
    let fall = splat(-1.0 / 40_320.0)
        .mul_add(square, splat(1.0 / 720.0))
        .mul_add(square, splat(-1.0 / 24.0))
        .mul_add(square, splat(0.5));
    let series = splat(1.0 / 362_880.0)
        .mul_add(square, splat(-1.0 / 5_040.0))
        .mul_add(square, splat(1.0 / 120.0))
        .mul_add(square, splat(-1.0 / 6.0));
    let rise = (series * square).mul_add(by_rad, by_rad);
    cosine * rise - sine * (fall * square)
}

/// The cosine of an angle within a quarter turn, from its sine.
#[inline(always)]
fn cosine<S: Simd>(simd: S, sine: f32x16<S>) -> f32x16<S> {
    (f32x16::splat(simd, 1.0) - sine * sine).max(f32x16::splat(simd, 0.0)).sqrt()
}

/// Whether the image shows directions at which the refraction fades out.
pub(super) fn fades_within_image(camera: &Camera) -> bool {
    let bare = Camera { windshield: None, ..*camera };
    // Just within the field, so that rounding does not put the direction outside of it.
    let (sin, cos) = (max_seen_rad(camera) * (1.0 - 1e-9)).sin_cos();
    let [_, full_z] = Windshield::FADES_Z;
    // Test 32 directions around the edge of the visible field.
    (0..32).any(|k| {
        let (y, x) = (f64::from(k) * std::f64::consts::TAU / 32.0).sin_cos();
        let at_px = bare.project(DVec3::new(x * sin, y * sin, cos));
        // The edge as the image shows it: from a direction inside to its pixel and back
        // through the glass.
        let in_full = at_px.is_some_and(|at_px| {
            camera.unproject(at_px).is_some_and(|outside| {
                let found = camera.project_extrapolated(outside).distance(at_px) < 1e-6;
                // The margin of 0.02 covers directions between two of the 32.
                found && outside.z >= full_z + 0.02
            })
        });
        !in_full
    })
}

impl Polynomial2 {
    /// A polynomial minus the angle of power 1 in `powers`.
    fn change(polynomial: &Bivariate, powers: [usize; 2]) -> Self {
        // At least 1, so that the identity has a coefficient to be subtracted from.
        let order = polynomial.order().max(1);
        let coefficient = |i: usize, j: usize| {
            let identity = if [i, j] == powers { 1.0 } else { 0.0 };
            (polynomial.coefficient(i, j) - identity) as f32
        };
        let row = |j: usize| (0..=order - j).rev().map(|i| coefficient(i, j)).collect();
        Self((0..=order).map(row).collect())
    }

    /// By Horner's scheme in both angles.
    #[inline(always)]
    fn at<S: Simd>(&self, simd: S, phi: f32x16<S>, theta: f32x16<S>) -> f32x16<S> {
        let mut sum = f32x16::splat(simd, 0.0);
        // From the highest power of the second angle.
        for row in self.0.iter().rev() {
            let mut of_phi = f32x16::splat(simd, 0.0);
            for &coefficient in row {
                of_phi = of_phi.mul_add(phi, f32x16::splat(simd, coefficient));
            }
            sum = sum.mul_add(theta, of_phi);
        }
        sum
    }

    /// By Horner's scheme in both angles, of the polynomial and of its derivatives.
    #[inline(always)]
    fn with_slopes<S: Simd>(&self, simd: S, phi: f32x16<S>, theta: f32x16<S>) -> ValueAndSlopes<S> {
        let zero = f32x16::splat(simd, 0.0);
        let mut sum = ValueAndSlopes { value: zero, by_phi: zero, by_theta: zero };
        for row in self.0.iter().rev() {
            let mut of_phi = zero;
            let mut of_phi_rise = zero;
            for &coefficient in row {
                // The product rule of Horner's step p <- p x + c: p' <- p' x + p, with p
                // before the step.
                of_phi_rise = of_phi_rise.mul_add(phi, of_phi);
                of_phi = of_phi.mul_add(phi, f32x16::splat(simd, coefficient));
            }
            sum = ValueAndSlopes {
                by_theta: sum.by_theta.mul_add(theta, sum.value),
                value: sum.value.mul_add(theta, of_phi),
                by_phi: sum.by_phi.mul_add(theta, of_phi_rise),
            };
        }
        sum
    }
}
