//! What is worth taking: the settings that no other one beats, and one for a wanted error or time.

use serde::Serialize;

use super::ReportError;
use super::measure::Measured;

/// What is wanted of a setting.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Wanted {
    /// At every place at least this PSNR, in dB, in as little time as possible.
    AtLeastDb(f64),
    /// All but one of twenty steps within this time, in milliseconds, with as little error as possible.
    AtMostMs(f64),
}

/// A setting that was chosen by some places, and what the others say of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Recommendation {
    /// What was wanted.
    pub wanted: Wanted,
    /// The setting's name.
    pub setting: String,
    /// Its changes of the profile.
    pub profile: Vec<String>,
    /// The backend's name.
    pub backend: String,
    /// What was measured where it was chosen: dB or milliseconds, whichever was wanted.
    pub chosen_by: f64,
    /// The same at places that were not used to choose it.
    pub verified: f64,
}

/// How much better than wanted a setting is chosen, so that it holds elsewhere: 1 dB, ...
const MARGIN_DB: f64 = 1.0;
/// ... or a tenth of the time.
const MARGIN_MS: f64 = 0.9;

/// Which of them no other one beats, in time and in error at once.
pub fn front(all: &[Measured]) -> Vec<bool> {
    let point = |m: &Measured| (m.cost.step_ms, m.errors.psnr_db);
    let beaten = |(ms, db): (f64, f64)| {
        let better = |(other_ms, other_db)| {
            (other_ms < ms && other_db >= db) || (other_ms <= ms && other_db > db)
        };
        all.iter().any(|other| better(point(other)))
    };
    all.iter().map(|m| !beaten(point(m))).collect()
}

/// The setting for what is wanted, of those that a server can be told to use.
///
/// # Errors
/// None is good enough where settings are chosen; or the best one is not where it is verified.
pub fn recommend(
    wanted: Wanted,
    all: &[Measured],
    backends: &[String],
) -> Result<Recommendation, ReportError> {
    let servable = || all.iter().filter(|m| m.setting.can_be_served());
    let best = match wanted {
        Wanted::AtLeastDb(db) => servable()
            .filter(|m| m.least_db[0] >= db + MARGIN_DB)
            .min_by(|a, b| a.cost.step_ms.total_cmp(&b.cost.step_ms)),
        Wanted::AtMostMs(ms) => servable()
            .filter(|m| m.p95_ms[0] <= MARGIN_MS * ms)
            .max_by(|a, b| a.least_db[0].total_cmp(&b.least_db[0])),
    };
    let Some(best) = best else {
        let reached = match wanted {
            Wanted::AtLeastDb(_) => servable().map(|m| m.least_db[0]).fold(0.0, f64::max),
            Wanted::AtMostMs(_) => servable().map(|m| m.p95_ms[0]).fold(f64::INFINITY, f64::min),
        };
        return Err(ReportError::OutOfReach { wanted: wanted.to_string(), reached });
    };
    let (chosen_by, verified, holds) = match wanted {
        Wanted::AtLeastDb(db) => (best.least_db[0], best.least_db[1], best.least_db[1] >= db),
        Wanted::AtMostMs(ms) => (best.p95_ms[0], best.p95_ms[1], best.p95_ms[1] <= ms),
    };
    if !holds {
        let (setting, wanted) = (best.setting.name.clone(), wanted.to_string());
        return Err(ReportError::NotVerified { setting, wanted, verified });
    }
    Ok(Recommendation {
        wanted,
        setting: best.setting.name.clone(),
        profile: best.setting.profile.clone(),
        backend: backends[best.setting.backend].clone(),
        chosen_by,
        verified,
    })
}

impl std::fmt::Display for Wanted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::AtLeastDb(db) => write!(f, "at least {db} dB"),
            Self::AtMostMs(ms) => write!(f, "at most {ms} ms"),
        }
    }
}
