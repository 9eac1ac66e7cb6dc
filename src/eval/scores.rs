//! PSNR, SSIM and FLIP of a pair of images.

use serde::Serialize;

use super::exposure::Exposure;
use super::pair::Pair;
use wildcity_render::compare::flip::flip;
use wildcity_render::compare::json_numbers::serialize_number;
use wildcity_render::compare::psnr::psnr_db;
use wildcity_render::compare::ssim::Ssim;

/// Differences of a rendered image and the real one. A number is NaN if no pixel counts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// Peak signal-to-noise ratio over the pixels that count, in dB; infinite if none differs.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// [`Ssim::within`]: windows within the image, without masked pixels.
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
    /// [`Ssim::mirrored`]: all pixels, masked ones too.
    #[serde(serialize_with = "serialize_number")]
    pub ssim_mirrored: f64,
    /// Mean of LDR-FLIP over the pixels that count. Masked pixels are replaced by the real image
    /// before.
    #[serde(serialize_with = "serialize_number")]
    pub flip: f64,
    /// Distance of the two images by the network that the user gave; `None` without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    /// Share of the pixels that count, from 0 to 1.
    pub counted: f64,
    /// The scores after the best change of exposure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub aligned: Option<AlignedScores>,
}

/// Scores after the best change of exposure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AlignedScores {
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
    pub exposure: Exposure,
}

/// Scores, and what means over the pixels of several images need.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Scored {
    #[serde(flatten)]
    pub scores: Scores,
    /// Sum of the squared errors of all values that count, from 0 to 1 each.
    #[serde(skip)]
    pub(super) squared_error: f64,
    /// Number of these values.
    #[serde(skip)]
    pub(super) values: u64,
}

/// The scores of a pair, and the other results of its comparison.
#[derive(Clone, Debug)]
pub struct PairScores {
    pub scores: Scores,
    /// FLIP of each pixel, from 0 to 1; 0 for pixels that do not count.
    pub error_map: Vec<f32>,
    /// Sum of the squared errors of all values that count, from 0 to 1 each.
    pub squared_error: f64,
    /// Number of these values.
    pub values: u64,
}

impl PairScores {
    /// Compares a pair; with `align` also after the best change of exposure.
    pub fn compare(pair: &Pair, align: bool) -> Self {
        let squares = pair.counted().map(|(rendered, truth)| {
            [0, 1, 2].map(|c: usize| (rendered[c] - truth[c]).powi(2)).iter().sum::<f64>()
        });
        let (squared_error, values) =
            squares.fold((0.0, 0), |(sum, count), square| (sum + square, count + 3));
        let truth = units(pair.truth());
        let ssim = Ssim::compare(&units(pair.rendered()), &truth, pair.size_px(), pair.counts());
        let error_map = error_map(pair);
        let error_sum: f64 = error_map.iter().map(|&error| f64::from(error)).sum();
        let scores = Scores {
            psnr_db: pooled_psnr_db(squared_error, values),
            ssim: ssim.within,
            ssim_mirrored: ssim.mirrored,
            // A mean over pixels: 0/0 is NaN if none counts.
            flip: error_sum / (values / 3) as f64,
            lpips: None,
            counted: pair.counted_share(),
            aligned: align.then(|| aligned(pair, &truth)),
        };
        Self { scores, error_map, squared_error, values }
    }

    /// The scores and sums, without the map.
    pub fn scored(&self) -> Scored {
        let &Self { scores, squared_error, values, .. } = self;
        Scored { scores, squared_error, values }
    }
}

/// PSNR of all values together, in dB.
pub(super) fn pooled_psnr_db(squared_error: f64, values: u64) -> f64 {
    // Values are from 0 to 1, so that the peak is 1: -10 log10(mean squared error). Without an
    // error it is infinite, without values NaN.
    -10.0 * (squared_error / values as f64).log10()
}

fn units(rgb8: &[u8]) -> Vec<f64> {
    rgb8.iter().map(|&byte| f64::from(byte) / 255.0).collect()
}

