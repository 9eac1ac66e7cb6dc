//! What is worth taking: the settings that no other one beats, and one for a wanted error or time.

use serde::Serialize;

use super::ReportError;
use super::measure::{Measurement, SampleResult, least};
use super::settings::{Family, Sent};
use wildcity_render::compare::json_numbers::serialize_number;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::{ProfileOverrides, RenderProfile};

/// What is wanted of a setting.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Goal {
    /// In every camera's window at every place at least this PSNR, in dB, in as little time as possible.
    AtLeastDb(f64),
    /// All but one of twenty steps within this time, in milliseconds, with as little error as possible.
    AtMostMs(f64),
}

/// A setting that was chosen by some places, and what the others say of it. All but
/// [`Recommendation::encoded`] is of what is rendered, before images are encoded: a profile does not choose
/// the encoding.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Recommendation {
    /// What was wanted.
    pub wanted: Goal,
    /// The setting's name.
    pub setting: String,
    /// Its changes of the profile.
    pub profile: Vec<String>,
    /// The backend's name.
    pub backend: String,
    /// The worst that was measured where it was chosen: dB or milliseconds, whichever was wanted.
    pub chosen_by: f64,
    /// How much better than wanted that had to be, in the same unit: what places differ by.
    pub margin: f64,
    /// The worst at places that were not used to choose it.
    pub verified: f64,
    /// Where in the way of an image to an agent all of that was measured: [`RENDERED`].
    pub measured: &'static str,
    /// What encodings lose and take on top.
    pub encoded: Vec<EncodingCost>,
}

/// What the twin as served loses and takes when its images are encoded.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EncodingCost {
    /// The rung, as `jpeg 90`.
    pub sent: String,
    /// Whether sessions get their images so unless they ask for another encoding.
    pub by_default: bool,
    /// Least PSNR of a window at any place, in dB, of what arrives.
    #[serde(serialize_with = "serialize_number")]
    pub least_db: f64,
    /// Milliseconds that the median step takes longer than without, each timed in turn with one without;
    /// chance can make it less than 0.
    pub more_ms: f64,
}

/// What decibels and milliseconds of a recommendation are of.
pub const RENDERED: &str = "what is rendered, before images are encoded";

/// Least margin: 1 dB, ...
const MARGIN_DB: f64 = 1.0;
/// ... or a tenth of the time.
const MARGIN_MS: f64 = 0.1;
/// Where nothing differs PSNR has no end, and means need one: steps of f32 below 1 leave 20 log10(2^24).
const MOST_DB: f64 = 144.5;

/// Which of them no other one beats, in time and in error at once. What is compared with rays is another
/// question, and neither beats nor is beaten.
pub fn pareto_front(all: &[Measurement]) -> Vec<bool> {
    let is_asked = |m: &&Measurement| m.setting.family != Family::Rays;
    let point = |m: &Measurement| (m.cost.step_ms, m.errors.psnr_db);
    let beaten = |(ms, db): (f64, f64)| {
        let better = |(other_ms, other_db)| {
            (other_ms < ms && other_db >= db) || (other_ms <= ms && other_db > db)
        };
        all.iter().filter(is_asked).any(|other| better(point(other)))
    };
    all.iter().map(|m| is_asked(&m) && !m.errors.psnr_db.is_nan() && !beaten(point(m))).collect()
}

/// The setting for what is wanted, of those that a server can be told to use and that change something.
/// Of equals it is the first of the ladder, which begins with the twin as served.
///
/// The worst of the places that choose must be better than wanted by the deviation of their worse half: the
/// worst of eight values of a normal distribution lies 1.4 deviations from its mean on average, so
/// what is wanted then lies 2.4 away, where one of 120 others falls. It is verified all the same.
///
/// # Errors
/// None is good enough where settings are chosen; or the best one is not where it is verified.
pub fn recommend(
    wanted: Goal,
    all: &[Measurement],
    backends: &[String],
) -> Result<Recommendation, ReportError> {
    let served = all.iter().find(|m| m.setting.family == Family::AsServed);
    let changes = |m: &&Measurement| !served.is_some_and(|served| m.changes_nothing(served));
    let servable = all.iter().filter(|m| m.setting.can_be_served()).filter(changes);
    let judged = servable.map(|m| (m, wanted.judge(m)));
    let judged: Vec<(&Measurement, Assessment)> = judged.collect();
    let meets = judged.iter().filter(|(_, judged)| wanted.holds(judged.assured));
    let best = match wanted {
        Goal::AtLeastDb(_) => {
            meets.min_by(|(a, _), (b, _)| a.cost.step_ms.total_cmp(&b.cost.step_ms))
        }
        Goal::AtMostMs(_) => {
            let db = |m: &Measurement| Goal::AtLeastDb(0.0).judge(m).worst;
            let numbers = meets.filter(|(m, _)| !db(m).is_nan());
            numbers.reduce(|best, next| if db(next.0) > db(best.0) { next } else { best })
        }
    };
    let Some((best, Assessment { worst, margin, verified, .. })) = best.copied() else {
        let assured = judged.iter().map(|(_, judged)| judged.assured);
        let reached = match wanted {
            Goal::AtLeastDb(_) => assured.fold(f64::NEG_INFINITY, f64::max),
            Goal::AtMostMs(_) => assured.fold(f64::INFINITY, f64::min),
        };
        return Err(ReportError::GoalNotReached { wanted: wanted.to_string(), reached });
    };
    if !wanted.holds(verified) {
        let (setting, wanted) = (best.setting.name.clone(), wanted.to_string());
        return Err(ReportError::NotVerified { setting, wanted, verified });
    }
    let is_sent = |m: &&Measurement| m.setting.family == Family::Sent;
    Ok(Recommendation {
        wanted,
        setting: best.setting.name.clone(),
        profile: best.setting.profile.clone(),
        backend: backends[best.setting.backend].clone(),
        chosen_by: worst,
        margin,
        verified,
        measured: RENDERED,
        encoded: all.iter().filter(is_sent).map(EncodingCost::of).collect(),
    })
}

