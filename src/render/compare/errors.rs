//! How far off images are: PSNR, SSIM, the largest error and the 99.9th percentile, and depth in metres.

use serde::Serialize;

use super::json_numbers::serialize_number;
use crate::compare::psnr::psnr_db;

/// How far off a set of images is. Values are those of colour, clamped to [0, 1] as they are shown.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ImageErrors {
    /// Peak signal-to-noise ratio of all values together, in dB; infinite where none differs.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// Mean structural similarity of the images' luma; 1 where nothing differs.
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
    /// Largest error of a value.
    #[serde(serialize_with = "serialize_number")]
    pub max: f64,
    /// The error that all but one of a thousand values keep below.
    #[serde(serialize_with = "serialize_number")]
    pub p99_9: f64,
    /// Mean error of the depth, in metres, where both images cover at least half of the pixel.
    #[serde(serialize_with = "serialize_number")]
    pub depth_l1_m: f64,
}

/// One image that is compared with another one.
#[derive(Clone, Debug)]
pub struct Image {
    /// Width and height, in pixels.
    pub size_px: [u32; 2],
    /// `[height, width, 3]`: colour from 0 to 1.
    pub rgb: Vec<f32>,
    /// `[height, width]`, in metres.
    pub depth_m: Vec<f32>,
    /// `[height, width]`.
    pub opacity: Vec<f32>,
}

impl Image {
    /// The same at another size: colour and opacity bilinearly, depth from the nearest pixel, since between
    /// two depths there is nothing.
    pub fn resized(&self, [width, height]: [u32; 2]) -> Self {
        let [own_width, own_height] = self.size_px.map(|px| px as usize);
        let mut new = Self {
            size_px: [width, height],
            rgb: Vec::with_capacity(3 * (width * height) as usize),
            depth_m: Vec::with_capacity((width * height) as usize),
            opacity: Vec::with_capacity((width * height) as usize),
        };
        // The place of a pixel's centre among the centres of the own pixels, and its two neighbours.
        let neighbours = |i: u32, count: u32, own: usize| {
            let at = (f64::from(i) + 0.5) * own as f64 / f64::from(count) - 0.5;
            let at = at.clamp(0.0, (own - 1) as f64);
            let low = at.floor() as usize;
            (low, (low + 1).min(own - 1), at.fract() as f32)
        };
        for y in 0..height {
            let (top, bottom, down) = neighbours(y, height, own_height);
            for x in 0..width {
                let (left, right, across) = neighbours(x, width, own_width);
                let mixed = |value: &dyn Fn(usize) -> f32| {
                    let row = |y: usize| {
                        let (l, r) = (value(y * own_width + left), value(y * own_width + right));
                        l + across * (r - l)
                    };
                    row(top) + down * (row(bottom) - row(top))
                };
                new.rgb.extend([0, 1, 2].map(|c| mixed(&|pixel| self.rgb[3 * pixel + c])));
                new.opacity.push(mixed(&|pixel| self.opacity[pixel]));
                let nearest = |near, far, share| if share < 0.5 { near } else { far };
                let pixel = nearest(top, bottom, down) * own_width + nearest(left, right, across);
                new.depth_m.push(self.depth_m[pixel]);
            }
        }
        new
    }
}

/// What is gathered of pairs of images.
#[derive(Clone, Debug, Default)]
pub struct ErrorAccumulator {
    errors: Vec<f32>,
    ssims: Vec<f64>,
    depth_sum_m: f64,
    depths: u64,
}

impl ErrorAccumulator {
    /// Adds an image and what it should be, of the same size. Gives the pair's own PSNR in dB.
    pub fn add(&mut self, image: &Image, truth: &Image) -> f64 {
        let before = self.errors.len();
        let pairs = image.rgb.iter().zip(&truth.rgb);
        self.errors.extend(pairs.map(|(a, b)| (a - b).abs()));
        self.ssims.push(ssim(image, truth));
        for (pixel, (depth_m, truth_m)) in image.depth_m.iter().zip(&truth.depth_m).enumerate() {
            if image.opacity[pixel] >= 0.5 && truth.opacity[pixel] >= 0.5 {
                self.depth_sum_m += f64::from((depth_m - truth_m).abs());
                self.depths += 1;
            }
        }
        psnr_db(self.errors[before..].iter().map(|&off| f64::from(off)))
    }

