//! A row of the repair section: the means of one kind of image at one distance from the drive.

use serde::Serialize;

use wildcity_render::compare::json_numbers::serialize_number;

use crate::statistics::quantile;

/// The kinds of images of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ImageKind {
    /// The twin as it is rendered.
    Rendered,
    /// The warped recorded images where they cover the view, else the rendered image; no model.
    Warped,
    /// The rendered image, repaired by a model.
    Model,
}

/// Times of one image, in milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct RepairMs {
    /// To choose recorded images and warp them into the view.
    pub warp: f64,
    /// The model: its inputs, and its graph.
    pub model: f64,
    /// To convert its output to an image of 8 bits.
    pub merge: f64,
}

impl RepairMs {
    /// The sum of all parts, in milliseconds.
    pub fn total(&self) -> f64 {
        self.warp + self.model + self.merge
    }
}

/// One image of one kind.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Index of the distance from the drive.
    pub offset: usize,
    /// Index of the kind: 0 rendered, 1 warped, then the models.
    pub kind: usize,
    /// Whether it is used to select thresholds; the other samples verify them.
    pub for_selection: bool,
    /// Trust in the rendered image.
    pub trust: f64,
    /// Share of the pixels that recorded images cover.
    pub covered: f64,
    /// Time to render it: that of the step over the number of cameras.
    pub render_ms: f64,
    /// Time to repair it.
    pub repair_ms: RepairMs,
    /// PSNR against ground truth, in dB; 110 at most.
    pub psnr_db: Option<f64>,
    /// PSNR minus that of the rendered image, in dB.
    pub gain_db: Option<f64>,
    pub flip: Option<f64>,
    /// [`wildcity_render::compare::flicker::flicker`]; `None` if the previous image shows nothing
    /// of this one.
    pub flicker: Option<f64>,
    /// Flicker of the ground truth.
    pub true_flicker: Option<f64>,
}

/// The PSNR of equal images, so that differences of PSNR stay numbers: 8 bits of 360 x 232 pixels
/// that differ by one step in one value have 102 dB.
pub(super) const EXACT_DB: f64 = 110.0;

/// A model of the section.
#[derive(Clone, Debug, Serialize)]
pub struct RepairedModel {
    /// The name in its manifest.
    pub name: String,
    /// The version in its manifest.
    pub version: String,
    /// The licence in its manifest.
    pub licence: String,
    /// BLAKE3 of everything that its output depends on, except the images.
    pub repair_hash: String,
    pub provider: &'static str,
    /// Whether equal inputs give equal bytes.
    pub deterministic: bool,
}

/// Means over all images of a kind at one distance; times are medians.
#[derive(Clone, Debug, Serialize)]
pub struct RepairRow {
    /// Lateral distance from the drive, in metres.
    pub offset_m: f64,
    /// The kind of the images.
    pub kind: ImageKind,
    /// `rendered`, `warped`, or the model's name.
    pub name: String,
    pub images: usize,
    /// Mean trust in the rendered images.
    pub trust: f64,
    /// Share of pixels that recorded images cover.
    pub covered: f64,
    /// Time to render an image.
    pub render_ms: f64,
    /// Parts of the time to repair an image.
    pub repair_parts_ms: RepairMs,
    /// Time to repair an image.
    pub repair_ms: f64,
    /// PSNR against ground truth, in dB; `None` without it.
    pub psnr_db: Option<f64>,
    /// PSNR minus that of the rendered images, in dB: negative for a loss.
    pub gain_db: Option<f64>,
    /// Number of images that are worse than rendered.
    pub worse: Option<usize>,
    /// FLIP, from 0 to 1.
    pub flip: Option<f64>,
    /// Mean absolute difference between an image and the previous one, warped into its view.
    #[serde(serialize_with = "serialize_number")]
    pub flicker: f64,
    /// Flicker divided by that of the rendered images. Below 1.1 the images are stable.
    #[serde(serialize_with = "serialize_number")]
    pub flicker_ratio: f64,
    /// Flicker of the ground truth.
    pub true_flicker: Option<f64>,
    /// Gain per 100 ms of repair, in dB; `None` for rendered images.
    pub db_per_100_ms: Option<f64>,
}

