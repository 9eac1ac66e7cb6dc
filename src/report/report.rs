//! All measurements of one twin.

use serde::Serialize;

use super::confidence::Confidence;
use super::feature_costs::FeatureCounts;
use super::measurement::Measurement;
use super::recommend::{Goal, Recommendation, pareto_front, recommend};
use super::repair::RepairReport;
use super::sample_points::{OFFSETS_M, Sampling};
use super::settings::Skipped;
use wildcity_scene::RenderProfile;
use wildcity_stress::table::{Column, Table};

/// All measurements of one twin. JSON and CSV write numbers that are infinite or NaN as the words
/// `inf`, `-inf` and `NaN`: a setting that is exact has a PSNR of `inf`.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// The twin, and how it is rendered.
    pub subject: Subject,
    /// The backends; [`super::setting::Setting::backend`] is an index into them.
    pub backends: Vec<Column>,
    /// The number of sample points, and the size of the windows that are compared.
    pub sampling: Sampling,
    /// Names of the sample points.
    #[serde(rename = "places")]
    pub sample_points: Vec<String>,
    /// Time that a step of the reference would take, in milliseconds.
    pub reference_ms: f64,
    /// Measurements of all settings; the twin as it is served is the first.
    pub settings: Vec<Measurement>,
    /// Settings that were not compared, with the reasons.
    #[serde(rename = "left_out")]
    pub skipped: Vec<Skipped>,
    /// Time that a step of the reference would take with a ray for every pixel, in milliseconds.
    /// None if every camera is a pinhole at rest.
    pub exact_rays_ms: Option<f64>,
    /// Trust in the images over the distance from the recorded drive. Empty without a drive.
    #[serde(rename = "believed")]
    pub confidence: Vec<Confidence>,
    /// The goal that the user gave, if any.
    #[serde(rename = "wanted")]
    pub goal: Option<Goal>,
    /// The setting that reaches the goal.
    pub recommendation: Option<Recommendation>,
    /// Why no setting is recommended although there is a goal.
    #[serde(rename = "unmet")]
    pub unmet_reason: Option<String>,
    /// Results of extreme scenes on every backend.
    pub stress: Table,
    /// Memory and GPU work of one step, with each feature and without.
    #[serde(rename = "needed")]
    pub feature_costs: Vec<FeatureCounts>,
    /// The gain and the cost of repair, if models were given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repair: Option<RepairReport>,
}

/// The twin of a report, and how it is rendered.
#[derive(Clone, Debug, Serialize)]
pub struct Subject {
    /// Name of the twin.
    pub twin: String,
    /// Number of its version.
    pub version: u64,
    /// Hash of the version.
    pub version_hash: String,
    /// Gaussians at full detail.
    pub gaussians: u64,
    /// Degree of their spherical harmonics.
    pub sh_degree: u8,
    /// Record format in which they are stored.
    pub record: &'static str,
    /// The twin's render profile.
    pub profile: RenderProfile,
    /// Cameras of a step.
    pub cameras: usize,
    /// Number of timed runs of a step at each sample point.
    pub repeat: u32,
}

/// Least PSNR of the setting that is named if no goal is given, in dB: an error of 1 % of the
/// range.
const NO_GOAL_DB: f64 = 40.0;
/// How much of the time of the twin as it is served that setting takes at most: less of a gain may
/// be the luck of its timing.
const NO_GOAL_SHARE: f64 = 0.9;

impl Report {
    /// The answer to the question which setting to use, in one sentence.
    pub fn answer(&self) -> String {
        match (&self.recommendation, self.goal, &self.unmet_reason) {
            (Some(Recommendation { setting, backend, goal, .. }), ..) => {
                format!("use {setting} on {backend}: {goal} at every sample point")
            }
            (None, Some(goal), Some(reason)) => {
                format!("nothing is recommended for {goal}: {reason}")
            }
            (None, ..) => self.answer_without_goal(),
        }
    }

