//! Structural similarity (SSIM, Wang et al. 2004) of colour images, in the two ways in which papers
//! compute it.
//!
//! Windows are Gaussian, 11 px wide, with a standard deviation of 1.5 px. Variances are those of
//! the population. The value of a pixel is the mean over the three channels, not that of luma.
//! Implementations differ at the image's edge: one noisy image has 0.56 or 0.59 only because of
//! that. So a number needs its convention.

use rayon::prelude::*;

/// Edge of a window, in pixels.
pub const WINDOW_PX: usize = 11;
/// Pixels of a window on each side of its middle.
const REACH_PX: usize = WINDOW_PX / 2;
/// Standard deviation of a window, in pixels.
const SIGMA_PX: f64 = 1.5;
/// Wang et al. 2004: C1 is `(0.01 L)²` and C2 `(0.03 L)²`, for values from 0 to L = 1.
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
/// Rows that one thread computes. The order of sums, and so their last bits, depends only on it.
const BAND_ROWS: usize = 32;

/// Mean structural similarity of two images; 1 if nothing differs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ssim {
    /// Over the windows that lie within the image: Wang et al. 2004, and scikit-image with
    /// `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, channel_axis=-1`. With a
    /// mask, over the windows that have only pixels that count. NaN if there is no such window.
    pub within: f64,
    /// Over all pixels, with the image mirrored at its edges: torchmetrics' default, which gsplat
    /// uses. It does not support a mask.
    pub mirrored: f64,
}

impl Ssim {
    /// Compares two images of values from 0 to 1, `[height, width, 3]`. `counts` marks the pixels
    /// that count; all count without it.
    ///
    /// # Panics
    /// If a length does not fit the size.
    pub fn compare(
        image: &[f64],
        truth: &[f64],
        size_px: [u32; 2],
        counts: Option<&[bool]>,
    ) -> Self {
        let [width, height] = size_px.map(|px| px as usize);
        assert!(image.len() == 3 * width * height && truth.len() == image.len(), "{size_px:?}");
        assert!(counts.is_none_or(|counts| counts.len() == width * height), "{size_px:?}");
        let pair = Pair { image, truth, width, height, weights: weights() };
        let blocked = counts.map(|counts| BlockedPixels::new(counts, width));
        let bands: Vec<Sums> = (0..height.div_ceil(BAND_ROWS))
            .into_par_iter()
            .map(|band| pair.band(band * BAND_ROWS, blocked.as_ref()))
            .collect();
        let mut all = Sums::default();
        // In the order of bands and not of threads, so that the last bits are the same every time.
        for band in &bands {
            all.within += band.within;
            all.windows += band.windows;
            all.mirrored += band.mirrored;
        }
        Self {
            within: all.within / all.windows as f64,
            mirrored: all.mirrored / (3 * width * height) as f64,
        }
    }
}

/// Sums over the windows of some rows.
#[derive(Default)]
struct Sums {
    within: f64,
    windows: usize,
    mirrored: f64,
}

/// Two images, and the weights of a window.
struct Pair<'a> {
    image: &'a [f64],
    truth: &'a [f64],
    width: usize,
    height: usize,
    weights: [f64; WINDOW_PX],
}

impl Pair<'_> {
    /// The windows around the pixels of [`BAND_ROWS`] rows.
    fn band(&self, first_row: usize, blocked: Option<&BlockedPixels>) -> Sums {
        let rows = BAND_ROWS.min(self.height - first_row);
        let mut sums = Sums::default();
        for channel in 0..3 {
            // The window is separable: means along rows once, and the sums down the columns from
            // them. The band needs the rows within the window's reach above and below, too.
            let means: Vec<Vec<[f64; 5]>> = (0..rows + 2 * REACH_PX)
                .map(|k| mirrored((first_row + k) as isize - REACH_PX as isize, self.height))
                .map(|row| self.row_means(row, channel))
                .collect();
            for row in 0..rows {
                let window = &means[row..row + WINDOW_PX];
                for column in 0..self.width {
                    let value = self.value(window, column);
                    sums.mirrored += value;
                    if self.is_within(first_row + row, column, blocked) {
                        sums.within += value;
                        // Counted once per channel, as are the values of `within`.
                        sums.windows += 1;
                    }
                }
            }
        }
        sums
    }

    /// Weighted means along a row, around each of its pixels: of both images, of their squares, and
    /// of their product.
    fn row_means(&self, row: usize, channel: usize) -> Vec<[f64; 5]> {
        let moments = |column: isize| {
            let at = 3 * (row * self.width + mirrored(column, self.width)) + channel;
            let a = self.image[at];
            let b = self.truth[at];
            [a, b, a * a, b * b, a * b]
        };
        let reach = REACH_PX as isize;
        let padded: Vec<[f64; 5]> = (-reach..self.width as isize + reach).map(moments).collect();
        padded.windows(WINDOW_PX).map(|window| self.weighted(window.iter())).collect()
    }

    /// The index of similarity of one window.
    fn value(&self, rows: &[Vec<[f64; 5]>], column: usize) -> f64 {
        let [ma, mb, aa, bb, ab] = self.weighted(rows.iter().map(|row| &row[column]));
        // The variance as a mean of squares minus the square of the mean: in f64, and with values
        // up to 1, rounding is far below C2.
        let va = aa - ma * ma;
        let vb = bb - mb * mb;
        let covariance = ab - ma * mb;
        (2.0 * ma * mb + C1) * (2.0 * covariance + C2) / ((ma * ma + mb * mb + C1) * (va + vb + C2))
    }

    fn weighted<'b>(&self, moments: impl Iterator<Item = &'b [f64; 5]>) -> [f64; 5] {
        let mut sum = [0.0; 5];
        for (weight, moments) in self.weights.iter().zip(moments) {
            for (sum, moment) in sum.iter_mut().zip(moments) {
                *sum += weight * moment;
            }
        }
        sum
    }

    /// Whether the window around a pixel lies within the image and has no blocked pixel.
    fn is_within(&self, row: usize, column: usize, blocked: Option<&BlockedPixels>) -> bool {
        let is_inside = |at: usize, side: usize| at >= REACH_PX && at + REACH_PX < side;
        is_inside(row, self.height)
            && is_inside(column, self.width)
            && blocked.is_none_or(|blocked| blocked.around(row, column) == 0)
    }
}

