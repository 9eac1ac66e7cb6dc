//! Windshields that turn rays as they come, 16 at a time.

use fearless_simd::{f32x16, prelude::*};
use glam::DVec3;

use super::seen_rad;
use super::sines::{asin, sin};
use crate::cpu::lanes::Vec3x16;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Bivariate, Windshield, WindshieldReference};

/// A windshield that turns rays as they come, at angles where it does so in full.
#[derive(Clone, Debug)]
pub(super) struct Glass {
    horizontal: Sheet,
    vertical: Sheet,
}

/// A polynomial of two angles: for each power of the second, coefficients of the first's, highest first.
#[derive(Clone, Debug)]
struct Sheet(Vec<Vec<f32>>);

impl Glass {
    /// Rounds of the search behind a windshield: each halves its error at worst, and real ones leave a
    /// fiftieth.
    const ROUNDS: u32 = 24;

    /// `None` if its polynomials lead from inside to outside.
    pub(super) fn of(windshield: &Windshield) -> Option<Self> {
        let [horizontal, vertical] =
            [windshield.horizontal(), windshield.vertical()].map(Sheet::of);
        let forward = windshield.reference() == WindshieldReference::Forward;
        forward.then_some(Self { horizontal, vertical })
    }

    /// Unit directions inside, and how far z as a share of the length is above what is turned in full.
    #[inline(always)]
    pub(super) fn inside<S: Simd>(&self, simd: S, point_m: Vec3x16<S>) -> (Vec3x16<S>, f32x16<S>) {
        let splat = |value: f32| f32x16::splat(simd, value);
        let unit = point_m.scale(splat(1.0) / point_m.dot(point_m).sqrt());
        let (phi, theta) = (asin(simd, unit.x), asin(simd, unit.y));
        let x = sin(simd, self.horizontal.at(simd, phi, theta));
        let y = sin(simd, self.vertical.at(simd, phi, theta));
        let z = (splat(1.0) - x * x - y * y).max(splat(0.0)).sqrt();
        let [_, in_full] = Windshield::FADES_Z;
        let in_full = splat(in_full as f32);
        (Vec3x16 { x, y, z }, unit.z.simd_ge(in_full).select(unit.z - in_full, splat(-1.0)))
    }

    /// Unit directions outside, of directions of any length inside.
    #[inline(always)]
    pub(super) fn outside<S: Simd>(&self, simd: S, inside: Vec3x16<S>) -> Vec3x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let unit = inside.scale(splat(1.0) / inside.dot(inside).sqrt());
        let (from_phi, from_theta) = (asin(simd, unit.x), asin(simd, unit.y));
        let (mut phi, mut theta) = (from_phi, from_theta);
        for _ in 0..Self::ROUNDS {
            let off_phi = self.horizontal.at(simd, phi, theta) - from_phi;
            let off_theta = self.vertical.at(simd, phi, theta) - from_theta;
            (phi, theta) = (phi - off_phi, theta - off_theta);
        }
        let (x, y) = (sin(simd, phi), sin(simd, theta));
        Vec3x16 { x, y, z: (splat(1.0) - x * x - y * y).max(splat(0.0)).sqrt() }
    }
}

/// Whether a windshield turns less than in full what a lens sees at the end of its field.
pub(super) fn fades(camera: &Camera) -> bool {
    let bare = Camera { windshield: None, ..*camera };
    let (sin, cos) = (seen_rad(camera) * (1.0 - 1e-9)).sin_cos();
    let [_, in_full] = Windshield::FADES_Z;
    (0..32).any(|k| {
        let (y, x) = (f64::from(k) * std::f64::consts::TAU / 32.0).sin_cos();
        let at_px = bare.project(DVec3::new(x * sin, y * sin, cos));
        let in_full = at_px.is_some_and(|at_px| {
            camera.unproject(at_px).is_some_and(|outside| {
                let found = camera.project_extrapolated(outside).distance(at_px) < 1e-6;
                // Between two of the 32 it is nearly the same.
                found && outside.z >= in_full + 0.02
            })
        });
        !in_full
    })
}

impl Sheet {
    fn of(polynomial: &Bivariate) -> Self {
        let mut left = polynomial.coefficients();
        let order = polynomial.order();
        let rows = (0..=order).map(|j| {
            let (row, rest) = left.split_at(order - j + 1);
            left = rest;
            row.iter().rev().map(|&c| c as f32).collect()
        });
        Self(rows.collect())
    }

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
}
