//! Errors of images against reference images: PSNR, SSIM, the largest error and its 99.9th
//! percentile, and the mean error of depth in metres.

use serde::Serialize;

use super::json_numbers::serialize_number;
use crate::compare::psnr::psnr_db;
use crate::compare::ssim::Ssim;

/// Errors of a set of images. Values are those of colour, clamped to [0, 1] as displayed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ImageErrors {
    /// Peak signal-to-noise ratio of all values together, in dB; infinite if none differs.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// Mean structural similarity of the images ([`Ssim::within`]); 1 if nothing differs.
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
    /// Largest error of a value.
    #[serde(serialize_with = "serialize_number")]
    pub max: f64,
    /// 99.9th percentile of the errors of values.
    #[serde(serialize_with = "serialize_number")]
    pub p99_9: f64,
    /// Mean error of depth, in metres, over pixels where both images have an opacity of at least
    /// 1/2.
    #[serde(serialize_with = "serialize_number")]
    pub depth_l1_m: f64,
}

/// An image that is compared with another.
#[derive(Clone, Debug)]
pub struct Image {
    /// Width and height, in pixels.
    pub size_px: [u32; 2],
    /// `[height, width, 3]`: colour from 0 to 1.
    pub rgb: Vec<f32>,
    /// `[height, width]`, in metres.
    pub depth_m: Vec<f32>,
    /// `[height, width]`, from 0 to 1.
    pub opacity: Vec<f32>,
}

/// The rows or columns of an image that one row or column of a smaller image covers.
struct Coverage {
    first: usize,
    /// Shares of it and of those that follow in the covered part; the sum is 1.
    shares: Vec<f32>,
}

impl Coverage {
    /// The coverage of all `count` new rows over `own` rows.
    fn all(count: u32, own: u32) -> Vec<Self> {
        // Rows of the own image per row of the smaller one: 1 or more.
        let step = f64::from(own) / f64::from(count);
        let of_one = |i: u32| {
            let begin = f64::from(i) * step;
            let end = begin + step;
            let first = begin.floor() as usize;
            // Rounding may put the last end just above the own number of rows.
            let last = (end.ceil() as usize).min(own as usize);
            // The overlap of [begin, end] and the row [k, k + 1].
            let covered = |k: usize| end.min(k as f64 + 1.0) - begin.max(k as f64);
            let shares = (first..last).map(|k| (covered(k).max(0.0) / step) as f32).collect();
            Self { first, shares }
        };
        (0..count).map(of_one).collect()
    }
}

impl Image {
    /// A smaller image in which each pixel is the mean of the pixels that it covers, as an agent
    /// shrinks an image. The mean of depths is weighted by opacity, as depths of Gaussians are
    /// within a pixel.
    pub fn averaged(&self, [width, height]: [u32; 2]) -> Self {
        let [own_width, own_height] = self.size_px;
        let mut new = Self {
            size_px: [width, height],
            rgb: Vec::new(),
            depth_m: Vec::new(),
            opacity: Vec::new(),
        };
        let columns = Coverage::all(width, own_width);
        for row in Coverage::all(height, own_height) {
            for column in &columns {
                let mut rgb = [0.0; 3];
                let mut opacity = 0.0;
                let mut depth = 0.0;
                // The shares of rows and columns each sum to 1, and so do their products.
                for (y, down) in row.shares.iter().enumerate() {
                    for (x, across) in column.shares.iter().enumerate() {
                        let pixel = (row.first + y) * own_width as usize + column.first + x;
                        let share = down * across;
                        for (sum, value) in rgb.iter_mut().zip(&self.rgb[3 * pixel..]) {
                            *sum += share * value;
                        }
                        opacity += share * self.opacity[pixel];
                        depth += share * self.opacity[pixel] * self.depth_m[pixel];
                    }
                }
                new.rgb.extend(rgb);
                new.opacity.push(opacity);
                // A pixel without opacity has no depth: 0, as in a rendered image.
                new.depth_m.push(if opacity > 0.0 { depth / opacity } else { 0.0 });
            }
        }
        new
    }
}

/// Accumulates the errors of pairs of images.
#[derive(Clone, Debug, Default)]
pub struct ErrorAccumulator {
    errors: Vec<f32>,
    ssims: Vec<f64>,
    depth_sum_m: f64,
    depths: u64,
}

impl ErrorAccumulator {
    /// Adds an image and its reference, of the same size. Returns the PSNR of the pair in dB.
    pub fn add(&mut self, image: &Image, truth: &Image) -> f64 {
        let before = self.errors.len();
        let pairs = image.rgb.iter().zip(&truth.rgb);
        self.errors.extend(pairs.map(|(a, b)| (a - b).abs()));
        self.ssims.push(ssim(image, truth));
        for (pixel, (depth_m, truth_m)) in image.depth_m.iter().zip(&truth.depth_m).enumerate() {
            // Below one half the depth is a mean of a faint surface and of what lies behind it.
            if image.opacity[pixel] >= 0.5 && truth.opacity[pixel] >= 0.5 {
                self.depth_sum_m += f64::from((depth_m - truth_m).abs());
                self.depths += 1;
            }
        }
        // Only of the values that this pair has added.
        psnr_db(self.errors[before..].iter().map(|&off| f64::from(off)))
    }