    /// Adds what was gathered elsewhere.
    pub fn merge(&mut self, other: &Self) {
        self.errors.extend_from_slice(&other.errors);
        self.ssims.extend_from_slice(&other.ssims);
        self.depth_sum_m += other.depth_sum_m;
        self.depths += other.depths;
    }

    /// The errors of all that was added; `None` of nothing.
    pub fn errors(&self) -> Option<ImageErrors> {
        let mut sorted = self.errors.clone();
        sorted.sort_unstable_by(f32::total_cmp);
        let max = f64::from(*sorted.last()?);
        let at = ((sorted.len() - 1) as f64 * 0.999).ceil() as usize;
        Some(ImageErrors {
            psnr_db: psnr_db(sorted.iter().map(|&off| f64::from(off))),
            ssim: self.ssims.iter().sum::<f64>() / self.ssims.len() as f64,
            max,
            p99_9: f64::from(sorted[at]),
            depth_l1_m: self.depth_sum_m / self.depths.max(1) as f64,
        })
    }
}

/// Edge of the window of SSIM, in pixels, and its standard deviation (Wang et al. 2004).
const WINDOW: usize = 11;
const SIGMA_PX: f64 = 1.5;
/// Wang et al. 2004: `(0.01 L)²` and `(0.03 L)²`, of values from 0 to L = 1.
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Mean structural similarity of luma over all windows within the image; of an image smaller than a
/// window, over the image as one window.
pub fn ssim(image: &Image, truth: &Image) -> f64 {
    let [width, height] = image.size_px.map(|px| px as usize);
    let (a, b) = (luma(&image.rgb), luma(&truth.rgb));
    let products = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).collect::<Vec<_>>();
    let mean = |values: &[f64]| smooth(values, width, height);
    let (mean_a, mean_b) = (mean(&a), mean(&b));
    let (square_a, square_b, mixed) =
        (mean(&products(&a, &a)), mean(&products(&b, &b)), mean(&products(&a, &b)));
    let at = |i: usize| {
        let (ma, mb) = (mean_a[i], mean_b[i]);
        let (va, vb) = (square_a[i] - ma * ma, square_b[i] - mb * mb);
        let covariance = mixed[i] - ma * mb;
        (2.0 * ma * mb + C1) * (2.0 * covariance + C2) / ((ma * ma + mb * mb + C1) * (va + vb + C2))
    };
    (0..mean_a.len()).map(at).sum::<f64>() / mean_a.len() as f64
}

/// ITU-R BT.601.
fn luma(rgb: &[f32]) -> Vec<f64> {
    let weights = [0.299, 0.587, 0.114];
    let pixel = |rgb: &[f32]| rgb.iter().zip(weights).map(|(&v, w)| w * f64::from(v)).sum();
    rgb.chunks_exact(3).map(pixel).collect()
}

/// Weighted means over all windows within the image: columns, then rows.
fn smooth(values: &[f64], width: usize, height: usize) -> Vec<f64> {
    let (across, down) = (weights(WINDOW.min(width)), weights(WINDOW.min(height)));
    let (columns, rows) = (width + 1 - across.len(), height + 1 - down.len());
    let sum = |weights: &[f64], at: &dyn Fn(usize) -> f64| {
        weights.iter().enumerate().map(|(k, weight)| weight * at(k)).sum::<f64>()
    };
    let mut within_rows = Vec::with_capacity(columns * height);
    for row in values.chunks_exact(width) {
        within_rows.extend((0..columns).map(|x| sum(&across, &|k| row[x + k])));
    }
    let cell = |i: usize| sum(&down, &|k| within_rows[i + k * columns]);
    (0..columns * rows).map(cell).collect()
}

