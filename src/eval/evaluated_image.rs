//! The scores of one image.

use std::cmp::Ordering;

use serde::Serialize;

use super::lidar::LidarDepth;
use super::scores::{PairScores, Scored};
use super::thumbnails::Thumbnails;

/// The scores of one image.
#[derive(Clone, Debug, Serialize)]
pub struct EvaluatedImage {
    /// Its name in the list of images.
    pub name: String,
    /// The folder of its name, which stands for a camera; empty without one.
    pub camera: String,
    /// Width and height, in pixels.
    pub size_px: [u32; 2],
    /// Share of the pixels with an opacity of at least 1/2: near 0 if the camera looks past the
    /// scene.
    pub covered: f64,
    /// The scores of the image as it was rendered.
    #[serde(flatten)]
    pub rendered: Scored,
    /// The scores of the repaired image; `None` without a repair.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repaired: Option<Scored>,
    /// Share of the pixels that moving boxes hide, from 0 to 1; `None` if there are no boxes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub moving: Option<f64>,
    /// Depth against LiDAR; `None` if it was not requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lidar: Option<LidarDepth>,
    /// Pictures for the page; empty if it was not among the worst.
    #[serde(skip)]
    pub thumbnails: Option<Thumbnails>,
}

impl EvaluatedImage {
    /// The scores of one image. `covered` is the share of its pixels with an opacity of at least
    /// 1/2.
    pub fn new(name: String, size_px: [u32; 2], covered: f64, compared: &PairScores) -> Self {
        // The whole path before the last slash: cameras of different drives stay apart.
        let camera = name.rsplit_once('/').map_or(String::new(), |(folder, _)| folder.to_owned());
        let rendered = compared.scored();
        Self {
            name,
            camera,
            size_px,
            covered,
            rendered,
            repaired: None,
            moving: None,
            lidar: None,
            thumbnails: None,
        }
    }

    /// Orders images by rising PSNR; images without a pixel that counts are the last.
    pub fn compare(&self, other: &Self) -> Ordering {
        // The sign of a NaN is not defined, and total_cmp would sort by it.
        // NaN as a flag of its own, with a number in its place, so that the order is total.
        let key = |image: &Self| match image.rendered.scores.psnr_db {
            db if db.is_nan() => (true, 0.0),
            db => (false, db),
        };
        let (is_last, db) = key(self);
        let (other_is_last, other_db) = key(other);
        is_last.cmp(&other_is_last).then(db.total_cmp(&other_db))
    }
}
