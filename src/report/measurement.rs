//! The results of measuring one setting.

use serde::Serialize;

use super::error_images::ErrorImages;
use super::setting::{Family, Setting};
use super::statistics::{min, quantile};
use wildcity_render::compare::errors::ImageErrors;
use wildcity_render::compare::json_numbers::{serialize_number, serialize_numbers};

/// The error and the cost of one setting.
#[derive(Clone, Debug, Serialize)]
pub struct Measurement {
    #[serde(flatten)]
    pub setting: Setting,
    /// Errors over all windows at all sample points.
    pub errors: ImageErrors,
    /// PSNR at each distance of [`super::sample_points::OFFSETS_M`], in dB. Only one value for a
    /// twin without a drive.
    #[serde(serialize_with = "serialize_numbers")]
    pub psnr_db_by_offset: Vec<f64>,
    /// Results at each sample point.
    #[serde(rename = "by_place")]
    pub by_sample_point: Vec<SampleResult>,
    /// Cost at the sample points on the drive.
    pub cost: Cost,
    /// Median time of a step of the twin as it is served, timed in turn with this setting, in
    /// milliseconds.
    #[serde(rename = "served_ms")]
    pub baseline_ms: f64,
    /// The window with the largest error.
    #[serde(skip)]
    pub worst: ErrorImages,
}

/// Results of a setting at one sample point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SampleResult {
    /// Whether settings are selected by this point. The others verify the selection.
    #[serde(rename = "chooses")]
    pub for_selection: bool,
    /// PSNR over all windows of the point, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// PSNR of the window that has the least, in dB. A setting is selected by it.
    #[serde(rename = "least_db", serialize_with = "serialize_number")]
    pub min_db: f64,
    /// 95th percentile of the step time, in milliseconds: of fewer than twenty steps, the longest.
    /// None for a point off the drive, where no step is timed.
    pub p95_ms: Option<f64>,
}

/// The cost of a step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Cost {
    /// Median time of a step of all cameras, in milliseconds: rendering, and encoding if the
    /// setting has an encoding.
    pub step_ms: f64,
    /// Number of Gaussians that a step renders: the largest of all sample points.
    pub gaussians: u64,
    /// Host memory of these Gaussians and of a baked sky, in bytes.
    pub scene_bytes: u64,
    /// Memory of all buffers on a device that renders these steps and nothing else, in bytes. None
    /// for a backend without a device, if the driver does not report it, and if a second device
    /// does not fit into memory next to the backend's.
    pub device_bytes: Option<u64>,
    /// Bytes of a Gaussian on disk, before compression.
    #[serde(rename = "stored_bytes_each")]
    pub stored_bytes_per_gaussian: f64,
    /// Bytes of a step's images as they are sent.
    pub sent_bytes: u64,
}

impl Cost {
    pub(super) const ZERO: Self = Self {
        step_ms: 0.0,
        gaussians: 0,
        scene_bytes: 0,
        device_bytes: None,
        stored_bytes_per_gaussian: 0.0,
        sent_bytes: 0,
    };
}

impl Measurement {
    /// Least PSNR of a window at any sample point, in dB.
    pub fn min_db(&self) -> f64 {
        min(self.by_sample_point.iter().map(|result| result.min_db))
    }

    /// The longest 95th percentile of the step time at a sample point, in milliseconds.
    /// `--at-most-ms` limits it.
    pub fn p95_ms(&self) -> f64 {
        let all = self.by_sample_point.iter().filter_map(|result| result.p95_ms);
        // `f64::max` ignores a NaN on one side: the result is NaN only without any time.
        all.fold(f64::NAN, f64::max)
    }

    /// Whether the setting renders the same images of the same Gaussians as the twin as it is
    /// served, in the same memory. Its time then differs by chance only.
    pub fn is_equivalent_to(&self, served: &Self) -> bool {
        let psnrs_db = |m: &Self| -> Vec<[f64; 2]> {
            m.by_sample_point.iter().map(|result| [result.psnr_db, result.min_db]).collect()
        };
        let resources = |m: &Self| (m.setting.backend, m.cost.gaussians, m.cost.scene_bytes);
        // Exactly, to the last bit of all errors: equal images have them, others practically never.
        let same_images = self.errors == served.errors && psnrs_db(self) == psnrs_db(served);
        let same_resources = resources(self) == resources(served);
        self.setting.family != Family::AsServed && same_images && same_resources
    }
}

/// Scales the times of all settings to one speed of the machine: the speed at which the twin as it
/// is served took its median time. A setting that was measured while other programs ran is then not
/// slower than the rest. The first backend's baseline gives the speed of the machine, for settings
/// of other backends too.
pub fn normalize_machine_speed(all: &mut [Measurement]) {
    let baselines_ms: Vec<f64> = all.iter().map(|m| m.baseline_ms).collect();
    // The machine's usual speed; each setting was measured at its own.
    let usual_ms = quantile(&baselines_ms, 0.5);
    for m in all {
        // Times become longer where the machine was faster than usual, and shorter where it
        // was slower.
        let factor = usual_ms / m.baseline_ms;
        m.baseline_ms = usual_ms;
        m.cost.step_ms *= factor;
        for p95_ms in m.by_sample_point.iter_mut().flat_map(|result| &mut result.p95_ms) {
            *p95_ms *= factor;
        }
    }
}