/// A Gaussian of `count` pixels whose sum is 1.
fn weights(count: usize) -> Vec<f64> {
    let at = |k: usize| {
        let off = k as f64 - 0.5 * (count - 1) as f64;
        (-0.5 * (off / SIGMA_PX).powi(2)).exp()
    };
    let weights: Vec<f64> = (0..count).map(at).collect();
    let sum: f64 = weights.iter().sum();
    weights.into_iter().map(|weight| weight / sum).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stripes of a width, and some noise.
    fn striped(stripe: usize, noise: f32) -> Image {
        let (width, height) = (40, 30);
        let value = |i: usize| {
            let x = i % width / stripe % 2;
            0.2 + 0.5 * x as f32 + noise * ((i * 7919 % 13) as f32 / 6.0 - 1.0)
        };
        Image {
            size_px: [width as u32, height as u32],
            rgb: (0..width * height).flat_map(|i| [value(i); 3]).collect(),
            depth_m: vec![5.0; width * height],
            opacity: vec![1.0; width * height],
        }
    }

    #[test]
    fn known_errors() {
        let (truth, mut image) = (striped(4, 0.0), striped(4, 0.0));
        let mut gathered = ErrorAccumulator::default();
        assert_eq!(gathered.add(&image, &truth), f64::INFINITY);
        assert_eq!(gathered.errors().unwrap().ssim, 1.0);
        // A tenth everywhere is 20 dB; one value of 3,600 is beyond the 99.9th percentile.
        image.rgb.iter_mut().for_each(|value| *value += 0.1);
        image.rgb[7] += 0.3;
        image.depth_m[..600].fill(5.5);
        image.opacity[1199] = 0.4;
        image.depth_m[1199] = 1e6;
        let mut gathered = ErrorAccumulator::default();
        gathered.add(&image, &truth);
        let errors = gathered.errors().unwrap();
        assert!((errors.psnr_db - 20.0).abs() < 0.1, "{errors:?}");
        assert!((errors.max - 0.4).abs() < 1e-6 && (errors.p99_9 - 0.1).abs() < 1e-6, "{errors:?}");
        assert!((errors.depth_l1_m - 300.0 / 1199.0).abs() < 1e-6, "{errors:?}");
        assert_eq!(ErrorAccumulator::default().errors(), None);
    }

    #[test]
    fn half_the_size_and_back_is_the_mean_of_four() {
        let ramp = Image {
            size_px: [2, 2],
            rgb: vec![0.0, 0.0, 0.0, 0.4, 0.4, 0.4, 0.8, 0.8, 0.8, 0.4, 0.4, 0.4],
            depth_m: vec![1.0, 2.0, 3.0, 4.0],
            opacity: vec![0.0, 1.0, 1.0, 1.0],
        };
        let one = ramp.resized([1, 1]);
        assert!((one.rgb[0] - 0.4).abs() < 1e-6 && (one.opacity[0] - 0.75).abs() < 1e-6);
        let larger = ramp.resized([4, 4]);
        assert_eq!([larger.rgb[0], larger.depth_m[0], larger.depth_m[15]], [0.0, 1.0, 4.0]);
        assert!((larger.rgb[3] - 0.1).abs() < 1e-6, "{}", larger.rgb[3]);
        assert_eq!(ramp.resized([2, 2]).rgb, ramp.rgb);
    }

    #[test]
    fn similarity_is_of_structure() {
        let truth = striped(4, 0.0);
        let mut brighter = truth.clone();
        brighter.rgb.iter_mut().for_each(|value| *value += 0.05);
        let [brighter, noisy, other] =
            [brighter, striped(4, 0.05), striped(5, 0.0)].map(|image| ssim(&image, &truth));
        assert!(brighter > 0.97 && brighter < 1.0, "{brighter}");
        assert!(noisy < brighter && noisy > 0.5 && other < 0.6, "{noisy}, {other}");
    }

    /// One window of two values each, by hand: means 0.5 and 0.25, variances 0.25 and 0.0625, covariance
    /// 0.125, so (0.25 + C1)(0.25 + C2) / ((0.3125 + C1)(0.3125 + C2)).
    #[test]
    fn similarity_of_a_single_window() {
        let image = |high: f32| Image {
            size_px: [2, 1],
            rgb: vec![0.0, 0.0, 0.0, high, high, high],
            depth_m: vec![1.0; 2],
            opacity: vec![1.0; 2],
        };
        let wanted = (0.25 + C1) * (0.25 + C2) / ((0.3125 + C1) * (0.3125 + C2));
        assert!((ssim(&image(1.0), &image(0.5)) - wanted).abs() < 1e-7);
    }
}