/// Numbers of pixels that do not count, above and left of each pixel.
struct BlockedPixels {
    sums: Vec<u32>,
    stride: usize,
}

impl BlockedPixels {
    fn new(counts: &[bool], width: usize) -> Self {
        let stride = width + 1;
        // A table with one row and one column of zeros before the first, so that a rectangle at the
        // edge needs no case of its own.
        let mut sums = vec![0; stride];
        for row in counts.chunks_exact(width) {
            let above = sums.len() - stride;
            let mut in_row = 0;
            sums.push(0);
            for (column, counts) in row.iter().enumerate() {
                in_row += u32::from(!counts);
                sums.push(sums[above + column + 1] + in_row);
            }
        }
        Self { sums, stride }
    }

    /// Number of pixels that do not count in the window around a pixel. The window lies within the
    /// image.
    fn around(&self, row: usize, column: usize) -> u32 {
        let top = (row - REACH_PX) * self.stride;
        let bottom = (row + REACH_PX + 1) * self.stride;
        let left = column - REACH_PX;
        let right = column + REACH_PX + 1;
        // By inclusion and exclusion. The additions come first, so that no difference is negative.
        self.sums[bottom + right] + self.sums[top + left]
            - self.sums[top + right]
            - self.sums[bottom + left]
    }
}

/// The pixel of a row of `side` pixels that replaces one beyond its ends: mirrored, without
/// repeating the last one.
fn mirrored(at: isize, side: usize) -> usize {
    let last = side as isize - 1;
    // Back and forth over the pixels has a period of 2 (side - 1); a side of 1 has none.
    let turns = at.rem_euclid((2 * last).max(1));
    if last == 0 { 0 } else { turns.min(2 * last - turns) as usize }
}

/// Weights of a Gaussian window along one axis, with sum 1.
fn weights() -> [f64; WINDOW_PX] {
    let mut weights = [0.0; WINDOW_PX];
    for (k, weight) in weights.iter_mut().enumerate() {
        let off_px = k as f64 - REACH_PX as f64;
        *weight = (-0.5 * (off_px / SIGMA_PX).powi(2)).exp();
    }
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stripes of 4 px, with a band of noise in the first `noisy` columns.
    fn striped(noisy: usize) -> Vec<f64> {
        let value = |i: usize| {
            let stripe = if (i % 40 / 4).is_multiple_of(2) { 0.2 } else { 0.7 };
            let noise =
                if i % 40 < noisy { 0.1 * ((i * 7919 % 13) as f64 / 6.0 - 1.0) } else { 0.0 };
            stripe + noise
        };
        (0..40 * 30).flat_map(|i| [value(i); 3]).collect()
    }

    #[test]
    fn an_image_is_like_itself_and_structure_counts_more_than_brightness() {
        let truth = striped(0);
        let same = Ssim::compare(&truth, &truth, [40, 30], None);
        assert_eq!(same, Ssim { within: 1.0, mirrored: 1.0 });
        let brighter: Vec<f64> = truth.iter().map(|value| value + 0.05).collect();
        let brighter = Ssim::compare(&brighter, &truth, [40, 30], None);
        let noisy = Ssim::compare(&striped(40), &truth, [40, 30], None);
        assert!(brighter.within > 0.97 && noisy.within < brighter.within, "{noisy:?}");
    }

    #[test]
    fn windows_with_a_masked_pixel_do_not_count() {
        // The noise lies in columns 0 to 9, and only columns from 10 on count: the first window
        // lies around column 15.
        let counts: Vec<bool> = (0..40 * 30).map(|i| i % 40 >= 10).collect();
        let noisy = striped(10);
        let masked = Ssim::compare(&noisy, &striped(0), [40, 30], Some(&counts));
        assert_eq!(masked.within, 1.0);
        assert!(masked.mirrored < 0.99, "{masked:?}");
        // One column more, and the windows at column 14 have its pixels.
        let counts: Vec<bool> = (0..40 * 30).map(|i| i % 40 >= 9).collect();
        assert!(Ssim::compare(&noisy, &striped(0), [40, 30], Some(&counts)).within < 1.0);
        let nothing = vec![false; 40 * 30];
        assert!(Ssim::compare(&noisy, &noisy, [40, 30], Some(&nothing)).within.is_nan());
    }

    #[test]
    fn an_image_smaller_than_a_window_is_mirrored() {
        assert_eq!([-3, -1, 0, 3, 4, 5, 6].map(|at| mirrored(at, 4)), [3, 1, 0, 3, 2, 1, 0]);
        assert_eq!([-5, 0, 5].map(|at| mirrored(at, 1)), [0; 3]);
        let one = Ssim::compare(&[0.5; 3], &[0.5; 3], [1, 1], None);
        assert!(one.within.is_nan() && one.mirrored == 1.0);
    }
}
