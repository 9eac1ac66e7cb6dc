//! Means of the values of some images.

use serde::Serialize;

use super::evaluated_image::EvaluatedImage;
use super::lidar::LidarMeans;
use super::mean::mean;
use super::scores::{AlignedScores, Scored, Scores, pooled_psnr_db};
use wildcity_render::compare::json_numbers::serialize_number;

/// Means of the values of some images. Images without a pixel that counts are left out. NaN if no
/// image is left.
#[derive(Clone, Debug, Serialize)]
pub struct Means {
    pub images: usize,
    /// Means of the images as they were rendered.
    #[serde(flatten)]
    pub rendered: ScoreMeans,
    /// Means of the same images after the repair; `None` without a repair.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repaired: Option<ScoreMeans>,
    /// Repaired minus rendered; `None` without a repair.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain: Option<Gain>,
    /// Depth against LiDAR; `None` if it was not requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lidar: Option<LidarMeans>,
}

/// Means of the scores over all images.
#[derive(Clone, Debug, Serialize)]
pub struct ScoreMeans {
    /// Mean PSNR, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// PSNR of the pixels of all images together, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub pooled_psnr_db: f64,
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
    #[serde(serialize_with = "serialize_number")]
    pub ssim_mirrored: f64,
    #[serde(serialize_with = "serialize_number")]
    pub flip: f64,
    /// Mean of [`Scores::lpips`]; `None` if it was not requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    /// Means after the best change of exposure; `None` if they were not requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub aligned: Option<AlignedMeans>,
}

/// Means after the best change of exposure of each image.
#[derive(Clone, Debug, Serialize)]
pub struct AlignedMeans {
    /// Mean PSNR, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
}

/// The change by a repair: the mean after it minus the mean before. Larger is better for PSNR and
/// SSIM, smaller for the others.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Gain {
    /// Change of PSNR, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
    #[serde(serialize_with = "serialize_number")]
    pub flip: f64,
    /// Change of LPIPS; `None` if it was not requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
}

/// Means of the images of one camera.
#[derive(Clone, Debug, Serialize)]
pub struct CameraMeans {
    /// Folder of the images' names.
    pub camera: String,
    #[serde(flatten)]
    pub means: Means,
}

impl Means {
    pub(super) fn from_images(images: &[&EvaluatedImage]) -> Self {
        // An image without counted pixels has NaN everywhere; LiDAR below has its own points and
        // counts all images.
        let counted = images.iter().copied().filter(|image| image.rendered.values > 0);
        let counted: Vec<&EvaluatedImage> = counted.collect();
        let rendered: Vec<&Scored> = counted.iter().map(|image| &image.rendered).collect();
        let repaired: Vec<&Scored> =
            counted.iter().filter_map(|image| image.repaired.as_ref()).collect();
        // Of the same images, so that the gain compares like with like.
        let rendered = ScoreMeans::from_scored(&rendered);
        let repaired = (!repaired.is_empty()).then(|| ScoreMeans::from_scored(&repaired));
        let gain = repaired.as_ref().map(|repaired| Gain::between(&rendered, repaired));
        let lidar = LidarMeans::from_images(images.iter().filter_map(|image| image.lidar.as_ref()));
        Self { images: counted.len(), rendered, repaired, gain, lidar }
    }
}

impl ScoreMeans {
    fn from_scored(scored: &[&Scored]) -> Self {
        let mean = |value: &dyn Fn(&Scores) -> f64| {
            // A mask may leave pixels, but not a whole window.
            mean(scored.iter().map(|scored| value(&scored.scores)).filter(|v| !v.is_nan()))
        };
        // Requested for all images or for none; NaN for one that lacks it.
        let is_aligned = scored.iter().any(|scored| scored.scores.aligned.is_some());
        let aligned = |value: &dyn Fn(&AlignedScores) -> f64| {
            mean(&|scores| scores.aligned.as_ref().map_or(f64::NAN, value))
        };
        let has_lpips = scored.iter().any(|scored| scored.scores.lpips.is_some());
        Self {
            psnr_db: mean(&|scores| scores.psnr_db),
            // Sums over all images, then the logarithm: images count by their pixels.
            pooled_psnr_db: pooled_psnr_db(
                scored.iter().map(|scored| scored.squared_error).sum(),
                scored.iter().map(|scored| scored.values).sum(),
            ),
            ssim: mean(&|scores| scores.ssim),
            ssim_mirrored: mean(&|scores| scores.ssim_mirrored),
            flip: mean(&|scores| scores.flip),
            lpips: has_lpips.then(|| mean(&|scores| scores.lpips.unwrap_or(f64::NAN))),
            aligned: is_aligned.then(|| AlignedMeans {
                psnr_db: aligned(&|scores| scores.psnr_db),
                ssim: aligned(&|scores| scores.ssim),
            }),
        }
    }
}

impl Gain {
    fn between(before: &ScoreMeans, after: &ScoreMeans) -> Self {
        Self {
            psnr_db: after.psnr_db - before.psnr_db,
            ssim: after.ssim - before.ssim,
            flip: after.flip - before.flip,
            lpips: after.lpips.zip(before.lpips).map(|(after, before)| after - before),
        }
    }
}
