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
//! convolutions with it: of those by the mean, by the mean of x² and by that of x y. A kernel is
//! applied along the rows and then along the columns, and what is between two convolutions is done
//! row by row while a row is in the processor's cache.

use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;

use super::{Loss, Real};

/// Pixels of a window along one axis.
const TAPS: usize = 11;

/// The pixel in the middle of a window.
const MIDDLE: usize = TAPS / 2;

/// Zeros beyond each end of a row, whose pixels have three values.
const PADDING: usize = 3 * MIDDLE;

/// Sums of a window: of x, y, x², y² and x y.
const SUMS: usize = 5;

/// Derivatives by sums of a window: by those of x, x² and x y.
const DERIVATIVES: usize = 3;

/// `1 - mean S` of two images of this size, in [0, 2].
pub fn dssim<T: Real>(size_px: [usize; 2], image: &[T], target: &[T]) -> Loss<T> {
    if image.is_empty() {
        return Loss { value: 0.0, by: Vec::new() };
    }
    let window = Window::new(size_px);
    let width = window.width;
    // All levels of instructions give the same numbers: none fuses a product with a sum.
    let level = Level::new();

    let mut sums = vec![T::zero(); SUMS * image.len()];
    sums.par_chunks_mut(SUMS * width).enumerate().for_each(|(row, to)| {
        let [x, y] = [image, target].map(|image| &image[row * width..][..width]);
        dispatch!(level, simd => simd.vectorize(#[inline(always)] || window.sums(x, y, to)));
    });

    // The loss is 1 minus the mean over all values.
    let per_value = T::from_f64(-1.0 / image.len() as f64);
    let mut by_sums = vec![T::zero(); DERIVATIVES * image.len()];
    let rows = by_sums.par_chunks_mut(DERIVATIVES * width).enumerate();
    let similarities: Vec<f64> = rows
        .map(|(row, to)| {
            dispatch!(level, simd => simd.vectorize(
                #[inline(always)]
                || window.similarity(&window.down(&sums, row), per_value, to)
            ))
        })
        .collect();

    let two = T::one() + T::one();
    let mut by = vec![T::zero(); image.len()];
    by.par_chunks_mut(width).enumerate().for_each(|(row, to)| {
        let [x, y] = [image, target].map(|image| &image[row * width..][..width]);
        dispatch!(level, simd => simd.vectorize(
            #[inline(always)]
            || {
                let by_sums: [Vec<T>; DERIVATIVES] = window.down(&by_sums, row);
                let [by_mean, by_xx, by_xy] = by_sums.each_ref().map(|by| &by[..to.len()]);
                let [x, y] = [x, y].map(|row| &row[..to.len()]);
                for i in 0..to.len() {
                    to[i] = by_mean[i] + two * x[i] * by_xx[i] + y[i] * by_xy[i];
                }
            }
        ));
    });
    Loss { value: 1.0 - similarities.iter().sum::<f64>() / image.len() as f64, by }
}

/// The kernel, for colours of three channels.
struct Window<T> {
    /// Values of a row.
    width: usize,
    /// Of the pixel in the middle, and of those one, two and more from it.
    weights: [T; MIDDLE + 1],
}

impl<T: Real> Window<T> {
    fn new([width, _]: [usize; 2]) -> Self {
        let gauss = |off_px: usize| (-((off_px * off_px) as f64) / (2.0 * 1.5 * 1.5)).exp();
        let sum = gauss(0) + 2.0 * (1..=MIDDLE).map(gauss).sum::<f64>();
        let weights = std::array::from_fn(|off_px| T::from_f64(gauss(off_px) / sum));
        Self { width: 3 * width, weights }
    }

    /// The five sums of a row of two images, along the row only.
    #[inline(always)]
    fn sums(&self, x: &[T], y: &[T], to: &mut [T]) {
        let mut products = vec![T::zero(); x.len()];
        for (number, to) in to.chunks_exact_mut(self.width).enumerate() {
            // In the order of the sums: x, y, x², y², x y.
            let [a, b] = match number {
                0 => {
                    self.across(x, to);
                    continue;
                }
                1 => {
                    self.across(y, to);
                    continue;
                }
                2 => [x, x],
                3 => [y, y],
                _ => [x, y],
            };
            for ((product, &a), &b) in products.iter_mut().zip(a).zip(b) {
                *product = a * b;
            }
            self.across(&products, to);
        }
    }

    /// A row convolved with the kernel, with zeros beyond its ends.
    #[inline(always)]
    fn across(&self, row: &[T], to: &mut [T]) {
        let width = to.len();
        let mut padded = vec![T::zero(); width + 2 * PADDING];
        padded[PADDING..][..width].copy_from_slice(row);
        // A pixel further is three values further.
        let mut taps = [&padded[..]; TAPS];
        for (tap, values) in taps.iter_mut().enumerate() {
            *values = &padded[3 * tap..][..width];
        }
        self.convolve(taps, to);
    }

    /// Each of `N` kinds of rows convolved along the columns, with zeros beyond the image.
    #[inline(always)]
    fn down<const N: usize>(&self, rows: &[T], row: usize) -> [Vec<T>; N] {
        let width = self.width;
        // Rows without any width are none.
        let height = rows.len() / (N * width).max(1);
        let beyond = vec![T::zero(); width];
        let mut all = [const { Vec::new() }; N];
        for (kind, to) in all.iter_mut().enumerate() {
            // Loops: a closure of an array would be compiled without the level's instructions.
            let mut taps = [&beyond[..]; TAPS];
            for (tap, values) in taps.iter_mut().enumerate() {
                if let Some(from) = (row + tap).checked_sub(MIDDLE).filter(|&from| from < height) {
                    *values = &rows[(from * N + kind) * width..][..width];
                }
            }
            to.resize(width, T::zero());
            self.convolve(taps, to);
        }
        all
    }

    #[inline(always)]
    fn convolve(&self, taps: [&[T]; TAPS], to: &mut [T]) {
        let mut rows = taps;
        for row in &mut rows {
            *row = &row[..to.len()];
        }
        let [a, b, c, d, e, middle, f, g, h, i, j] = rows;
        let [w0, w1, w2, w3, w4, w5] = self.weights;
        for k in 0..to.len() {
            to[k] = w0 * middle[k]
                + w1 * (e[k] + f[k])
                + w2 * (d[k] + g[k])
                + w3 * (c[k] + h[k])
                + w4 * (b[k] + i[k])
                + w5 * (a[k] + j[k]);
        }
    }

    /// The sum of S of a row, and the derivatives by its sums, convolved along the row.
    #[inline(always)]
    fn similarity(&self, sums: &[Vec<T>; SUMS], per_value: T, to: &mut [T]) -> f64 {
        let c1 = T::from_f64(0.01 * 0.01);
        let c2 = T::from_f64(0.03 * 0.03);
        let two = T::one() + T::one();
        let [x, y, xx, yy, xy] = sums.each_ref().map(|sums| &sums[..self.width]);
        let mut rows = [const { Vec::new() }; DERIVATIVES + 1];
        for row in &mut rows {
            row.resize(self.width, T::zero());
        }
        let [mean_row, xx_row, xy_row, all_row] = &mut rows;
        let by_mean = &mut mean_row[..self.width];
        let by_xx = &mut xx_row[..self.width];
        let by_xy = &mut xy_row[..self.width];
        let all = &mut all_row[..self.width];
        for i in 0..self.width {
            let mx = x[i];
            let my = y[i];
            let a1 = two * mx * my + c1;
            let a2 = two * (xy[i] - mx * my) + c2;
            let b1 = mx * mx + my * my + c1;
            // A variance of rounding errors may be negative, of bright and flat images.
            let variance_x = xx[i] - mx * mx;
            let variance_y = (yy[i] - my * my).max(T::zero());
            let b2 = variance_x.max(T::zero()) + variance_y + c2;
            let per_b = T::one() / (b1 * b2);
            let s = a1 * a2 * per_b;
            let by_covariance = two * a1 * per_b;
            let by_variance = if variance_x > T::zero() { -s / b2 } else { T::zero() };
            let by_m = two * my * a2 * per_b - two * mx * s / b1;
            all[i] = s;
            by_mean[i] = per_value * (by_m - two * mx * by_variance - my * by_covariance);
            by_xx[i] = per_value * by_variance;
            by_xy[i] = per_value * by_covariance;
        }
        // The kernel is symmetric: its transpose is itself.
        for (row, to) in rows.iter().zip(to.chunks_exact_mut(self.width)) {
            self.across(row, to);
        }
        rows[DERIVATIVES].iter().map(|s| s.to_double()).sum()
    }
}
