//! Refraction of incoming rays by a windshield, 16 at a time.

use fearless_simd::{f32x16, prelude::*};
use glam::DVec3;

use super::max_seen_rad;
use crate::cpu::lanes::Vec3x16;
use crate::cpu::math::{asin, sin};
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Bivariate, Windshield, WindshieldReference};

/// A windshield with polynomials from outside angles to inside angles. It is valid at angles where the
/// refraction is complete: at large angles [`Windshield`] fades the refraction out, and this type does not.
///
/// The polynomials here are by how much the angles change. A windshield changes a ray by 0.01, so what f32 rounds of that
/// is a hundredth of what it rounds of a ray. Beside the camera this decides: from `z² = 1 - x² - y²` alone, z = 0.15 would
/// be off by 1e-6, and the image of a lens of slopes by 0.01 px.
#[derive(Clone, Debug)]
pub(super) struct SimdWindshield {
    horizontal: Polynomial2,
    vertical: Polynomial2,
}

/// A polynomial of two angles: for each power of the second, coefficients of the first angle's powers, highest
/// power first.
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
    /// Unit directions inside.
    pub(super) direction: Vec3x16<S>,
    /// Not below 0 where the refraction is complete.
    pub(super) margin: f32x16<S>,
}

/// The refraction around a direction.
pub(super) struct RefractionDerivatives<S: Simd> {
    /// The unit direction inside.
    pub(super) inside: Vec3x16<S>,
    /// How it changes with the x and the y of the unit direction outside.
    pub(super) by_x: Vec3x16<S>,
    pub(super) by_y: Vec3x16<S>,
    /// How far, in the outside z, the refraction is complete; not below 0 where it is.
    pub(super) margin: f32x16<S>,
}

impl SimdWindshield {
    /// Rounds of the fixed-point search for the direction outside. Each halves the error at worst; with real
    /// windshields it leaves a fiftieth.
    const ROUNDS: u32 = 24;

    /// `None` if the polynomials lead from the inside to the outside.
    pub(super) fn new(windshield: &Windshield) -> Option<Self> {
        let horizontal = Polynomial2::change(windshield.horizontal(), [1, 0]);
        let vertical = Polynomial2::change(windshield.vertical(), [0, 1]);
        let forward = windshield.reference() == WindshieldReference::Forward;
        forward.then_some(Self { horizontal, vertical })
    }

    /// Directions inside, of directions of any length outside.
    #[inline(always)]
    pub(super) fn inside<S: Simd>(&self, simd: S, outside: Vec3x16<S>) -> Refracted<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let unit = outside.scale(splat(1.0) / outside.dot(outside).sqrt());
        let phi = asin(simd, unit.x);
        let theta = asin(simd, unit.y);
        let by_phi = self.horizontal.at(simd, phi, theta);
        let by_theta = self.vertical.at(simd, phi, theta);
        let direction = turned(simd, unit, by_phi, by_theta);
        let [_, full_z] = Windshield::FADES_Z;
        let full_z = splat(full_z as f32);
        // A NaN is not above the limit.
        let margin = unit.z.simd_ge(full_z).select(unit.z - full_z, splat(-1.0));
        Refracted { direction, margin }
    }

    /// The refraction around unit directions outside.
    ///
    /// With `x = sin φ` outside and `x′ = sin h(φ, θ)` inside, `∂x′/∂x = cos h ∂h/∂φ / cos φ`, and likewise for the
    /// other three; z′ follows from the unit length.
    #[inline(always)]
    pub(super) fn expand<S: Simd>(&self, simd: S, unit: Vec3x16<S>) -> RefractionDerivatives<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let one = splat(1.0);
        let phi = asin(simd, unit.x);
        let theta = asin(simd, unit.y);
        let horizontal = self.horizontal.with_slopes(simd, phi, theta);
        let vertical = self.vertical.with_slopes(simd, phi, theta);
        let inside = turned(simd, unit, horizontal.value, vertical.value);
        let Vec3x16 { x, y, z } = inside;
        let per_cos_x = one / cosine(simd, unit.x).max(splat(1e-6));
        let per_cos_y = one / cosine(simd, unit.y).max(splat(1e-6));
        let cos_x = cosine(simd, x);
        let cos_y = cosine(simd, y);
        let per_z = one / z.max(splat(1e-6));
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
        let inside_phi = asin(simd, unit.x);
        let inside_theta = asin(simd, unit.y);
        // The change is nearly the same outside, so that each round is close to the fixed point.
        let mut phi = inside_phi;
        let mut theta = inside_theta;
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

/// Unit directions with other angles φ = asin x and θ = asin y, by how much these change. z follows from the unit length.
#[inline(always)]
fn turned<S: Simd>(
    simd: S,
    unit: Vec3x16<S>,
    by_phi: f32x16<S>,
    by_theta: f32x16<S>,
) -> Vec3x16<S> {
    let x = sine_change(simd, unit.x, by_phi);
    let y = sine_change(simd, unit.y, by_theta);
    let longer2 = x.mul_add(unit.x + unit.x + x, y * (unit.y + unit.y + y));
    let z = (unit.z * unit.z - longer2).max(f32x16::splat(simd, 0.0)).sqrt();
    Vec3x16 { x: unit.x + x, y: unit.y + y, z }
}

/// By how much a sine changes with its angle: `sin(φ + δ) - sin φ` is `2 s (cos φ cos(δ/2) - sin φ s)` with
/// `s = sin(δ/2)`.
#[inline(always)]
fn sine_change<S: Simd>(simd: S, sine: f32x16<S>, by_rad: f32x16<S>) -> f32x16<S> {
    let half = sin(simd, by_rad * f32x16::splat(simd, 0.5));
    let along = cosine(simd, sine) * cosine(simd, half) - sine * half;
    (half + half) * along
}

/// The cosine of an angle within a quarter turn, from its sine.
#[inline(always)]
fn cosine<S: Simd>(simd: S, sine: f32x16<S>) -> f32x16<S> {
    (f32x16::splat(simd, 1.0) - sine * sine).max(f32x16::splat(simd, 0.0)).sqrt()
}

/// Whether the image shows directions at which the refraction fades out.
pub(super) fn fades_within_image(camera: &Camera) -> bool {
    let bare = Camera { windshield: None, ..*camera };
    let (sin, cos) = (max_seen_rad(camera) * (1.0 - 1e-9)).sin_cos();
    let [_, full_z] = Windshield::FADES_Z;
    // Test 32 directions around the edge of the visible field.
    (0..32).any(|k| {
        let (y, x) = (f64::from(k) * std::f64::consts::TAU / 32.0).sin_cos();
        let at_px = bare.project(DVec3::new(x * sin, y * sin, cos));
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
