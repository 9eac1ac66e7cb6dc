//! One episode of a result.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use wildcity_episode::{EpisodeFile, FaultLine, ScoreLine, mcap_path};
use wildcity_score::{NO_MAP, own};
use wildcity_session::Engine;
use wildcity_sim::scenario::written_values;

use crate::case::Case;
use crate::file::OFF_MODEL;
use crate::finish::Finished;
use crate::technical::Technical;

/// The result of one episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeEntry {
    pub name: String,
    /// Name of the scenario.
    pub scenario: String,
    pub seed: u64,
    /// The values of the sweep.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, Value>,
    /// BLAKE3 of the resolved scenario.
    pub scenario_hash: String,
    /// BLAKE3 of the twin's manifest.
    pub version_hash: String,
    pub status: Status,
    /// The faults, by time.
    pub faults: Vec<FaultLine>,
    /// Criteria that were not judged, and why: `off_road: the scenario has no map`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_judged: Vec<String>,
    /// What the scenario is about and did not happen, or could not be judged
    /// ([`EpisodeFile::untested`]). It changes no status.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub untested: Vec<String>,
    pub scores: BTreeMap<String, ScoreLine>,
    pub steps: u64,
    /// Distance driven, in metres.
    pub distance_m: f64,
    /// BLAKE3 of all frame hashes; empty if nothing was driven.
    pub frames_hash: String,
    /// The first episode of the scenario that was driven alike: same poses, actors, images and
    /// status. A duplicate says nothing new, and is in no rate and no mean.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub duplicate_of: Option<String>,
    /// BLAKE3 of poses, actors and images, in hex; empty if nothing was driven. Not in
    /// `result.json`.
    #[serde(skip)]
    pub(crate) drive_hash: String,
    /// The file of its record, below `episodes`; empty if nothing was driven.
    pub record: String,
    /// How long it took, with all attempts. Not in `result.json`, which has no wall-clock times.
    #[serde(skip)]
    pub wall: Duration,
    /// The MCAP file of its record, below `episodes`, or why there is none; `None` if none was
    /// asked for. Not in `result.json`: whether an export is ready at the end of a run depends on
    /// the clock.
    #[serde(skip)]
    pub mcap: Option<Result<String, String>>,
    /// Technical failures, of every attempt.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<TechnicalEntry>,
}

/// A technical failure of an attempt.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TechnicalEntry {
    /// `server_error`, `agent_error`, `agent_timeout` or `agent_lost`.
    pub kind: String,
    pub message: String,
    /// The last lines that the agent wrote to its standard error. Not in `result.json`: they may
    /// have times.
    #[serde(skip)]
    pub stderr: String,
}

/// How an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    Passed,
    /// With a fault of driving.
    Failed,
    /// Off the trained area before any fault.
    OffModel,
    /// Without what a verdict needs.
    NotJudged,
    /// Not driven, for technical reasons.
    Technical,
}

impl EpisodeEntry {
    /// The entry of a case. A pass need not be judged by the criteria `accept_unjudged`.
    pub(crate) fn new(
        case: &Case,
        finished: Option<Finished>,
        errors: Vec<Technical>,
        accept_unjudged: &[String],
    ) -> Self {
        let errors = errors.into_iter().map(|error| TechnicalEntry {
            kind: error.kind.to_owned(),
            message: error.message,
            stderr: error.stderr,
        });
        let mut entry = Self {
            name: case.name.clone(),
            scenario: case.scenario.clone(),
            seed: case.seed,
            values: written_values(&case.values),
            scenario_hash: case.line.hash.clone(),
            version_hash: case.version_hash.clone(),
            status: Status::Technical,
            faults: Vec::new(),
            not_judged: Vec::new(),
            untested: Vec::new(),
            scores: BTreeMap::new(),
            steps: 0,
            distance_m: 0.0,
            frames_hash: String::new(),
            duplicate_of: None,
            drive_hash: String::new(),
            wall: Duration::ZERO,
            record: String::new(),
            mcap: None,
            errors: errors.collect(),
        };
        if let Some(finished) = finished {
            let Finished { record, end, mut result, untested, frames_hash, drive_hash } = finished;
            if case.options.outputs.trust != Some(true) {
                // Without a recorded drive nothing says where the twin was trained.
                result.not_judged.push(format!("{OFF_MODEL}: {NO_TRUST}"));
            }
            // An unknown verdict falls to the last arms and is never a pass without an accepted
            // reason.
            entry.status = match result.verdict.as_str() {
                "passed" if result.not_judged.is_empty() => Status::Passed,
                "failed" => Status::Failed,
                "off_model" => Status::OffModel,
                _ if are_accepted(&result.not_judged, accept_unjudged) => Status::Passed,
                _ => Status::NotJudged,
            };
            entry.faults = result.faults;
            entry.not_judged = result.not_judged;
            entry.untested = untested;
            entry.scores = result.scores;
            // The score must agree with the status, which the suite may have changed.
            match (entry.status, entry.scores.get_mut(own::NAME)) {
                // It has no value if a criterion was not judged.
                (Status::Passed, Some(score)) => {
                    score.value = Some(1.0);
                    score.reason = None;
                }
                (Status::NotJudged, Some(score)) => {
                    score.value = None;
                    score.reason = Some(entry.not_judged.join("; "));
                }
                _ => {}
            }
            entry.steps = end.steps;
            entry.distance_m = end.distance_m;
            entry.frames_hash = frames_hash;
            entry.drive_hash = drive_hash;
            entry.record = record;
        }
        entry
    }
}

