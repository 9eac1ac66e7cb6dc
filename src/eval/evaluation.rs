//! The scores of all held-out images, and their means.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use serde::Serialize;

use super::scores::{PairScores, Scores, pooled_psnr_db};
use super::thumbnails::Thumbnails;
use wildcity_render::compare::json_numbers::serialize_number;
use wildcity_scene::RenderProfile;

/// Format of eval.json.
const FORMAT: &str = "wildcity.eval/1";

/// What each number means, by its name in eval.json.
const CONVENTIONS: [(&str, &str); 7] = [
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
];

/// What was compared.
#[derive(Clone, Debug, Serialize)]
pub struct Subject {
    /// Name of the twin, or the scene file.
    pub scene: String,
    /// Number of the twin's version; none of a file.
    pub version: Option<u64>,
    /// Hash of the version.
    pub version_hash: Option<String>,
    /// Where poses and images were read.
    pub images: String,
    /// From the axes of these poses to those of the scene, as eight numbers.
    pub alignment: String,
    /// Every how many-th image was compared, in the order of their names; 1 for all.
    pub every: usize,
    /// Backend that rendered.
    pub backend: &'static str,
    /// How it rendered.
    pub profile: RenderProfile,
}

/// The scores of one image.
#[derive(Clone, Debug, Serialize)]
pub struct EvaluatedImage {
    /// Its name in the list of images.
    pub name: String,
    /// The folder of its name, which stands for a camera; empty without one.
    pub camera: String,
    /// Width and height, in pixels.
    pub size_px: [u32; 2],
    /// Share of the pixels with an opacity of at least 1/2: near 0 if the camera looks past the scene.
    pub covered: f64,
    /// The scores.
    #[serde(flatten)]
    pub scores: Scores,
    #[serde(skip)]
    squared_error: f64,
    #[serde(skip)]
    values: u64,
    /// Pictures for the page; empty if it was not among the worst.
    #[serde(skip)]
    pub thumbnails: Option<Thumbnails>,
}

/// Means of the values of some images. Images of which no pixel counts are left out. NaN if there is no other.
#[derive(Clone, Debug, Serialize)]
pub struct Means {
    /// Number of images.
    pub images: usize,
    /// Mean PSNR, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// PSNR of the pixels of all images together, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub pooled_psnr_db: f64,
    /// Mean of [`Scores::ssim`].
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
    /// Mean of [`Scores::ssim_mirrored`].
    #[serde(serialize_with = "serialize_number")]
    pub ssim_mirrored: f64,
    /// Mean FLIP.
    #[serde(serialize_with = "serialize_number")]
    pub flip: f64,
    /// Means after the best change of exposure; `None` if it was not asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub aligned: Option<AlignedMeans>,
}

/// Means after the best change of exposure of each image.
#[derive(Clone, Debug, Serialize)]
pub struct AlignedMeans {
    /// Mean PSNR, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// Mean of [`Scores::ssim`].
    #[serde(serialize_with = "serialize_number")]
    pub ssim: f64,
}

/// Means of the images of one camera.
#[derive(Clone, Debug, Serialize)]
pub struct CameraMeans {
    /// Folder of the images' names.
    pub camera: String,
    /// The means.
    #[serde(flatten)]
    pub means: Means,
}

/// The scores of all images.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    format: &'static str,
    /// What was compared.
    pub subject: Subject,
    conventions: BTreeMap<&'static str, &'static str>,
    /// Means of all images.
    pub all: Means,
    /// Means of each camera.
    pub cameras: Vec<CameraMeans>,
    /// The images, in the order in which they were listed.
    pub images: Vec<EvaluatedImage>,
}

impl EvaluatedImage {
    /// The scores of one image. `covered` is the share of its pixels with an opacity of at least 1/2.
    pub fn new(name: String, size_px: [u32; 2], covered: f64, compared: &PairScores) -> Self {
        let camera = name.rsplit_once('/').map_or(String::new(), |(folder, _)| folder.to_owned());
        let &PairScores { scores, squared_error, values, .. } = compared;
        Self { name, camera, size_px, covered, scores, squared_error, values, thumbnails: None }
    }

    /// The order from the lowest PSNR on, with images of which no pixel counts at the end.
    pub fn compare(&self, other: &Self) -> Ordering {
        // The sign of a NaN is not defined, and total_cmp would sort by it.
        let key = |image: &Self| match image.scores.psnr_db {
            db if db.is_nan() => (true, 0.0),
            db => (false, db),
        };
        let (is_last, db) = key(self);
        let (other_is_last, other_db) = key(other);
        is_last.cmp(&other_is_last).then(db.total_cmp(&other_db))
    }
}

impl Means {
    fn of(images: &[&EvaluatedImage]) -> Self {
        let counted: Vec<&EvaluatedImage> =
            images.iter().copied().filter(|image| image.values > 0).collect();
        let mean = |value: &dyn Fn(&Scores) -> f64| {
            let values = counted.iter().map(|image| value(&image.scores));
            // A mask may leave pixels, but no window.
            let values: Vec<f64> = values.filter(|value| !value.is_nan()).collect();
            values.iter().sum::<f64>() / values.len() as f64
        };
        let is_aligned = counted.iter().any(|image| image.scores.aligned.is_some());
        let aligned = |value: &dyn Fn(&super::AlignedScores) -> f64| {
            mean(&|scores| scores.aligned.as_ref().map_or(f64::NAN, value))
        };
        Self {
            images: counted.len(),
            psnr_db: mean(&|scores| scores.psnr_db),
            pooled_psnr_db: pooled_psnr_db(
                counted.iter().map(|image| image.squared_error).sum(),
                counted.iter().map(|image| image.values).sum(),
            ),
            ssim: mean(&|scores| scores.ssim),
            ssim_mirrored: mean(&|scores| scores.ssim_mirrored),
            flip: mean(&|scores| scores.flip),
            aligned: is_aligned.then(|| AlignedMeans {
                psnr_db: aligned(&|scores| scores.psnr_db),
                ssim: aligned(&|scores| scores.ssim),
            }),
        }
    }
}