impl RepairRow {
    /// The row of the samples of a kind at one distance.
    pub(super) fn new(
        offset_m: f64,
        kind: ImageKind,
        name: String,
        own: &[&Sample],
        rendered: &[&Sample],
    ) -> Self {
        let median = |of: &dyn Fn(&Sample) -> f64| {
            quantile(&own.iter().map(|sample| of(sample)).collect::<Vec<f64>>(), 0.5)
        };
        let repair_ms = median(&|sample| sample.repair_ms.total());
        // NaN without any pair of frames: `serialize_number` writes it as a word.
        let flicker = mean(own, &|sample| sample.flicker).unwrap_or(f64::NAN);
        let rendered_flicker = mean(rendered, &|sample| sample.flicker).unwrap_or(f64::NAN);
        let gain_db = mean(own, &|sample| sample.gain_db);
        // An image with an equal PSNR is no loss.
        let loses = |sample: &&&Sample| sample.gain_db.is_some_and(|gain_db| gain_db < 0.0);
        // `None` without a truth: "0 worse" would claim a comparison.
        let worse = gain_db.map(|_| own.iter().filter(loses).count());
        Self {
            offset_m,
            kind,
            name,
            images: own.len(),
            trust: mean(own, &|sample| Some(sample.trust)).unwrap_or(f64::NAN),
            covered: mean(own, &|sample| Some(sample.covered)).unwrap_or(f64::NAN),
            render_ms: median(&|sample| sample.render_ms),
            repair_parts_ms: RepairMs {
                warp: median(&|sample| sample.repair_ms.warp),
                model: median(&|sample| sample.repair_ms.model),
                merge: median(&|sample| sample.repair_ms.merge),
            },
            repair_ms,
            psnr_db: mean(own, &|sample| sample.psnr_db),
            gain_db,
            worse,
            flip: mean(own, &|sample| sample.flip),
            flicker,
            flicker_ratio: flicker / rendered_flicker,
            true_flicker: mean(own, &|sample| sample.true_flicker),
            db_per_100_ms: gain_db
                // A rendered image costs nothing: there is nothing to divide by.
                .filter(|_| kind != ImageKind::Rendered && repair_ms > 0.0)
                .map(|gain_db| 100.0 * gain_db / repair_ms),
        }
    }
}

/// The mean of the values that are present; `None` without any.
fn mean(samples: &[&Sample], of: &dyn Fn(&Sample) -> Option<f64>) -> Option<f64> {
    let values: Vec<f64> = samples.iter().filter_map(|sample| of(sample)).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(gain_db: f64, model_ms: f64, flicker: f64) -> Sample {
        Sample {
            offset: 1,
            kind: 2,
            for_selection: true,
            trust: 0.5,
            covered: 0.75,
            render_ms: 10.0,
            repair_ms: RepairMs { warp: 5.0, model: model_ms, merge: 1.0 },
            psnr_db: Some(20.0 + gain_db),
            gain_db: Some(gain_db),
            flip: Some(0.1),
            flicker: Some(flicker),
            true_flicker: None,
        }
    }

    #[test]
    fn a_row_has_means_medians_and_the_gain_for_its_time() {
        let rendered = sample(0.0, 0.0, 0.02);
        // Totals of 50, 40 and 506 ms: the median is 50. The gains' mean is (2 - 0.5 + 3)/3
        // = 1.5 dB.
        let own = [sample(2.0, 44.0, 0.03), sample(-0.5, 34.0, 0.01), sample(3.0, 500.0, 0.02)];
        let own: Vec<&Sample> = own.iter().collect();
        let name = "net".to_owned();
        let row = RepairRow::new(1.0, ImageKind::Model, name, &own, &[&rendered]);
        assert_eq!((row.images, row.worse), (3, Some(1)), "a loss is counted");
        assert!((row.gain_db.unwrap() - 1.5).abs() < 1e-12);
        assert_eq!((row.repair_ms, row.repair_parts_ms.model), (50.0, 44.0));
        // 1.5 dB in 50 ms.
        assert!((row.db_per_100_ms.unwrap() - 3.0).abs() < 1e-12);
        assert!((row.flicker_ratio - 1.0).abs() < 1e-12);
        assert_eq!(row.true_flicker, None);
    }

    #[test]
    fn without_a_true_image_there_is_no_gain_and_no_loss() {
        let blind = Sample { psnr_db: None, gain_db: None, flip: None, ..sample(0.0, 1.0, 0.1) };
        let row = RepairRow::new(1.0, ImageKind::Warped, "warped".into(), &[&blind], &[&blind]);
        assert_eq!((row.psnr_db, row.gain_db, row.worse), (None, None, None));
        assert_eq!((row.flip, row.db_per_100_ms), (None, None));
    }
}
