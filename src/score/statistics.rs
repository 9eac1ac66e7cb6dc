//! Rates and means over many episodes, with 95 % confidence intervals.

use std::f64::consts::{FRAC_2_PI, FRAC_PI_2};

/// The 97.5 % quantile of the normal distribution.
const NORMAL: f64 = 1.959_963_984_540_054;

/// The interval of a pass rate after `passed` of `runs`: Wilson's score interval (1927), 95 %.
///
/// It stays within [0, 1] and is useful even if all or none passed. Without runs it is [0, 1].
pub fn wilson(passed: u64, runs: u64) -> [f64; 2] {
    if runs == 0 {
        return [0.0, 1.0];
    }
    let n = runs as f64;
    let p = passed as f64 / n;
    let z2 = NORMAL * NORMAL;
    // Wilson: (p + z²/2n ± z sqrt(p (1 - p)/n + z²/4n²)) / (1 + z²/n).
    let scale = 1.0 + z2 / n;
    let middle = (p + z2 / (2.0 * n)) / scale;
    let half = NORMAL / scale * (p * (1.0 - p) / n + z2 / (4.0 * n * n)).sqrt();
    // Exact at the ends: rounding could leave 1e-17 where the bound is 0.
    let low = if passed == 0 { 0.0 } else { (middle - half).max(0.0) };
    let high = if passed == runs { 1.0 } else { (middle + half).min(1.0) };
    [low, high]
}

/// A mean of fewer values has no interval: for two values t is 12.7, and the interval would be
/// useless.
pub const LEAST_VALUES: usize = 3;

/// A mean, its standard deviation and half of its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mean {
    /// Number of the values.
    pub count: usize,
    pub mean: f64,
    /// The standard deviation of the values (n - 1); `None` for a single one.
    pub deviation: Option<f64>,
    /// Half of the interval: t · deviation/√n; `None` for a single value.
    pub half_width: Option<f64>,
}

impl Mean {
    /// The mean of some values, with an interval by Student's t distribution; `None` without
    /// values.
    pub fn from_values(values: &[f64]) -> Option<Self> {
        let n = values.len();
        if n == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / n as f64;
        // One value has no deviation: n - 1 is 0.
        if n == 1 {
            return Some(Self { count: n, mean, deviation: None, half_width: None });
        }
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let deviation = (squares / (n - 1) as f64).sqrt();
        let half_width = student_t(n - 1) * deviation / (n as f64).sqrt();
        Some(Self { count: n, mean, deviation: Some(deviation), half_width: Some(half_width) })
    }

    /// The 95 % interval of the mean of values from `least` to `most`: that of Student (1908), mean
    /// ± t · deviation/√n, clipped to the range. The mean cannot be beyond it, so the clipped
    /// interval contains it as often. `None` below [`LEAST_VALUES`] values.
    pub fn interval(&self, [least, most]: [f64; 2]) -> Option<[f64; 2]> {
        let half_width = self.half_width.filter(|_| self.count >= LEAST_VALUES)?;
        Some([(self.mean - half_width).max(least), (self.mean + half_width).min(most)])
    }
}

/// The 97.5 % quantile of Student's t distribution.
///
/// Bisection of the angle θ = atan(t/√ν), of which the probability is a finite sum for whole
/// degrees of freedom (Abramowitz and Stegun 26.7.3 and 26.7.4).
fn student_t(degrees: usize) -> f64 {
    // Beyond, the sum is long and the quantile is the normal one to 2e-5.
    let degrees = degrees.min(100_000);
    let mut low = 0.0;
    let mut high = FRAC_PI_2;
    // 100 halvings are more than an f64 distinguishes; the loop has no condition that could fail to
    // end.
    for _ in 0..100 {
        let middle = 0.5 * (low + high);
        // `within` is the two-sided probability: 0.95 leaves 2.5 % on each side.
        if within(middle, degrees) < 0.95 { low = middle } else { high = middle }
    }
    low.tan() * (degrees as f64).sqrt()
}

/// P(|T| <= √ν tan θ).
fn within(angle: f64, degrees: usize) -> f64 {
    let (sin, cos) = angle.sin_cos();
    let is_odd = !degrees.is_multiple_of(2);
    // The first term, and the factor from each to the next: k/(k + 1) cos², k = 2, 4, .. or 1, 3,
    // ..
    let mut term = if is_odd { cos } else { 1.0 };
    let first = if is_odd { 2 } else { 1 };
    let mut sum = 0.0;
    for k in (first..degrees).step_by(2) {
        sum += term;
        term *= k as f64 / (k + 1) as f64 * cos * cos;
    }
    if is_odd { FRAC_2_PI * (angle + sin * sum) } else { sin * sum }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_tables() {
        let table =
            [(1, 12.706_204_736), (2, 4.302_652_730), (3, 3.182_446_305), (10, 2.228_138_852)];
        for (degrees, t) in table {
            assert!((student_t(degrees) - t).abs() < 1e-8, "{degrees}: {}", student_t(degrees));
        }
        assert!((student_t(1_000_000) - NORMAL).abs() < 1e-4);
    }
}
