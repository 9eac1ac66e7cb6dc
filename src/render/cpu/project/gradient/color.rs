//! The derivatives of colours: by spherical harmonics, and by the viewing direction.

use fearless_simd::{f32x16, prelude::*};

use super::{Block, add3};
use crate::cpu::lanes::{Vec3x16, splats};
use wildcity_scene::chunk::{Lanes, column};
use wildcity_scene::sh;

/// Adds the derivatives by the coefficients of a block, and returns those by the vector from the
/// camera to each centre, given that vector in the axes of the chunk.
///
/// A colour that is clamped at 0 has none.
#[inline(always)]
pub(super) fn back_project<S: Simd>(
    simd: S,
    block: Block<'_>,
    toward: Vec3x16<S>,
    visible: f32x16<S>,
    to: &mut [Lanes],
) -> Vec3x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let zero = splat(0.0);
    let rgb = block.splats.colors(simd);
    let tinted = block.by.rgb(simd).times(Vec3x16::splat(simd, block.tint));
    let by = Vec3x16 {
        x: rgb.x.simd_gt(zero).select(tinted.x, zero),
        y: rgb.y.simd_gt(zero).select(tinted.y, zero),
        z: rgb.z.simd_gt(zero).select(tinted.z, zero),
    };
    let mut terms = Terms { simd, columns: block.columns, by, visible, to, by_direction: None };
    terms.constant(splat(sh::C0));
    if block.sh_degree == 0 {
        return Vec3x16 { x: zero, y: zero, z: zero };
    }

    // As in `color::color`, with the derivatives of each basis function by x, y and z.
    let length = toward.dot(toward).max(splat(1e-30)).sqrt();
    let unit = toward.scale(splat(1.0) / length);
    let Vec3x16 { x, y, z } = unit;
    let c1 = splat(sh::C1);
    terms.term(1, -c1 * y, [zero, -c1, zero]);
    terms.term(2, c1 * z, [zero, zero, c1]);
    terms.term(3, -c1 * x, [-c1, zero, zero]);
    if block.sh_degree > 1 {
        let [a, b, c, d, e] = splats(simd, sh::C2.map(|value| value as f32));
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        let twice = |v: f32x16<S>| v + v;
        terms.term(4, a * x * y, [a * y, a * x, zero]);
        terms.term(5, b * y * z, [zero, b * z, b * y]);
        let by_z = twice(twice(c) * z);
        terms.term(6, c * (twice(zz) - xx - yy), [-(twice(c) * x), -(twice(c) * y), by_z]);
        terms.term(7, d * x * z, [d * z, zero, d * x]);
        terms.term(8, e * (xx - yy), [twice(e) * x, -(twice(e) * y), zero]);
        if block.sh_degree > 2 {
            let [k0, k1, k2, k3, k4, k5, k6] = sh::C3;
            let three = splat(3.0);
            let in_plane = xx - yy;
            let xy = x * y;
            let yz = y * z;
            let xz = x * z;
            let s = splat(k0);
            let by_x = splat(6.0 * k0) * xy;
            terms.term(9, s * y * (three * xx - yy), [by_x, three * s * in_plane, zero]);
            let s = splat(k1);
            terms.term(10, s * xy * z, [s * yz, s * xz, s * xy]);
            let s = splat(k2);
            let across = splat(4.0) * zz - xx - yy;
            let by_y = s * (across - twice(yy));
            terms.term(11, s * y * across, [-(twice(s) * xy), by_y, splat(8.0 * k2) * yz]);
            let s = splat(k3);
            let along = twice(zz) - three * (xx + yy);
            let six = splat(6.0 * k3);
            let by_z = s * (splat(6.0) * zz - three * (xx + yy));
            terms.term(12, s * z * along, [-(six * xz), -(six * yz), by_z]);
            let s = splat(k4);
            let by_x = s * (across - twice(xx));
            terms.term(13, s * x * across, [by_x, -(twice(s) * xy), splat(8.0 * k4) * xz]);
            let s = splat(k5);
            terms.term(14, s * z * in_plane, [twice(s) * xz, -(twice(s) * yz), s * in_plane]);
            let s = splat(k6);
            let by_y = -(splat(6.0 * k6) * xy);
            terms.term(15, s * x * (xx - three * yy), [three * s * in_plane, by_y, zero]);
        }
    }
    let Some(by_direction) = terms.by_direction else {
        return Vec3x16 { x: zero, y: zero, z: zero };
    };
    // d/|d| has the derivative (I - d dᵀ)/|d|.
    let across = unit.mul_add(-unit.dot(by_direction), by_direction);
    across.scale(splat(1.0) / length)
}

/// The sum over the coefficients.
struct Terms<'a, S: Simd> {
    simd: S,
    columns: &'a [Lanes],
    by: Vec3x16<S>,
    visible: f32x16<S>,
    to: &'a mut [Lanes],
    by_direction: Option<Vec3x16<S>>,
}

impl<S: Simd> Terms<'_, S> {
    #[inline(always)]
    fn constant(&mut self, basis: f32x16<S>) {
        add3(self.simd, self.to, column::SH, self.by.scale(basis), self.visible);
    }

    /// Coefficient k, with the value and the derivatives of its basis function.
    #[inline(always)]
    fn term(&mut self, k: usize, basis: f32x16<S>, gradient: [f32x16<S>; 3]) {
        let first = column::SH + 3 * k;
        add3(self.simd, self.to, first, self.by.scale(basis), self.visible);
        let weight = Vec3x16::load(self.simd, self.columns, first).dot(self.by);
        let [x, y, z] = gradient;
        let term = Vec3x16 { x, y, z };
        self.by_direction = Some(match self.by_direction {
            Some(sum) => term.mul_add(weight, sum),
            None => term.scale(weight),
        });
    }
}