/// Whether all criteria of an episode that were not judged are accepted. Each text begins with the
/// name of its criterion. Without a text, the record has no verdict that a suite could accept.
fn are_accepted(not_judged: &[String], accept_unjudged: &[String]) -> bool {
    let is_accepted = |text: &String| {
        text.split_once(':').is_some_and(|(name, _)| accept_unjudged.iter().any(|one| one == name))
    };
    // Without a colon the text has no criterion, and is not accepted.
    !not_judged.is_empty() && not_judged.iter().all(is_accepted)
}

/// The status `off_model` in words.
pub(crate) const LEFT: &str = "left the trained area of the twin before any fault";

/// The reason why a twin without a recorded drive is not judged by [`OFF_MODEL`].
const NO_TRUST: &str = "the twin has no recorded drive to compare with";

/// What to do about a criterion that was not judged.
fn fix(not_judged: &str) -> String {
    let name = not_judged.split_once(':').map_or(not_judged, |(name, _)| name);
    let accepted = format!("--accept-unjudged {name}");
    match not_judged {
        // By the end of the text, because the name of the criterion is in front of it.
        text if text.ends_with(NO_MAP) => format!("add a map, or {accepted}"),
        text if text.ends_with(NO_TRUST) => {
            format!("add a drive with `wildcity twin drive`, or {accepted}")
        }
        _ => format!("{accepted} accepts this"),
    }
}

impl EpisodeEntry {
    /// Why the episode has no verdict, and what to do about it; empty if it has one.
    pub fn not_judged_texts(&self) -> Vec<String> {
        let is_not_judged = self.status == Status::NotJudged;
        let reasons = self.not_judged.iter().filter(|_| is_not_judged);
        reasons.map(|reason| format!("{reason} ({})", fix(reason))).collect()
    }

    /// What the episode did not test, as lines of a report.
    pub fn untested_texts(&self) -> impl Iterator<Item = String> {
        self.untested.iter().map(|text| format!("not tested: {text}"))
    }

    /// Says where the MCAP file of the record is, or why there is none.
    pub(crate) fn add_mcap(&mut self, episodes: &Path, engine: &Engine) {
        if self.record.is_empty() {
            return;
        }
        let mcap = mcap_path(Path::new(&self.record));
        self.mcap = Some(match engine.export_failure(&EpisodeFile::episode_name(&mcap)) {
            Some(reason) => Err(reason),
            // Below `episodes`, as the record is, so that a report can link to it.
            None if episodes.join(&mcap).is_file() => Ok(mcap.display().to_string()),
            None => Err("it was not ready at the end of the run".to_owned()),
        });
    }

    /// Why there is no MCAP file although one was asked for.
    pub fn mcap_error(&self) -> Option<&str> {
        self.mcap.as_ref()?.as_ref().err().map(String::as_str)
    }

    /// The faults in words, by time: `contact.pedestrian with walker at 4.615 s`.
    pub(crate) fn fault_texts(&self) -> Vec<String> {
        self.faults.iter().map(|fault| fault.text(&self.scores)).collect()
    }

    /// The name of the first episode that was driven alike, which may be its own.
    pub(crate) fn drive_name(&self) -> &str {
        self.duplicate_of.as_deref().unwrap_or(&self.name)
    }

    /// For a duplicate, that it is one.
    pub fn duplicate_text(&self) -> Option<String> {
        let first = self.duplicate_of.as_ref()?;
        Some(format!("the same drive as {first}, not counted again"))
    }
}

impl TechnicalEntry {
    /// Kind, message, and what the agent said.
    pub fn text(&self) -> String {
        let said =
            if self.stderr.is_empty() { String::new() } else { format!("\n{}", self.stderr) };
        format!("{}: {}{said}", self.kind, self.message)
    }
}

impl Status {
    /// Whether it is in pass rates.
    pub(crate) fn is_judged(self) -> bool {
        matches!(self, Self::Passed | Self::Failed)
    }

    /// The name in `result.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Passed => "passed",
            Self::Failed => "failed",
            Self::OffModel => "off_model",
            Self::NotJudged => "not_judged",
            Self::Technical => "technical",
        }
    }
}
