//! Gaussian samples, and values that drift slowly.

use std::sync::LazyLock;

use wildcity_scene::random::Random;

/// Number of quantiles of the normal distribution: 16 random bits choose one.
const QUANTILES: usize = 1 << 16;

/// Quantiles of the normal distribution at (k + 1/2) / 65,536, scaled to variance 1. The largest is
/// 4.3.
///
/// They solve dz/dp = 1/φ(z) = √(2π) exp(z²/2), integrated from the median by the method of Runge
/// and Kutta.
static NORMAL: LazyLock<Box<[f32]>> = LazyLock::new(|| {
    let slope = |z: f64| std::f64::consts::TAU.sqrt() * (0.5 * z * z).exp();
    let mut upper = Vec::with_capacity(QUANTILES / 2);
    let mut z = 0.0;
    for k in 0..QUANTILES / 2 {
        // Half a step from the median to the first.
        let way = if k == 0 { 0.5 } else { 1.0 } / QUANTILES as f64;
        // `way` x `slope` is about the rise of z: parts of 0.005 of a standard deviation.
        let parts = (way * slope(z) * 200.0).ceil().max(1.0);
        let step = way / parts;
        for _ in 0..parts as usize {
            let a = slope(z);
            let b = slope(z + 0.5 * step * a);
            let c = slope(z + 0.5 * step * b);
            let d = slope(z + step * c);
            z += step / 6.0 * (a + 2.0 * b + 2.0 * c + d);
        }
        upper.push(z);
    }
    // The mean is 0 by symmetry, so that the upper half has the variance of the whole.
    let variance = upper.iter().map(|z| z * z).sum::<f64>() / upper.len() as f64;
    let scaled = |z: &f64| (z / variance.sqrt()) as f32;
    upper.iter().rev().map(|z| -scaled(z)).chain(upper.iter().map(scaled)).collect()
});

/// The quantiles, for loops.
pub(crate) fn normal_table() -> &'static [f32] {
    &NORMAL
}

/// A sample of the standard normal distribution.
pub(crate) fn standard_normal(random: &mut Random) -> f64 {
    // The upper 16 bits are a uniform index into 65,536 quantiles.
    f64::from(NORMAL[(random.seed() >> 48) as usize])
}

/// A value that drifts with time: normally distributed with variance 1 at every time, and
/// independent of its value two periods ago. At the fraction u of a period it is a cos(π u / 2) + b
/// sin(π u / 2), where a and b are standard normal samples for the multiples of the period before
/// and after. These weights keep the variance.
pub(crate) fn drift(seed: u64, name: &str, period_us: i64, time_us: i64) -> f64 {
    let index = time_us.div_euclid(period_us);
    let part = time_us.rem_euclid(period_us) as f64 / period_us as f64;
    // In a warm-up the index may be negative: its bits then serve as the index of the random
    // generator.
    let drawn = |index: i64| standard_normal(&mut Random::new(seed, name, index as usize));
    let (sin, cos) = (std::f64::consts::FRAC_PI_2 * part).sin_cos();
    // cos² + sin² = 1 keeps the variance.
    drawn(index) * cos + drawn(index + 1) * sin
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_1_SQRT_2;

    use super::*;

    /// Abramowitz and Stegun, "Handbook of Mathematical Functions", table 26.1: P(z) of the normal
    /// distribution.
    const TABLE: [(f64, f64); 4] =
        [(0.841_344_746, 1.0), (0.977_249_868, 2.0), (0.998_650_102, 3.0), (0.999_968_329, 4.0)];

    #[test]
    fn quantiles_are_those_of_the_normal_distribution() {
        for (p, z) in TABLE {
            // The quantile k stands for the probability (k + 1/2) / 65,536.
            let place = p * QUANTILES as f64 - 0.5;
            let [low, high] = [place.floor(), place.ceil()].map(|k| f64::from(NORMAL[k as usize]));
            let at = low + (place - place.floor()) * (high - low);
            // Beyond 3.5 the quantiles are 0.1 apart, and the line between two of them is off.
            let error = if z > 3.5 { 1e-2 } else { 5e-4 };
            assert!((at - z).abs() < error, "{p}: {at}");
        }
        let sum: f64 = NORMAL.iter().map(|&z| f64::from(z)).sum();
        let squares: f64 = NORMAL.iter().map(|&z| f64::from(z).powi(2)).sum();
        let fourth: f64 = NORMAL.iter().map(|&z| f64::from(z).powi(4)).sum();
        let count = QUANTILES as f64;
        assert!(sum.abs() < 1e-6, "{sum}");
        assert!((squares / count - 1.0).abs() < 1e-6);
        // 3 for a normal distribution; cut off at 4.3, the tails are missing a little.
        assert!((fourth / count - 3.0).abs() < 0.02, "{}", fourth / count);
    }

    #[test]
    fn a_drift_keeps_its_variance_and_forgets() {
        let of_seed = |time_us: i64| (0..20_000).map(move |seed| drift(seed, "x", 1000, time_us));
        for time_us in [0, 250, 500, 999, -700] {
            let mean = of_seed(time_us).sum::<f64>() / 2e4;
            let variance = of_seed(time_us).map(|x| x * x).sum::<f64>() / 2e4;
            // Standard errors: 1/√20,000 and √(2/20,000).
            assert!(mean.abs() < 4.0 * 0.0071, "{time_us}: {mean}");
            assert!((variance - 1.0).abs() < 4.0 * 0.01, "{time_us}: {variance}");
        }
        let covariance =
            |by_us: i64| of_seed(0).zip(of_seed(by_us)).map(|(a, b)| a * b).sum::<f64>() / 2e4;
        // cos(π/4) after half a period, nothing after one.
        assert!((covariance(500) - FRAC_1_SQRT_2).abs() < 0.04, "{}", covariance(500));
        assert!(covariance(1000).abs() < 0.04, "{}", covariance(1000));
    }
}
