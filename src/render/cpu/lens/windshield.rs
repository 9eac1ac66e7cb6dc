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
        let horizontal = Polynomial2::new(windshield.horizontal());
        let vertical = Polynomial2::new(windshield.vertical());
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
        let x = sin(simd, self.horizontal.at(simd, phi, theta));
        let y = sin(simd, self.vertical.at(simd, phi, theta));
        let z = (splat(1.0) - x * x - y * y).max(splat(0.0)).sqrt();
        let [_, full_z] = Windshield::FADES_Z;
        let full_z = splat(full_z as f32);
        // A NaN is not above the limit.
        let margin = unit.z.simd_ge(full_z).select(unit.z - full_z, splat(-1.0));
        Refracted { direction: Vec3x16 { x, y, z }, margin }
    }

    /// The refraction around unit directions outside.
    ///
    /// With `x = sin φ` outside and `x′ = sin h(φ, θ)` inside, `∂x′/∂x = cos h ∂h/∂φ / cos φ`, and likewise for the
    /// other three; z′ follows from the unit length.
    #[inline(always)]
    pub(super) fn expand<S: Simd>(&self, simd: S, unit: Vec3x16<S>) -> RefractionDerivatives<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let one = splat(1.0);
        let cosine = |sine: f32x16<S>| (one - sine * sine).max(splat(1e-12)).sqrt();
        let phi = asin(simd, unit.x);
        let theta = asin(simd, unit.y);
        let horizontal = self.horizontal.with_slopes(simd, phi, theta);
        let vertical = self.vertical.with_slopes(simd, phi, theta);
        let x = sin(simd, horizontal.value);
        let y = sin(simd, vertical.value);
        let z = (one - x * x - y * y).max(splat(1e-12)).sqrt();
        let per_cos_x = one / cosine(unit.x);
        let per_cos_y = one / cosine(unit.y);
        let cos_x = cosine(x);
        let cos_y = cosine(y);
        let per_z = one / z;
        let column = |of_x: f32x16<S>, of_y: f32x16<S>| Vec3x16 {
            x: of_x,
            y: of_y,
            z: -(x.mul_add(of_x, y * of_y) * per_z),
        };
        let [_, full_z] = Windshield::FADES_Z;
        RefractionDerivatives {
            inside: Vec3x16 { x, y, z },
            by_x: column(
                cos_x * horizontal.by_phi * per_cos_x,
                cos_y * vertical.by_phi * per_cos_x,
            ),
            by_y: column(
                cos_x * horizontal.by_theta * per_cos_y,
                cos_y * vertical.by_theta * per_cos_y,
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
        // Polynomials are close to the identity, so that the error itself is a good step.
        let mut phi = inside_phi;
        let mut theta = inside_theta;
        for _ in 0..Self::ROUNDS {
            let off_phi = self.horizontal.at(simd, phi, theta) - inside_phi;
            let off_theta = self.vertical.at(simd, phi, theta) - inside_theta;
            phi -= off_phi;
            theta -= off_theta;
        }
        let x = sin(simd, phi);
        let y = sin(simd, theta);
        Vec3x16 { x, y, z: (splat(1.0) - x * x - y * y).max(splat(0.0)).sqrt() }
    }
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
    fn new(polynomial: &Bivariate) -> Self {
        let mut left = polynomial.coefficients();
        let order = polynomial.order();
        let rows = (0..=order).map(|j| {
            let (row, rest) = left.split_at(order - j + 1);
            left = rest;
            row.iter().rev().map(|&c| c as f32).collect()
        });
        Self(rows.collect())
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
