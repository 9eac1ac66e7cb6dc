//! Elementary functions, 16 values at a time: shorter than a general library's, and exact to f32
//! within the stated ranges.

use fearless_simd::{f32x16, i32x16, prelude::*};

/// The angle within a quarter turn of a sine and its cosine, which is not negative; within 2e-7.
///
/// The arc sine of the smaller of both, by a fit of `(asin x/x - 1)/x²` with an error of 5e-9; if
/// the cosine is the smaller one, the angle is `π/2` minus this.
#[inline(always)]
pub(super) fn atan2<S: Simd>(simd: S, sine: f32x16<S>, cosine: f32x16<S>) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let size = sine.abs();
    let steep = size.simd_gt(cosine);
    // The smaller of both is at most the root of 1/2, where the arc sine's series converges fast.
    let x = size.min(cosine);
    let z = x * x;
    let series = splat(9.700_31e-2)
        .mul_add(z, splat(-8.368_472e-2))
        .mul_add(z, splat(6.646_933e-2))
        .mul_add(z, splat(9.544_048e-3))
        .mul_add(z, splat(3.214_238e-2))
        .mul_add(z, splat(4.452_649_5e-2))
        .mul_add(z, splat(7.500_289_4e-2))
        .mul_add(z, splat(1.666_666_6e-1));
    let small = (series * z).mul_add(x, x);
    let angle = steep.select(splat(std::f32::consts::FRAC_PI_2) - small, small);
    angle.copysign(sine)
}

/// The sine, within 2e-7 up to a quarter turn: Taylor's terms up to the 13th power leave 7e-10.
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

/// The base-2 logarithm of positive normal numbers, within 2e-7.
///
/// `x = 2^exponent m` with the mantissa m in [√½, √2). With `t = (m - 1)/(m + 1)`, so
/// `|t| <= 0.172`, `ln m = 2 atanh t = 2 t + 2/3 t³ + 2/5 t⁵ + ...`.
#[inline(always)]
pub(super) fn log2<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let bits: i32x16<S> = x.bitcast();
    // Subtract the bits of √½, so that the exponent rises at √2 and not at 2.
    let shifted = bits - 0x3F35_04F3_i32;
    // An arithmetic shift: the exponent of a number below 1 is negative.
    let exponent = shifted >> 23;
    let mantissa: f32x16<S> = (bits - (exponent << 23)).bitcast();
    let t = (mantissa - splat(1.0)) / (mantissa + splat(1.0));
    let tt = t * t;
    let series = tt
        .mul_add(splat(2.0 / 9.0), splat(2.0 / 7.0))
        .mul_add(tt, splat(2.0 / 5.0))
        .mul_add(tt, splat(2.0 / 3.0))
        .mul_add(tt, splat(2.0));
    let exponent: f32x16<S> = exponent.to_float();
    (t * series).mul_add(splat(std::f64::consts::LOG2_E), exponent)
}

/// `2^x` for x in [-126, 0], within 2e-7, and exact for whole x. Elsewhere the result is arbitrary,
/// and the call is safe.
///
/// `2^x = 2^whole 2^f`: the whole part is added to the exponent's bits. The polynomial of the
/// fraction f is the minimax fit of degree 5 to `2^f` on [0, 1) in relative error (8e-8), of those
/// with value 1 at 0.
#[inline(always)]
pub(super) fn exp2<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let whole = x.floor();
    let f = x - whole;
    let power = f
        .mul_add(splat(1.867_130_2e-3), splat(9.017_03e-3))
        .mul_add(f, splat(5.579_991_3e-2))
        .mul_add(f, splat(2.401_644_4e-1))
        .mul_add(f, splat(6.931_513e-1))
        .mul_add(f, splat(1.0));
    let whole: i32x16<S> = whole.to_int();
    let power: i32x16<S> = power.bitcast();
    // 2^f lies in [1, 2), so that adding to the exponent's bits multiplies by 2^whole.
    (power + (whole << 23)).bitcast()
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::{Level, dispatch};

    #[test]
    fn angles_are_within_two_units_of_f32() {
        for i in -1_000..=1_000 {
            // From -90 to 90 degrees in steps of 0.09.
            let angle = std::f64::consts::FRAC_PI_2 * f64::from(i) / 1_000.0;
            let found = dispatch!(Level::new(), simd => {
                let [sine, cosine] = [angle.sin(), angle.cos()].map(|v| f32x16::splat(simd, v as f32));
                atan2(simd, sine, cosine).to_array()[0]
            });
            assert!((f64::from(found) - angle).abs() < 2e-7, "{angle} is {found}");
        }
    }

    #[test]
    fn log2_is_within_two_units_of_f32() {
        for i in 0..2_000 {
            // From 2.5e-5, the square of the antialiasing floor, to 1; and around the seam at √½.
            for x in [0.99_f32.powi(i).max(2.5e-5), 0.707 + 1e-7 * i as f32] {
                let log = dispatch!(Level::new(), simd => {
                    log2(simd, f32x16::splat(simd, x)).to_array()[0]
                });
                let error = f64::from(log) - f64::from(x).log2();
                assert!(error.abs() < 2e-7 * f64::from(log).abs().max(1.0), "log2({x}) is {log}");
            }
        }
    }

    #[test]
    fn exp2_is_within_two_units_of_f32() {
        for i in 0..=16_000 {
            // Exponents of alpha from 1 down to 1/256, just below the usual cut of 1/255.
            let x = -8.0 * i as f32 / 16_000.0;
            let power = dispatch!(Level::new(), simd => {
                exp2(simd, f32x16::splat(simd, x)).to_array()[0]
            });
            let error = f64::from(power) / f64::from(x).exp2() - 1.0;
            assert!(error.abs() < 2e-7, "2^{x} is {power}, off by {error:e}");
            if x.fract() == 0.0 {
                assert_eq!(power, x.exp2());
            }
        }
    }
}
