//! What a setting costs and what it loses, and whether anything breaks at the extremes.
//!
//! ```text
//! ladder     the settings that are compared
//! places     from where: along the recorded drive, beside it, or around a capture
//! measure    every setting at every place, against the f64 reference
//! timing     how long a step takes
//! choose     the Pareto front, and the setting for a wanted error or time
//! believed   trust over the distance from the recorded drive
//! needed     what a scene with and without each feature holds and runs
//! page       all of it as one HTML page, with plots and pictures
//! ```

pub mod confidence;
mod error_images;
pub mod feature_costs;
pub mod measure;
pub mod page;
mod plots;
pub mod recommend;
pub mod sample_points;
pub mod settings;
pub mod timing;

use serde::Serialize;

use wildcity_render::RenderError;
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::CameraError;
use wildcity_scene::profile::ProfileError;
use wildcity_twin::residency::ResidencyError;

pub use error_images::ErrorImages;

use confidence::Confidence;
use measure::Measurement;
use recommend::{Goal, Recommendation};
use sample_points::{OFFSETS_M, Sampling};
use settings::Skipped;
use wildcity_stress::table::{Column, Table};

/// Everything that was measured of a twin. Numbers that are infinite or NaN are words in JSON and CSV alike:
/// a setting that is exact has a PSNR of `inf`.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Of what.
    pub subject: Subject,
    /// On what.
    pub backends: Vec<Column>,
    /// How it was sampled.
    pub sampling: Sampling,
    /// Where.
    #[serde(rename = "places")]
    pub sample_points: Vec<String>,
    /// What a step of the reference would take, in milliseconds.
    pub reference_ms: f64,
    /// Every setting, the twin as it is served first.
    pub settings: Vec<Measurement>,
    /// What is not among them.
    #[serde(rename = "left_out")]
    pub skipped: Vec<Skipped>,
    /// What a step of the reference would take if every pixel's own ray were followed, in milliseconds;
    /// none of pinholes at rest.
    pub exact_rays_ms: Option<f64>,
    /// How far images may be believed beside the recorded drive; empty without one.
    #[serde(rename = "believed")]
    pub confidence: Vec<Confidence>,
    /// What was asked for, if anything was.
    #[serde(rename = "wanted")]
    pub goal: Option<Goal>,
    /// The setting for it.
    pub recommendation: Option<Recommendation>,
    /// Why there is none although one was wanted.
    #[serde(rename = "unmet")]
    pub unmet_reason: Option<String>,
    /// Extreme scenes on every backend.
    pub stress: Table,
    /// What scenes with and without each feature hold and run.
    #[serde(rename = "needed")]
    pub feature_costs: Vec<feature_costs::FeatureCounts>,
}

/// What a report is of.
#[derive(Clone, Debug, Serialize)]
pub struct Subject {
    /// The twin.
    pub twin: String,
    /// Its version.
    pub version: u64,
    /// The version's hash.
    pub version_hash: String,
    /// Gaussians at full detail.
    pub gaussians: u64,
    /// Their SH degree.
    pub sh_degree: u8,
    /// How they are stored.
    pub record: &'static str,
    /// How the twin is drawn.
    pub profile: RenderProfile,
    /// Cameras of a step.
    pub cameras: usize,
    /// How often a step was timed at each place.
    pub repeat: u32,
}

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The twin cannot be read.
    #[error(transparent)]
    Residency(#[from] ResidencyError),
    /// A frame cannot be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// An image so small cannot be drawn.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A setting does not fit the twin's profile.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// An image cannot be encoded, or read again.
    #[error("an image cannot be encoded: {reason}")]
    Encode {
        /// The encoder's words.
        reason: String,
    },
    /// A plot cannot be drawn.
    #[error("a plot cannot be drawn: {reason}")]
    Plot {
        /// The plotter's words.
        reason: String,
    },
    /// Nothing to look at.
    #[error("there is no place to look from: give at least one station")]
    NoSamplePoints,
    /// No setting is good enough.
    #[error(
        "no setting of the ladder gives {wanted}, with a margin; the best reaches {reached:.1}"
    )]
    GoalNotReached {
        /// What was wanted.
        wanted: String,
        /// What is possible.
        reached: f64,
    },
    /// The chosen setting fails elsewhere.
    #[error(
        "{setting} was chosen for {wanted}, but at places that were not used to choose it gives \
         {verified:.1}: measure more --stations"
    )]
    NotVerified {
        /// The setting.
        setting: String,
        /// What was wanted.
        wanted: String,
        /// What was measured.
        verified: f64,
    },
}

impl Report {
    /// One line per setting, with a header; decimal points, no quotes but around names. Empty is what there
    /// is not: dB beside a drive where none was recorded, bytes of a device without one.
    pub fn csv(&self) -> String {
        let by_offset = OFFSETS_M.map(|offset_m| format!("psnr_db_at_{offset_m}_m")).join(",");
        let mut csv = format!(
            "setting,family,backend,step_ms,p95_ms,psnr_db,least_db,{by_offset},ssim,max,p99_9,depth_l1_m,\
             gaussians,scene_bytes,device_bytes,stored_bytes_each,sent_bytes,on_front\n"
        );
        for (m, is_on) in self.settings.iter().zip(recommend::pareto_front(&self.settings)) {
            let (e, cost) = (&m.errors, &m.cost);
            let backend = self.backends[m.setting.backend].backend;
            let at = |offset| m.psnr_db_by_offset.get(offset).map_or(String::new(), f64::to_string);
            csv.push_str(&format!(
                "\"{}\",{},{backend},{:.3},{:.3},{},{},{},{},{},{},{},{},{},{},{},{},{is_on}\n",
                m.setting.name,
                m.setting.family.name(),
                cost.step_ms,
                m.p95_ms(),
                e.psnr_db,
                m.least_db(),
                [0, 1, 2, 3].map(at).join(","),
                e.ssim,
                e.max,
                e.p99_9,
                e.depth_l1_m,
                cost.gaussians,
                cost.scene_bytes,
                cost.device_bytes.map_or(String::new(), |bytes| bytes.to_string()),
                cost.stored_bytes_each,
                cost.sent_bytes
            ));
        }
        csv
    }
}
