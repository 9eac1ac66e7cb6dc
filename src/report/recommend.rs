//! The Pareto front of error and time, and the setting for a required error or time.
//!
//! **A setting is selected at every other station and verified at the rest.** Its worst selection
//! point must be better than the goal by a margin: the standard deviation of the worse half of the
//! points, at least 1 dB or a tenth of the time. Of eight values of a normal distribution the worst
//! lies 1.4 deviations from the mean on average; so the goal lies 2.4 deviations away, where one
//! point of 120 falls. With a margin of only 1 dB, a setting was selected that had 36 dB at two
//! points of a capture and 34.4 dB at two others.
//!
//! A setting that misses the goal at the verification points is not recommended, and no profile is
//! written: a setting that is good by chance is worse than none. Records and image sizes are
//! measured but not recommended, since a server cannot change them.

use serde::Serialize;

use super::error::ReportError;
use super::measurement::{Measurement, SampleResult};
use super::setting::{Family, ImageEncoding};
use super::statistics::min;
use wildcity_render::compare::json_numbers::serialize_number;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::{ProfileOverrides, RenderProfile};

/// The goal that the user gave.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Goal {
    /// At least this PSNR in every camera's window at every sample point, in dB, in the least time.
    AtLeastDb(f64),
    /// At most this 95th percentile of the step time, in milliseconds, with the least error.
    AtMostMs(f64),
}

/// A recommended setting: selected at some sample points, and verified at the others.
///
/// All values except [`Recommendation::encodings`] are of images as they are rendered, before they
/// are encoded: a profile does not choose the encoding.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Recommendation {
    #[serde(rename = "wanted")]
    pub goal: Goal,
    /// Name of the setting.
    pub setting: String,
    /// Its changes of the profile, as `field=value`.
    pub profile: Vec<String>,
    /// Name of the backend.
    pub backend: String,
    /// The worst value at the selection points, in the goal's unit.
    #[serde(rename = "chosen_by")]
    pub selection_worst: f64,
    /// The margin by which that value had to be better than the goal, in the same unit: the spread
    /// of the points.
    pub margin: f64,
    /// The worst value at the verification points, in the same unit.
    #[serde(rename = "verified")]
    pub verification_worst: f64,
    /// The state of the images in which all of this was measured: [`RENDERED`].
    #[serde(rename = "measured")]
    pub measured_state: &'static str,
    /// The additional error and time of encodings.
    #[serde(rename = "encoded")]
    pub encodings: Vec<EncodingCost>,
}

/// The additional error and time of the twin as it is served when its images are encoded.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EncodingCost {
    /// Name of the setting, for example `jpeg 90`.
    #[serde(rename = "sent")]
    pub encoding: String,
    /// Whether sessions use it unless they ask for another encoding.
    #[serde(rename = "by_default")]
    pub is_default: bool,
    /// Least PSNR of a window at any sample point after decoding, in dB.
    #[serde(rename = "least_db", serialize_with = "serialize_number")]
    pub min_db: f64,
    /// Median time of a step minus that without encoding, in milliseconds. The two are timed in
    /// turn; the difference can be below 0 by chance.
    #[serde(rename = "more_ms")]
    pub extra_ms: f64,
}

/// The state of the images that the values of a recommendation belong to.
pub const RENDERED: &str = "what is rendered, before images are encoded";

/// Least margin of an error, in dB.
const MIN_MARGIN_DB: f64 = 1.0;
/// Least margin of a time, as a share of it.
const MIN_MARGIN_MS_SHARE: f64 = 0.1;
/// Exact images have an infinite PSNR, and a mean needs a number: the steps of an f32 below 1 leave
/// 20 log10(2^24) = 144.5 dB.
const MAX_DB: f64 = 144.5;

/// Which settings are on the Pareto front: no other setting is better in time or error without
/// being worse in the other. Settings of [`Family::Rays`] have another reference; they are neither
/// on the front nor compared with it.
pub fn pareto_front(all: &[Measurement]) -> Vec<bool> {
    let is_comparable = |m: &&Measurement| m.setting.family != Family::Rays;
    let is_dominated = |m: &Measurement| {
        let own_ms = m.cost.step_ms;
        let own_db = m.errors.psnr_db;
        let dominates = |other: &Measurement| {
            let ms = other.cost.step_ms;
            let db = other.errors.psnr_db;
            // Equal in both is no domination, so that twins of a setting are both on the front.
            (ms < own_ms && db >= own_db) || (ms <= own_ms && db > own_db)
        };
        all.iter().filter(is_comparable).any(dominates)
    };
    let is_on_front =
        |m: &Measurement| is_comparable(&m) && !m.errors.psnr_db.is_nan() && !is_dominated(m);
    all.iter().map(is_on_front).collect()
}

