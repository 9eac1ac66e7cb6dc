//! The result of an episode: verdict and scores.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use wildcity_score::own::{self, Judgement};
use wildcity_score::score;

use crate::drive::drive_record;
use crate::file::EpisodeFile;

/// Verdict and scores of an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// `passed`, `failed`, `off_model` or `not_judged`.
    pub verdict: String,
    /// The faults, by time.
    pub faults: Vec<FaultLine>,
    /// What was not judged, and why.
    pub not_judged: Vec<String>,
    /// The scores, each with its name and version.
    pub scores: BTreeMap<String, ScoreLine>,
}

/// A fault of the ego.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FaultLine {
    /// Its name, as `contact.at_fault`.
    pub fault: String,
    /// When, in microseconds.
    pub time_us: i64,
    /// Name of the actor, for a contact with one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actor: Option<String>,
}

/// A score: its value, or null and the reason.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoreLine {
    /// The value.
    pub value: Option<f64>,
    /// Why there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// What it was computed from; null what it lacks.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub parts: BTreeMap<String, Option<f64>>,
}

/// Judges an episode and scores it. `None` if it has no frame.
///
/// The same function serves the end of a session and `wildcity episode score`: a record is all that it needs.
pub fn result(episode: &EpisodeFile) -> Option<EpisodeResult> {
    let record = drive_record(episode)?;
    let verdict = own::verdict(&record);
    let actors = episode.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
    let fault = |fault: &own::FaultAt| FaultLine {
        fault: fault.fault.name().to_owned(),
        time_us: fault.time_us,
        actor: fault
            .actor
            .and_then(|actor| actors.get(usize::from(actor)))
            .map(|actor| actor.name.clone()),
    };
    let line = |score: wildcity_score::Score| {
        let parts = score.parts.into_iter().map(|(name, part)| (name.to_owned(), part)).collect();
        (score.name.to_owned(), ScoreLine { value: score.value, reason: score.reason, parts })
    };
    let judgement = match verdict.judgement {
        Judgement::Passed => "passed",
        Judgement::Failed => "failed",
        Judgement::OffModel => "off_model",
        Judgement::NotJudged => "not_judged",
    };
    Some(EpisodeResult {
        verdict: judgement.to_owned(),
        faults: verdict.faults.iter().map(fault).collect(),
        not_judged: verdict.not_judged.iter().map(|&reason| reason.to_owned()).collect(),
        scores: score(&record).into_iter().map(line).collect(),
    })
}
