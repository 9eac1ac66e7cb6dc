//! The structural similarity of two images (Wang et al. 2004), channel by channel.
//!
//! Windows are Gaussians of 11 x 11 px with a standard deviation of 1.5 px, and pixels beyond the
//! image are 0, as in the training of Kerbl et al. 2023, of gsplat and of brush. With the means
//! `m`, variances `s` and the covariance `s_xy` of a window, and C₁ = 0.01², C₂ = 0.03²:
//!
//! ```text
//! S = (2 m_x m_y + C₁)(2 s_xy + C₂) / ((m_x² + m_y² + C₁)(s_x + s_y + C₂))
//! ```
//!
//! All five sums are convolutions with one symmetric kernel, so that the derivatives are three
//! convolutions with it: of those by the mean, by the mean of x² and by that of x y.

use rayon::prelude::*;

use super::{Loss, Real};

/// Pixels of a window along one axis.
const TAPS: usize = 11;

/// `1 - mean S` of two images of this size, in [0, 2].
pub fn dssim<T: Real>(size_px: [usize; 2], image: &[T], target: &[T]) -> Loss<T> {
    let window = Window::new(size_px);
    let products = |a: &[T], b: &[T]| -> Vec<T> {
        a.par_iter().zip(b).with_min_len(1 << 14).map(|(&a, &b)| a * b).collect()
    };
    let mean_x = window.blur(image);
    let mean_y = window.blur(target);
    let xx = window.blur(&products(image, image));
    let yy = window.blur(&products(target, target));
    let xy = window.blur(&products(image, target));

    let c1 = T::from_f64(0.01 * 0.01);
    let c2 = T::from_f64(0.03 * 0.03);
    let two = T::one() + T::one();
    // Of the loss -S/n, in place of the sums that are not needed any more.
    let share = -1.0 / image.len() as f64;
    let per_value = T::from_f64(share);
    let width = 3 * size_px[0];
    let [mut by_mean, mut by_xx, mut by_xy] = [const { Vec::new() }; 3];
    for values in [&mut by_mean, &mut by_xx, &mut by_xy] {
        values.resize(image.len(), T::zero());
    }
    let rows = by_mean
        .par_chunks_mut(width)
        .zip(by_xx.par_chunks_mut(width))
        .zip(by_xy.par_chunks_mut(width))
        .enumerate();
    let sums: Vec<f64> = rows
        .map(|(row, ((by_mean, by_xx), by_xy))| {
            let mut sum = 0.0;
            for k in 0..by_mean.len() {
                let i = row * width + k;
                let mx = mean_x[i];
                let my = mean_y[i];
                let a1 = two * mx * my + c1;
                let a2 = two * (xy[i] - mx * my) + c2;
                let b1 = mx * mx + my * my + c1;
                // A variance of rounding errors may be negative, of bright and flat images.
                let variance_x = xx[i] - mx * mx;
                let variance_y = (yy[i] - my * my).max(T::zero());
                let b2 = variance_x.max(T::zero()) + variance_y + c2;
                let per_b = T::one() / (b1 * b2);
                let s = a1 * a2 * per_b;
                sum += s.to_double();
                let by_covariance = two * a1 * per_b;
                let is_positive = variance_x > T::zero();
                let by_variance = if is_positive { -s / b2 } else { T::zero() };
                let by_m = two * my * a2 * per_b - two * mx * s / b1;
                by_mean[k] = per_value * (by_m - two * mx * by_variance - my * by_covariance);
                by_xx[k] = per_value * by_variance;
                by_xy[k] = per_value * by_covariance;
            }
            sum
        })
        .collect();

    // The kernel is symmetric: its transpose is itself.
    let by_mean = window.blur(&by_mean);
    let by_xx = window.blur(&by_xx);
    let by_xy = window.blur(&by_xy);
    let by = (0..image.len())
        .into_par_iter()
        .with_min_len(1 << 14)
        .map(|i| by_mean[i] + two * image[i] * by_xx[i] + target[i] * by_xy[i])
        .collect();
    Loss { value: 1.0 + sums.iter().sum::<f64>() * share, by }
}

/// The kernel, for colours of three channels.
struct Window<T> {
    size_px: [usize; 2],
    weights: [T; TAPS],
}

impl<T: Real> Window<T> {
    fn new(size_px: [usize; 2]) -> Self {
        let gauss = |tap: usize| {
            let off_px = tap as f64 - (TAPS / 2) as f64;
            (-off_px * off_px / (2.0 * 1.5 * 1.5)).exp()
        };
        let sum: f64 = (0..TAPS).map(gauss).sum();
        Self { size_px, weights: std::array::from_fn(|tap| T::from_f64(gauss(tap) / sum)) }
    }

    /// The image convolved with the kernel, with zeros beyond its edges.
    fn blur(&self, image: &[T]) -> Vec<T> {
        let width = 3 * self.size_px[0];
        let across = self.across(image);
        let height = self.size_px[1];
        let mut blurred = vec![T::zero(); image.len()];
        blurred.par_chunks_mut(width).enumerate().for_each(|(row, to)| {
            for (tap, &weight) in self.weights.iter().enumerate() {
                // Rows beyond the image add nothing.
                let Some(from) = (row + tap).checked_sub(TAPS / 2) else { continue };
                if from >= height {
                    continue;
                }
                let from = &across[from * width..(from + 1) * width];
                for (to, &from) in to.iter_mut().zip(from) {
                    *to += weight * from;
                }
            }
        });
        blurred
    }

    /// The image convolved along its rows.
    fn across(&self, image: &[T]) -> Vec<T> {
        let width = 3 * self.size_px[0];
        let mut blurred = vec![T::zero(); image.len()];
        let rows = blurred.par_chunks_mut(width).zip(image.par_chunks(width));
        rows.for_each(|(to, from)| {
            for (tap, &weight) in self.weights.iter().enumerate() {
                // Three channels: a pixel further is three values further.
                let shift = 3 * tap.abs_diff(TAPS / 2);
                if shift >= width {
                    continue;
                }
                let length = width - shift;
                let (to, from) = if tap < TAPS / 2 {
                    (&mut to[shift..], &from[..length])
                } else {
                    (&mut to[..length], &from[shift..])
                };
                for (to, &from) in to.iter_mut().zip(from) {
                    *to += weight * from;
                }
            }
        });
        blurred
    }
}