    /// Adds the pairs of another accumulator.
    pub fn merge(&mut self, other: &Self) {
        self.errors.extend_from_slice(&other.errors);
        self.ssims.extend_from_slice(&other.ssims);
        self.depth_sum_m += other.depth_sum_m;
        self.depths += other.depths;
    }

    /// The errors of all pairs; `None` without pairs.
    pub fn errors(&self) -> Option<ImageErrors> {
        let mut sorted = self.errors.clone();
        sorted.sort_unstable_by(f32::total_cmp);
        let max = f64::from(*sorted.last()?);
        // Rounded up to the next value of the list: a percentile of few values is their largest.
        let at = ((sorted.len() - 1) as f64 * 0.999).ceil() as usize;
        Some(ImageErrors {
            psnr_db: psnr_db(sorted.iter().map(|&off| f64::from(off))),
            ssim: self.ssims.iter().sum::<f64>() / self.ssims.len() as f64,
            max,
            p99_9: f64::from(sorted[at]),
            // Images without any depth have no error of depth, and not NaN.
            depth_l1_m: self.depth_sum_m / self.depths.max(1) as f64,
        })
    }
}

/// [`Ssim::within`] of two images. An image smaller than a window has none, and is compared with
/// mirrored edges.
fn ssim(image: &Image, truth: &Image) -> f64 {
    let [a, b] =
        [image, truth].map(|image| image.rgb.iter().map(|&v| v.into()).collect::<Vec<f64>>());
    let ssim = Ssim::compare(&a, &b, image.size_px, None);
    if ssim.within.is_nan() { ssim.mirrored } else { ssim.within }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An image of vertical stripes of a width, with noise of an amplitude.
    fn striped(stripe: usize, noise: f32) -> Image {
        let width = 40;
        let height = 30;
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
        let truth = striped(4, 0.0);
        // Two equal images: no error at all.
        let mut image = striped(4, 0.0);
        let mut accumulator = ErrorAccumulator::default();
        assert_eq!(accumulator.add(&image, &truth), f64::INFINITY);
        assert_eq!(accumulator.errors().unwrap().ssim, 1.0);
        // A tenth everywhere is 20 dB; one value of 3,600 is beyond the 99.9th percentile.
        image.rgb.iter_mut().for_each(|value| *value += 0.1);
        image.rgb[7] += 0.3;
        // Of 1,200 pixels 600 are off by 0.5 m, which adds up to 300 m. The last pixel is too faint
        // to count, so that 1,199 remain and its error of a million metres has no effect.
        image.depth_m[..600].fill(5.5);
        image.opacity[1199] = 0.4;
        image.depth_m[1199] = 1e6;
        let mut accumulator = ErrorAccumulator::default();
        accumulator.add(&image, &truth);
        let errors = accumulator.errors().unwrap();
        assert!((errors.psnr_db - 20.0).abs() < 0.1, "{errors:?}");
        assert!((errors.max - 0.4).abs() < 1e-6 && (errors.p99_9 - 0.1).abs() < 1e-6, "{errors:?}");
        assert!((errors.depth_l1_m - 300.0 / 1199.0).abs() < 1e-6, "{errors:?}");
        assert_eq!(ErrorAccumulator::default().errors(), None);
    }

    #[test]
    fn a_shrunk_image_is_the_mean_of_what_its_pixels_cover() {
        let ramp = Image {
            size_px: [3, 1],
            rgb: vec![0.0, 0.0, 0.0, 0.3, 0.3, 0.3, 0.9, 0.9, 0.9],
            depth_m: vec![5.0, 1.0, 2.0],
            opacity: vec![0.0, 0.5, 1.0],
        };
        let one = ramp.averaged([1, 1]);
        assert!((one.rgb[0] - 0.4).abs() < 1e-6 && (one.opacity[0] - 0.5).abs() < 1e-6);
        // Weighted by opacity: (0.5 x 1 + 1 x 2)/(0 + 0.5 + 1); the pixel at 5 m is transparent.
        assert!((one.depth_m[0] - 2.5 / 1.5).abs() < 1e-6, "{}", one.depth_m[0]);
        // The second of two pixels covers half of the middle one: (0.15 + 0.9)/1.5.
        let two = ramp.averaged([2, 1]);
        assert!((two.rgb[3] - 0.7).abs() < 1e-6, "{}", two.rgb[3]);
        assert_eq!(ramp.averaged([3, 1]).rgb, ramp.rgb);
    }
}