/// FLIP of each pixel. Where a pixel does not count, both images are the real one, so that it blurs
/// into no other.
fn error_map(pair: &Pair) -> Vec<f32> {
    let unit = |byte: &u8| f32::from(*byte) / 255.0;
    // f32 is what the FLIP of the renderer takes.
    let truth: Vec<f32> = pair.truth().iter().map(unit).collect();
    let mut rendered: Vec<f32> = pair.rendered().iter().map(unit).collect();
    for (pixel, (rendered, truth)) in
        rendered.chunks_exact_mut(3).zip(truth.chunks_exact(3)).enumerate()
    {
        if !pair.is_counted(pixel) {
            rendered.copy_from_slice(truth);
        }
    }
    // FLIP filters with a kernel, so that a pixel's error also depends on its neighbours; pixels
    // that do not count get none of it.
    let mut errors = flip(&rendered, &truth, pair.size_px());
    for (pixel, error) in errors.iter_mut().enumerate() {
        if !pair.is_counted(pixel) {
            *error = 0.0;
        }
    }
    errors
}

fn aligned(pair: &Pair, truth: &[f64]) -> AlignedScores {
    let exposure = Exposure::fit(pair);
    // Clamped by `apply` as a display would, before the difference.
    let differences = pair.counted().flat_map(|(rendered, truth)| {
        let rendered = exposure.apply(rendered);
        [0, 1, 2].map(|c: usize| rendered[c] - truth[c])
    });
    let psnr_db = psnr_db(differences);
    let changed: Vec<f64> = units(pair.rendered())
        .chunks_exact(3)
        .flat_map(|rgb| exposure.apply([rgb[0], rgb[1], rgb[2]]))
        .collect();
    let ssim = Ssim::compare(&changed, truth, pair.size_px(), pair.counts()).within;
    AlignedScores { psnr_db, ssim, exposure }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A textured image, and a copy with +20 in the left half.
    fn images() -> (Vec<u8>, Vec<u8>) {
        // Values of 40 to 159, so that 20 more stay below 255.
        let truth: Vec<u8> = (0..3 * 40 * 30).map(|i| 40 + (i * 7919 % 120) as u8).collect();
        let spoil = |(i, value): (usize, &u8)| value + if i / 3 % 40 < 20 { 20 } else { 0 };
        let rendered = truth.iter().enumerate().map(spoil).collect();
        (truth, rendered)
    }

    #[test]
    fn only_pixels_that_count_are_compared() {
        let (truth, rendered) = images();
        let scores = |counts| {
            let pair = Pair::new([40, 30], truth.clone(), rendered.clone(), counts).unwrap();
            PairScores::compare(&pair, true)
        };
        let all = scores(None).scores;
        // Half of the values are off by 20.
        let wanted_db = -10.0 * (0.5 * (20.0_f64 / 255.0).powi(2)).log10();
        assert!((all.psnr_db - wanted_db).abs() < 1e-9, "{all:?}");
        assert!(all.ssim < 1.0 && all.flip > 0.01 && all.counted == 1.0, "{all:?}");
        let right = scores(Some((0..1200).map(|i| i % 40 >= 20).collect()));
        assert_eq!(right.scores.psnr_db, f64::INFINITY);
        assert_eq!((right.scores.ssim, right.scores.flip, right.scores.counted), (1.0, 0.0, 0.5));
        assert!(right.scores.ssim_mirrored < 1.0, "masked pixels count there");
        let left = scores(Some((0..1200).map(|i| i % 40 < 20).collect()));
        // The left half alone is off by 20 everywhere.
        let left_db = 20.0 * (255.0_f64 / 20.0).log10();
        assert!((left.scores.psnr_db - left_db).abs() < 1e-9, "{left:?}");
        assert!(left.error_map.iter().enumerate().all(|(i, e)| (i % 40 < 20) == (*e > 0.0)));
        // After the best change of exposure, that half equals the truth again.
        assert!(left.scores.aligned.unwrap().psnr_db > 200.0);
        let nothing = scores(Some(vec![false; 1200])).scores;
        // A single pixel that does not count takes its windows away.
        let mut one = truth.clone();
        one[3 * (15 * 40 + 20)] = 255;
        let counts = (0..1200).map(|i| i != 15 * 40 + 20).collect();
        let pair = Pair::new([40, 30], truth.clone(), one, Some(counts)).unwrap();
        assert_eq!(PairScores::compare(&pair, false).scores.ssim, 1.0);
        assert!(nothing.psnr_db.is_nan() && nothing.ssim.is_nan() && nothing.flip.is_nan());
    }
}
