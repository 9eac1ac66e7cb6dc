//! The scores of all held-out images, and their means.

use std::collections::BTreeMap;

use serde::Serialize;

use super::evaluated_image::EvaluatedImage;
use super::extrapolation::Extrapolation;
use super::kid::KidScores;
use super::means::{CameraMeans, Means};
use wildcity_scene::RenderProfile;

const FORMAT: &str = "wildcity.eval/1";

/// What each number means, by its name in eval.json.
const CONVENTIONS: [(&str, &str); 14] = [
    ("mean", "of the values of the images, not of the pixels of all"),
    (
        "psnr_db",
        "8-bit sRGB values, peak 255, over the pixels that count; pooled_psnr_db is of all images' pixels together",
    ),
    (
        "ssim",
        "RGB channels, Gaussian window of 11 px with sigma 1.5, population variance, windows within the image and without \
         masked pixels: Wang et al. 2004; scikit-image with gaussian_weights=True, sigma=1.5, \
         use_sample_covariance=False",
    ),
    (
        "ssim_mirrored",
        "the same over all pixels with the image mirrored at its edges, masked pixels too: torchmetrics' default, gsplat",
    ),
    (
        "flip",
        "mean LDR-FLIP at 67.02 pixels per degree: flip-evaluator; masked pixels do not count",
    ),
    ("counted", "share of the pixels that count: not masked, and within the lens' field"),
    (
        "aligned",
        "after the affine change (gain and offset) of each rendered channel that fits the real image best in least squares",
    ),
    (
        "repaired",
        "the same numbers after the repair by subject.repair.model, whatever the trust; gain is repaired minus rendered",
    ),
    (
        "lpips",
        "output of the network subject.lpips_network for (image, real image); pixels that do not count are the real image's",
    ),
    (
        "kid",
        "unbiased squared MMD of features with the kernel (x.y / d + 1)^3, over random subsets: Binkowski et al. 2018",
    ),
    (
        "moving",
        "share of the pixels within the convex hulls of boxes that move faster than 1 m/s, grown by 3 px; they do not count",
    ),
    (
        "lidar",
        "absolute difference of rendered depth and LiDAR in metres, where pixels count and the opacity is at least 1/2; of \
         points within 2 px the nearest; to 80 m",
    ),
    (
        "reprojection",
        "the view beside the drive brought back onto the real image by rendered depth, where both depths agree within 5 % + \
         0.2 m; share is that of the real image's pixels",
    ),
    (
        "flicker",
        "mean absolute difference of a view and the view 0.8 m before it on the same line, brought into it likewise",
    ),
];

/// The scene and the images that were compared.
#[derive(Clone, Debug, Serialize)]
pub struct Subject {
    /// Name of the twin, or the scene file.
    pub scene: String,
    /// Number of the twin's version; none of a file.
    pub version: Option<u64>,
    /// Hash of the version.
    pub version_hash: Option<String>,
    /// Source of the poses and images.
    pub images: String,
    /// From the axes of these poses to those of the scene, as eight numbers.
    pub alignment: String,
    /// Every `every`-th image was compared, in the order of their names; 1 for all.
    pub every: usize,
    pub backend: &'static str,
    /// Profile of the rendering.
    pub profile: RenderProfile,
    /// The model that repaired the images, if one did.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repair: Option<RepairSubject>,
    /// Name of the network of [`Scores::lpips`], if one was given.
    ///
    /// [`Scores::lpips`]: super::Scores::lpips
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips_network: Option<String>,
    /// The boxes of moving objects, if any were given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub boxes: Option<BoxesSubject>,
    /// The points of a LiDAR, if any were given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lidar: Option<LidarSubject>,
}

/// The boxes of moving objects.
#[derive(Clone, Debug, Serialize)]
pub struct BoxesSubject {
    /// File of the boxes.
    pub file: String,
    pub tracks: usize,
}

/// The points of a LiDAR.
#[derive(Clone, Debug, Serialize)]
pub struct LidarSubject {
    /// File of the points.
    pub file: String,
    /// Points that were transformed into the world.
    pub points: usize,
    /// Points that were left out, because no two poses at most 0.2 s apart enclose their time.
    pub left_out: usize,
}

/// The model that repaired the images.
#[derive(Clone, Debug, Serialize)]
pub struct RepairSubject {
    pub model: String,
    pub version: String,
    /// Hash of everything that its output depends on, except the images.
    pub repair_hash: String,
    /// Source of its reference images: `recorded`, or `rendered` on the drive; `None` if it needs
    /// none.
    pub references: Option<&'static str>,
    /// Number of recorded images that the model did not get as references, because they are
    /// compared themselves.
    pub left_out: usize,
}

/// The scores of all images.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    format: &'static str,
    /// The scene and the images that were compared.
    pub subject: Subject,
    conventions: BTreeMap<&'static str, &'static str>,
    /// Means of all images.
    pub all: Means,
    /// Means of each camera.
    pub cameras: Vec<CameraMeans>,
    /// Distance of the features of all images from those of the real ones; `None` if there is no
    /// network for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kid: Option<KidScores>,
    /// Off-trajectory views, by their distance; empty if none was requested.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub extrapolation: Vec<Extrapolation>,
    /// The images, in the order in which they were listed.
    pub images: Vec<EvaluatedImage>,
}

impl Evaluation {
    /// Computes the means of the images.
    pub fn new(subject: Subject, images: Vec<EvaluatedImage>) -> Self {
        // Grouped in the order of names.
        let mut by_camera: BTreeMap<&str, Vec<&EvaluatedImage>> = BTreeMap::new();
        for image in &images {
            by_camera.entry(&image.camera).or_default().push(image);
        }
        let of_camera = |(camera, images): (&str, Vec<&EvaluatedImage>)| CameraMeans {
            camera: camera.to_owned(),
            means: Means::from_images(&images),
        };
        let cameras = by_camera.into_iter().map(of_camera).collect();
        // Not the mean of the cameras' means: each image counts once.
        let all = Means::from_images(&images.iter().collect::<Vec<_>>());
        // A map, so that eval.json has them in alphabetical order.
        let conventions = CONVENTIONS.into_iter().collect();
        Self {
            format: FORMAT,
            subject,
            conventions,
            all,
            cameras,
            kid: None,
            extrapolation: Vec::new(),
            images,
        }
    }

    /// The images by rising PSNR; images without a pixel that counts are the last.
    pub fn worst_first(&self) -> Vec<&EvaluatedImage> {
        // References: sorting the images would change the order of eval.json.
        let mut images: Vec<&EvaluatedImage> = self.images.iter().collect();
        images.sort_by(|a, b| a.compare(b));
        images
    }
}