impl Evaluation {
    /// Computes the means of the images.
    pub fn new(subject: Subject, images: Vec<EvaluatedImage>) -> Self {
        let mut by_camera: BTreeMap<&str, Vec<&EvaluatedImage>> = BTreeMap::new();
        for image in &images {
            by_camera.entry(&image.camera).or_default().push(image);
        }
        let of_camera = |(camera, images): (&str, Vec<&EvaluatedImage>)| CameraMeans {
            camera: camera.to_owned(),
            means: Means::of(&images),
        };
        let cameras = by_camera.into_iter().map(of_camera).collect();
        let all = Means::of(&images.iter().collect::<Vec<_>>());
        let conventions = CONVENTIONS.into_iter().collect();
        Self { format: FORMAT, subject, conventions, all, cameras, images }
    }

    /// The images from the lowest PSNR on; those of which no pixel counts are the last.
    pub fn worst_first(&self) -> Vec<&EvaluatedImage> {
        let mut images: Vec<&EvaluatedImage> = self.images.iter().collect();
        images.sort_by(|a, b| a.compare(b));
        images
    }

    /// The images as CSV: a header, and one line per image. Numbers that are infinite or NaN are the words `inf` and
    /// `NaN`. Cells of scores that were not asked for are empty.
    pub fn csv(&self) -> String {
        let header = "name,camera,width,height,counted,covered,psnr_db,ssim,ssim_mirrored,flip,aligned_psnr_db,\
                      aligned_ssim\n";
        let lines = self.images.iter().map(csv_line);
        std::iter::once(header.to_owned()).chain(lines).collect()
    }
}

fn csv_line(image: &EvaluatedImage) -> String {
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    let [width, height] = image.size_px;
    let scores = &image.scores;
    let aligned = scores.aligned.map_or(",".to_owned(), |a| format!("{},{}", a.psnr_db, a.ssim));
    format!(
        "{},{},{width},{height},{},{},{},{},{},{},{aligned}\n",
        quoted(&image.name),
        quoted(&image.camera),
        scores.counted,
        image.covered,
        scores.psnr_db,
        scores.ssim,
        scores.ssim_mirrored,
        scores.flip,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Pair;

    /// An image of one colour that is off by some steps of 255; no pixel counts if `is_hidden`.
    fn image(name: &str, off: u8, is_hidden: bool) -> EvaluatedImage {
        let counts = is_hidden.then(|| vec![false; 144]);
        let pair = Pair::new([12, 12], vec![100; 432], vec![100 + off; 432], counts).unwrap();
        EvaluatedImage::new(name.to_owned(), [12, 12], 1.0, &PairScores::of(&pair, false))
    }

    fn evaluation(images: Vec<EvaluatedImage>) -> Evaluation {
        let subject = Subject {
            scene: "street".into(),
            version: Some(1),
            version_hash: None,
            images: "transforms.json".into(),
            alignment: "identity".into(),
            every: 1,
            backend: "cpu",
            profile: RenderProfile::DEFAULT,
        };
        Evaluation::new(subject, images)
    }

    #[test]
    fn means_are_of_the_images_values() {
        let made = evaluation(vec![
            image("front/1.png", 1, false),
            image("front/2.png", 10, false),
            image("left/1.png", 100, false),
            image("left/2.png", 50, true),
        ]);
        let db = |off: f64| 20.0 * (255.0 / off).log10();
        assert_eq!((made.all.images, made.cameras.len()), (3, 2));
        assert!((made.all.psnr_db - (db(1.0) + db(10.0) + db(100.0)) / 3.0).abs() < 1e-9);
        let pooled = -10.0 * ((1.0 + 100.0 + 10_000.0) / 3.0 / 255.0_f64.powi(2)).log10();
        assert!((made.all.pooled_psnr_db - pooled).abs() < 1e-9);
        assert!((made.cameras[0].means.psnr_db - (db(1.0) + db(10.0)) / 2.0).abs() < 1e-9);
        let order: Vec<&str> = made.worst_first().iter().map(|image| &*image.name).collect();
        assert_eq!(order, ["left/1.png", "front/2.png", "front/1.png", "left/2.png"]);
    }

    #[test]
    fn json_and_csv_have_words_for_infinity_and_nan() {
        let made = evaluation(vec![image("a.png", 0, false), image("say \"b\".png", 9, true)]);
        let csv = made.csv();
        let lines: Vec<&str> = csv.lines().collect();
        let columns = lines[0].split(',').count();
        assert_eq!(lines[1], "\"a.png\",\"\",12,12,1,1,inf,1,1,0,,");
        assert_eq!(lines[1].split(',').count(), columns);
        assert!(lines[2].starts_with("\"say \"\"b\"\".png\",\"\",12,12,0,1,NaN,NaN,"), "{csv}");
        assert_eq!((made.all.images, made.all.psnr_db), (1, f64::INFINITY));
    }
}