/// A setting that may be recommended, with its assessment.
#[derive(Clone, Copy)]
struct Candidate<'a> {
    measurement: &'a Measurement,
    assessment: Assessment,
}

/// The best setting for the goal, of those that a server can use and that change something. Of
/// equally good ones it is the first of the list, which begins with the twin as it is served.
///
/// # Errors
/// No setting reaches the goal at the selection points, or the best one misses it at the
/// verification points.
pub fn recommend(
    goal: Goal,
    all: &[Measurement],
    backends: &[String],
) -> Result<Recommendation, ReportError> {
    // 1. The settings that may be recommended.
    let served = all.iter().find(|m| m.setting.family == Family::AsServed);
    // A setting that changes nothing would be recommended for its luck in timing.
    let has_effect = |m: &&Measurement| !served.is_some_and(|served| m.is_equivalent_to(served));
    let servable = all.iter().filter(|m| m.setting.can_be_served()).filter(has_effect);
    let candidates: Vec<Candidate<'_>> = servable
        .map(|measurement| Candidate { measurement, assessment: goal.assess(measurement) })
        .collect();

    // 2. The best of those that reach the goal with their margin.
    let Some(best) = best_candidate(goal, &candidates) else {
        // For the message: how far the best of all is from the goal.
        let guaranteed = candidates.iter().map(|candidate| candidate.assessment.guaranteed);
        let reached = match goal {
            Goal::AtLeastDb(_) => guaranteed.fold(f64::NEG_INFINITY, f64::max),
            Goal::AtMostMs(_) => guaranteed.fold(f64::INFINITY, f64::min),
        };
        return Err(ReportError::GoalNotReached { goal: goal.to_string(), reached });
    };

    // 3. Verification at the other points.
    let setting = &best.measurement.setting;
    let Assessment { selection_worst, margin, verification_worst, .. } = best.assessment;
    if !goal.is_met_by(verification_worst) {
        return Err(ReportError::NotVerified {
            setting: setting.name.clone(),
            goal: goal.to_string(),
            verified: verification_worst,
        });
    }

    let is_encoding = |m: &&Measurement| m.setting.family == Family::Encoding;
    Ok(Recommendation {
        goal,
        setting: setting.name.clone(),
        profile: setting.profile.clone(),
        backend: backends[setting.backend].clone(),
        selection_worst,
        margin,
        verification_worst,
        measured_state: RENDERED,
        encodings: all.iter().filter(is_encoding).map(EncodingCost::new).collect(),
    })
}

/// The fastest candidate that reaches a required error, or the most exact one that reaches a
/// required time.
fn best_candidate<'a>(goal: Goal, candidates: &[Candidate<'a>]) -> Option<Candidate<'a>> {
    // With the margin: the goal has to be reached at points that were not measured.
    let mut reaching =
        candidates.iter().copied().filter(|c| goal.is_met_by(c.assessment.guaranteed));
    match goal {
        Goal::AtLeastDb(_) => reaching
            // `min_by` returns the first of equal ones: the order of the list decides.
            .min_by(|a, b| a.measurement.cost.step_ms.total_cmp(&b.measurement.cost.step_ms)),
        Goal::AtMostMs(_) => {
            let worst_db =
                |c: &Candidate<'_>| Goal::AtLeastDb(0.0).assess(c.measurement).selection_worst;
            // A NaN compares with nothing: the first candidate must not have one.
            let mut best = reaching.find(|c| !worst_db(c).is_nan())?;
            for candidate in reaching {
                if worst_db(&candidate) > worst_db(&best) {
                    best = candidate;
                }
            }
            Some(best)
        }
    }
}

impl EncodingCost {
    fn new(measurement: &Measurement) -> Self {
        // The quality that sessions have if they ask for none.
        let default = ImageEncoding::Jpeg(wildcity_session::limits::JPEG_QUALITY);
        Self {
            encoding: measurement.setting.name.clone(),
            is_default: measurement.setting.encoding == Some(default),
            min_db: measurement.min_db(),
            // Both were scaled to the same speed of the machine.
            extra_ms: measurement.cost.step_ms - measurement.baseline_ms,
        }
    }
}

impl Recommendation {
    /// The fields of the profile that the setting changes, as a profile file has them.
    ///
    /// # Errors
    /// Names the change that cannot be made.
    pub fn changes(&self) -> Result<ProfileOverrides, ProfileError> {
        let bad =
            |field: &str, reason: String| ProfileError::Change { field: field.to_owned(), reason };
        // A profile with the changes, as JSON; then only the fields that were changed.
        let mut profile = RenderProfile::default();
        // The text of a change is parsed in one place only, by the profile.
        self.profile.iter().try_for_each(|change| profile.set(change))?;
        let all_fields =
            serde_json::to_value(profile).map_err(|error| bad("profile", error.to_string()))?;
        let changed_field = |change: &String| {
            // A change has the form field=value; without `=` it would have failed above.
            let key = change.split_once('=').map_or(change.as_str(), |(key, _)| key);
            let value = all_fields
                .get(key)
                .ok_or_else(|| bad(key, "it is missing in the JSON".to_owned()))?;
            Ok((key.to_owned(), value.clone()))
        };
        self.profile.iter().map(changed_field).collect::<Result<_, _>>().map(ProfileOverrides::new)
    }

