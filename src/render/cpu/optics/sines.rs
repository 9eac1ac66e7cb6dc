//! Sines and their inverse, 16 at a time.

use fearless_simd::{f32x16, prelude::*};

/// The arc sine within 2e-7, by the coefficients of Cephes' `asinf` up to a half, and of
/// `π/2 - 2 asin √((1 - x)/2)` beyond.
#[inline(always)]
pub(super) fn asin<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let size = x.abs();
    let steep = size.simd_gt(splat(0.5));
    let z = steep.select(splat(0.5) * (splat(1.0) - size).max(splat(0.0)), size * size);
    let root = steep.select(z.sqrt(), size);
    let series = splat(4.216_32e-2)
        .mul_add(z, splat(2.418_131e-2))
        .mul_add(z, splat(4.547_002_6e-2))
        .mul_add(z, splat(7.495_300_3e-2))
        .mul_add(z, splat(1.666_675_2e-1));
    let small = (series * z).mul_add(root, root);
    let angle = steep.select(splat(std::f32::consts::FRAC_PI_2) - (small + small), small);
    angle.copysign(x)
}

/// The sine within 2e-7 up to a quarter turn: Taylor's terms up to the 13th power leave 7e-10.
#[inline(always)]
pub(super) fn sin<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let xx = x * x;
    let series = splat(1.0 / 6_227_020_800.0)
        .mul_add(xx, splat(-1.0 / 39_916_800.0))
        .mul_add(xx, splat(1.0 / 362_880.0))
        .mul_add(xx, splat(-1.0 / 5_040.0))
        .mul_add(xx, splat(1.0 / 120.0))
        .mul_add(xx, splat(-1.0 / 6.0));
    (series * xx).mul_add(x, x)
}