    /// The fastest setting with [`NO_GOAL_DB`], if it is faster than the twin as it is served.
    fn answer_without_goal(&self) -> String {
        let backends: Vec<String> =
            self.backends.iter().map(|column| column.backend.to_owned()).collect();
        let found = recommend(Goal::AtLeastDb(NO_GOAL_DB), &self.settings, &backends).ok();
        let step_ms = |name: &str| {
            let of_name = self.settings.iter().find(|measured| measured.setting.name == name);
            of_name.map_or(f64::NAN, |measured| measured.cost.step_ms)
        };
        let served_ms = self.settings.first().map_or(f64::NAN, |served| served.cost.step_ms);
        let faster = found.filter(|found| step_ms(&found.setting) < NO_GOAL_SHARE * served_ms);
        let results = self.settings.iter().take(1).flat_map(|served| &served.by_sample_point);
        let served_db = results.map(|result| result.min_db).fold(f64::INFINITY, f64::min);
        let other = "--at-least-db or --at-most-ms find one for a goal of yours";
        match faster {
            Some(Recommendation { setting, backend, .. }) => format!(
                "use {setting} on {backend}: {:.1} ms a step instead of {served_ms:.1}, and at \
                 least {NO_GOAL_DB} dB in every window; {other}",
                step_ms(&setting)
            ),
            None if served_db < NO_GOAL_DB => format!(
                "none was found: the twin as it is served has {served_db:.1} dB in the worst \
                 window, {served_ms:.1} ms a step; {other}"
            ),
            None => format!(
                "the twin as it is served, {served_ms:.1} ms a step: no verified setting is 10 % \
                 faster with at least {NO_GOAL_DB} dB in every window; {other}"
            ),
        }
    }

    /// The settings as CSV: a header, and one line per setting, with decimal points and no quotes
    /// except around names. A cell is empty where there is no value: dB at offsets from a drive if
    /// none was recorded, and bytes of a device if the backend has none.
    pub fn csv(&self) -> String {
        // The distances are a part of the columns' names: another list of them is another file.
        let by_offset = OFFSETS_M.map(|offset_m| format!("psnr_db_at_{offset_m}_m")).join(",");
        let mut csv = format!(
            "setting,family,backend,step_ms,p95_ms,psnr_db,least_db,{by_offset},ssim,max,p99_9,depth_l1_m,\
             gaussians,scene_bytes,device_bytes,stored_bytes_each,sent_bytes,on_front\n"
        );
        // Fields in the order of the header.
        for (measurement, is_on_front) in self.settings.iter().zip(pareto_front(&self.settings)) {
            csv.push_str(&self.csv_line(measurement, is_on_front));
        }
        csv
    }

    fn csv_line(&self, measurement: &Measurement, is_on_front: bool) -> String {
        let errors = &measurement.errors;
        let cost = &measurement.cost;
        let backend = self.backends[measurement.setting.backend].backend;
        let psnr_at = |offset: usize| {
            // A twin without a drive has one value only.
            measurement.psnr_db_by_offset.get(offset).map_or(String::new(), f64::to_string)
        };
        format!(
            "\"{}\",{},{backend},{:.3},{:.3},{},{},{},{},{},{},{},{},{},{},{},{},{is_on_front}\n",
            measurement.setting.name,
            measurement.setting.family.name(),
            cost.step_ms,
            measurement.p95_ms(),
            errors.psnr_db,
            measurement.min_db(),
            [0, 1, 2, 3].map(psnr_at).join(","),
            errors.ssim,
            errors.max,
            errors.p99_9,
            errors.depth_l1_m,
            cost.gaussians,
            cost.scene_bytes,
            cost.device_bytes.map_or(String::new(), |bytes| bytes.to_string()),
            cost.stored_bytes_per_gaussian,
            cost.sent_bytes
        )
    }
}