impl EncodingCost {
    fn of(m: &Measurement) -> Self {
        Self {
            sent: m.setting.name.clone(),
            by_default: m.setting.sent == Some(Sent::Jpeg(wildcity_session::limits::JPEG_QUALITY)),
            least_db: m.least_db(),
            more_ms: m.cost.step_ms - m.served_ms,
        }
    }
}

impl Recommendation {
    /// The fields of the profile that it changes, as a profile file has them.
    ///
    /// # Errors
    /// Names the change that cannot be made.
    pub fn changes(&self) -> Result<ProfileOverrides, ProfileError> {
        let mut profile = RenderProfile::default();
        self.profile.iter().try_for_each(|change| profile.set(change))?;
        let bad =
            |field: &str, reason: String| ProfileError::Change { field: field.to_owned(), reason };
        let all =
            serde_json::to_value(profile).map_err(|error| bad("profile", error.to_string()))?;
        let field = |change: &String| {
            let key = change.split_once('=').map_or(change.as_str(), |(key, _)| key);
            let value = all.get(key).ok_or_else(|| bad(key, "it is not written".to_owned()))?;
            Ok((key.to_owned(), value.clone()))
        };
        self.profile.iter().map(field).collect::<Result<_, _>>().map(ProfileOverrides::new)
    }

    /// What starts a server that draws so, with the profile in a file.
    pub fn serve(&self, profile: &str) -> String {
        format!("wildcity serve --backend {} --profile {profile}", self.backend)
    }

    /// What its decibels and milliseconds are of, and what encodings add to them.
    pub fn of_what(&self) -> String {
        let one = |encoded: &EncodingCost| {
            let EncodingCost { sent, by_default, least_db, more_ms } = encoded;
            let default = if *by_default { " (the default)" } else { "" };
            format!("{sent}{default} {least_db:.1} dB at worst and {more_ms:+.1} ms a step")
        };
        let all: Vec<String> = self.encoded.iter().map(one).collect();
        let encoded = match all.is_empty() {
            true => String::new(),
            false => format!("; encoded, the twin as served has: {}", all.join(", ")),
        };
        format!("of {}{encoded}", self.measured)
    }
}

/// What the places say of a setting, in dB or milliseconds.
#[derive(Clone, Copy)]
struct Assessment {
    /// The worst of those that choose.
    worst: f64,
    /// What they differ by.
    margin: f64,
    /// What can be counted on elsewhere.
    assured: f64,
    /// The worst of the others.
    verified: f64,
}

impl Goal {
    fn holds(self, value: f64) -> bool {
        match self {
            Self::AtLeastDb(db) => value >= db,
            Self::AtMostMs(ms) => value <= ms,
        }
    }

    fn judge(self, m: &Measurement) -> Assessment {
        let value = |place: &SampleResult| match self {
            // NaN stays NaN, and holds nothing.
            Self::AtLeastDb(_) => Some(place.least_db.clamp(f64::NEG_INFINITY, MOST_DB)),
            Self::AtMostMs(_) => place.p95_ms,
        };
        let of = |chooses: bool| {
            let places = m.by_place.iter().filter(move |place| place.chooses == chooses);
            places.filter_map(value).collect::<Vec<f64>>()
        };
        let (choosing, verifying) = (of(true), of(false));
        // NaN of no place, too.
        let least = |values: &[f64]| least(values.iter().copied());
        let most = |values: &[f64]| values.iter().copied().fold(f64::NAN, f64::max);
        match self {
            Self::AtLeastDb(_) => {
                let (worst, margin) = (least(&choosing), spread(&choosing, f64::lt).max(MARGIN_DB));
                Assessment { worst, margin, assured: worst - margin, verified: least(&verifying) }
            }
            Self::AtMostMs(_) => {
                let worst = most(&choosing);
                let margin = spread(&choosing, f64::gt).max(MARGIN_MS * worst);
                Assessment { worst, margin, assured: worst + margin, verified: most(&verifying) }
            }
        }
    }
}

/// Standard deviation of the worse half: from the median, so that places which are much better than others
/// do not count against a setting. 0 where none is worse.
fn spread(values: &[f64], is_worse: fn(&f64, &f64) -> bool) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    let middle = |at: usize| sorted.get(at).copied().unwrap_or(f64::NAN);
    let median = 0.5 * (middle(last / 2) + middle(last.div_ceil(2)));
    let worse: Vec<f64> = sorted.into_iter().filter(|value| is_worse(value, &median)).collect();
    let squares: f64 = worse.iter().map(|value| (value - median).powi(2)).sum();
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