    /// The command that starts a server with this setting, where `profile` is the path of the
    /// profile file.
    pub fn serve_command(&self, profile: &str) -> String {
        format!("wildcity serve --backend {} --profile {profile}", self.backend)
    }

    /// Describes the images that the values belong to, and what encodings add to them.
    pub fn explanation(&self) -> String {
        let of_encoding = |cost: &EncodingCost| {
            let EncodingCost { encoding, is_default, min_db, extra_ms } = cost;
            let default = if *is_default { " (the default)" } else { "" };
            format!("{encoding}{default} {min_db:.1} dB at worst and {extra_ms:+.1} ms a step")
        };
        let all: Vec<String> = self.encodings.iter().map(of_encoding).collect();
        let encodings = if all.is_empty() {
            String::new()
        } else {
            format!("; encoded, the twin as served has: {}", all.join(", "))
        };
        format!("of {}{encodings}", self.measured_state)
    }
}

/// The results of a setting at the sample points, in the goal's unit: dB or milliseconds.
#[derive(Clone, Copy)]
struct Assessment {
    /// The worst value at the selection points.
    selection_worst: f64,
    /// The spread of the selection points.
    margin: f64,
    /// The worst value minus the margin: the value that other points can be expected to reach.
    guaranteed: f64,
    /// The worst value at the verification points.
    verification_worst: f64,
}

impl Goal {
    /// Whether a value in the goal's unit reaches it. NaN does not.
    fn is_met_by(self, value: f64) -> bool {
        match self {
            Self::AtLeastDb(db) => value >= db,
            Self::AtMostMs(ms) => value <= ms,
        }
    }

    fn assess(self, measurement: &Measurement) -> Assessment {
        let value = |result: &SampleResult| match self {
            // NaN stays NaN, which reaches no goal.
            Self::AtLeastDb(_) => Some(result.min_db.clamp(f64::NEG_INFINITY, MAX_DB)),
            Self::AtMostMs(_) => result.p95_ms,
        };
        let values_at = |for_selection: bool| {
            let results = measurement
                .by_sample_point
                .iter()
                .filter(move |result| result.for_selection == for_selection);
            results.filter_map(value).collect::<Vec<f64>>()
        };
        let selection = values_at(true);
        let verification = values_at(false);
        // Both give NaN for no values, too.
        let least = |values: &[f64]| min(values.iter().copied());
        let most = |values: &[f64]| values.iter().copied().fold(f64::NAN, f64::max);
        match self {
            Self::AtLeastDb(_) => {
                let selection_worst = least(&selection);
                // At least 1 dB: a few points with the same value by chance show no spread.
                let margin = worse_half_deviation(&selection, f64::lt).max(MIN_MARGIN_DB);
                Assessment {
                    selection_worst,
                    margin,
                    guaranteed: selection_worst - margin,
                    verification_worst: least(&verification),
                }
            }
            Self::AtMostMs(_) => {
                let selection_worst = most(&selection);
                let min_margin_ms = MIN_MARGIN_MS_SHARE * selection_worst;
                let margin = worse_half_deviation(&selection, f64::gt).max(min_margin_ms);
                Assessment {
                    selection_worst,
                    margin,
                    guaranteed: selection_worst + margin,
                    verification_worst: most(&verification),
                }
            }
        }
    }
}

/// Standard deviation of the values that are worse than the median, from the median. Values that
/// are much better than the others do not count against a setting. 0 if no value is worse.
fn worse_half_deviation(values: &[f64], is_worse: fn(&f64, &f64) -> bool) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    // Without values `at` gives NaN, and so do median and deviation.
    let last = sorted.len().saturating_sub(1);
    let at = |index: usize| sorted.get(index).copied().unwrap_or(f64::NAN);
    // For an odd number both indices are the middle one.
    let median = 0.5 * (at(last / 2) + at(last.div_ceil(2)));
    let worse: Vec<f64> = sorted.into_iter().filter(|value| is_worse(value, &median)).collect();
    let squares: f64 = worse.iter().map(|value| (value - median).powi(2)).sum();
    // Without a worse value 0/1: no spread.
    (squares / worse.len().max(1) as f64).sqrt()
}

impl std::fmt::Display for Goal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::AtLeastDb(db) => write!(f, "at least {db} dB"),
            Self::AtMostMs(ms) => write!(f, "at most {ms} ms"),
        }
    }
}
