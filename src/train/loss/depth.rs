//! Losses of expected depths where they are measured, as by a LiDAR.
//!
//! The expected depth of a pixel is `D/A`, the sum of depths weighted by contribution over the
//! opacity. Where the opacity is below [`LEAST_OPACITY`] there is nothing to measure.

use super::pixels::signum;
use super::{Loss, Real};

/// Least opacity of a pixel whose depth is compared.
pub const LEAST_OPACITY: f64 = 0.05;

/// A loss of depths, and its derivatives by the opacity and by the sum of depths of each pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthLoss<T> {
    pub value: f64,
    pub by_opacity: Vec<T>,
    pub by_depth_sum: Vec<T>,
    pub pixels: usize,
}

impl<T: Real> DepthLoss<T> {
    /// The loss times a weight.
    pub fn scaled(self, weight: f64) -> Self {
        let scale = |value: f64, by: Vec<T>| Loss { value, by }.scaled(weight);
        let by_opacity = scale(self.value, self.by_opacity);
        // The value is scaled once, with the derivatives by the opacity.
        let by_depth_sum = scale(0.0, self.by_depth_sum);
        Self {
            value: by_opacity.value,
            by_opacity: by_opacity.by,
            by_depth_sum: by_depth_sum.by,
            pixels: self.pixels,
        }
    }
}

/// The mean of `|A/D - 1/measured|` in 1/m. A measured depth of 0 is none.
pub fn disparity<T: Real>(opacity: &[T], depth_sum_m: &[T], measured_m: &[T]) -> DepthLoss<T> {
    depth_mean(opacity, depth_sum_m, measured_m, |opacity, sum_m, measured_m| {
        let disparity = opacity / sum_m;
        let off = disparity - T::one() / measured_m;
        // d(A/D) = dA/D - A dD/D².
        (off, T::one() / sum_m, -disparity / sum_m)
    })
}

/// The mean of `|D/A - measured|` in metres. A measured depth of 0 is none.
pub fn metric_depth<T: Real>(opacity: &[T], depth_sum_m: &[T], measured_m: &[T]) -> DepthLoss<T> {
    depth_mean(opacity, depth_sum_m, measured_m, |opacity, sum_m, measured_m| {
        let depth_m = sum_m / opacity;
        // d(D/A) = dD/A - D dA/A².
        (depth_m - measured_m, -depth_m / opacity, T::one() / opacity)
    })
}

/// The mean of the absolute value of `f`, which returns its derivatives by A and D, too.
fn depth_mean<T: Real>(
    opacity: &[T],
    depth_sum_m: &[T],
    measured_m: &[T],
    f: impl Fn(T, T, T) -> (T, T, T),
) -> DepthLoss<T> {
    let least = T::from_f64(LEAST_OPACITY);
    let is_compared = |i: &usize| {
        measured_m[*i] > T::zero() && opacity[*i] > least && depth_sum_m[*i] > T::zero()
    };
    let compared: Vec<usize> = (0..opacity.len()).filter(is_compared).collect();
    let mut loss = DepthLoss {
        value: 0.0,
        by_opacity: vec![T::zero(); opacity.len()],
        by_depth_sum: vec![T::zero(); opacity.len()],
        pixels: compared.len(),
    };
    // Without any pixel the share is never used.
    let share = 1.0 / compared.len() as f64;
    for i in compared {
        let (off, by_opacity, by_depth_sum) = f(opacity[i], depth_sum_m[i], measured_m[i]);
        let sign = signum(off) * T::from_f64(share);
        loss.value += off.abs().to_double() * share;
        loss.by_opacity[i] = sign * by_opacity;
        loss.by_depth_sum[i] = sign * by_depth_sum;
    }
    loss
}
