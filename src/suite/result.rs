//! The result of a run, `result.json`.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;
use serde_json::Value;

use wildcity_episode::{EpisodeFile, FaultLine, ScoreLine, mcap_of};
use wildcity_score::statistics::{Mean, wilson};
use wildcity_score::{own, range_of};
use wildcity_session::Engine;

use crate::case::Case;
use crate::finish::Finished;
use crate::limits;
use crate::technical::Technical;

/// All episodes of a run, and what they say together. It has no times of the clock: the same drives give the same
/// bytes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SuiteResult {
    /// `wildcity.suite-result/1`.
    pub format: &'static str,
    /// Name of the suite.
    pub suite: String,
    /// The agent.
    pub agent: String,
    /// Whether versions that scenarios name were ignored.
    pub latest: bool,
    /// The least pass rate that was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_least: Option<f64>,
    /// How many episodes ended how.
    pub counts: Counts,
    /// The pass rate, of the episodes that were judged.
    pub pass_rate: Rate,
    /// Mean of each score over the scenarios, of the means over their seeds.
    pub means: BTreeMap<String, MeanEntry>,
    /// The pass rate of each scenario.
    pub scenarios: BTreeMap<String, Rate>,
    /// The episodes, by name.
    pub episodes: Vec<EpisodeEntry>,
}

/// How many episodes ended how.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// All.
    pub episodes: u64,
    /// Passed.
    pub passed: u64,
    /// Failed by driving.
    pub failed: u64,
    /// Left the trained area before any fault.
    pub off_model: u64,
    /// Without what a verdict needs.
    pub not_judged: u64,
    /// Not driven, for technical reasons.
    pub technical: u64,
}

/// A rate with its 95 % interval (Wilson).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rate {
    /// Passed.
    pub passed: u64,
    /// Of so many that were judged.
    pub runs: u64,
    /// Passed/runs; null without runs.
    pub rate: Option<f64>,
    /// The ends of the interval.
    pub interval: [f64; 2],
}

/// A mean with its 95 % interval ([`Mean::interval`]).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MeanEntry {
    /// The mean.
    pub mean: f64,
    /// The ends of the interval, within the range of the score; null below three scenarios.
    pub interval: Option<[f64; 2]>,
    /// Number of scenarios with a value.
    pub scenarios: u64,
}

/// One episode.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EpisodeEntry {
    /// Its name.
    pub name: String,
    /// Name of the scenario.
    pub scenario: String,
    /// The seed.
    pub seed: u64,
    /// The values of the sweep.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, Value>,
    /// BLAKE3 of the resolved scenario.
    pub scenario_hash: String,
    /// BLAKE3 of the twin's manifest.
    pub version_hash: String,
    /// How it ended.
    pub status: Status,
    /// The faults, by time.
    pub faults: Vec<FaultLine>,
    /// What was not judged, and why.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub not_judged: Vec<String>,
    /// The scores.
    pub scores: BTreeMap<String, ScoreLine>,
    /// Steps driven.
    pub steps: u64,
    /// Distance driven, in metres.
    pub distance_m: f64,
    /// BLAKE3 of all frame hashes; empty if nothing was driven.
    pub frames_hash: String,
    /// The file of its record, below `episodes`; empty if nothing was driven.
    pub record: String,
    /// The MCAP file of its record, below `episodes`, or why there is none; `None` if none was asked for. Not in
    /// `result.json`: whether an export is ready at the end of a run depends on the clock.
    #[serde(skip)]
    pub mcap: Option<Result<String, String>>,
    /// Technical failures, of every attempt.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<TechnicalEntry>,
}

/// A technical failure of an attempt.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct TechnicalEntry {
    /// `server_error`, `agent_error`, `agent_timeout` or `agent_lost`.
    pub kind: String,
    /// What happened.
    pub message: String,
}

/// How an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// Without a fault.
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

/// The exit code of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitCode {
    /// As wanted.
    Passed = 0,
    /// An episode failed by driving, or the pass rate is too low.
    Driving = 1,
    /// The command line, the suite or a scenario is wrong.
    Usage = 2,
    /// An episode was not driven, or more than a tenth were off the model.
    Technical = 3,
    /// With `--verify`: an episode does not repeat.
    NotVerified = 4,
}

impl SuiteResult {
    /// The format of `result.json`.
    pub const FORMAT: &str = "wildcity.suite-result/1";

    pub(crate) fn new(
        suite: String,
        agent: String,
        latest: bool,
        at_least: Option<f64>,
        episodes: Vec<EpisodeEntry>,
    ) -> Self {
        let mut counts = Counts { episodes: episodes.len() as u64, ..Counts::default() };
        let mut by_scenario: BTreeMap<String, Vec<&EpisodeEntry>> = BTreeMap::new();
        for episode in &episodes {
            let count = match episode.status {
                Status::Passed => &mut counts.passed,
                Status::Failed => &mut counts.failed,
                Status::OffModel => &mut counts.off_model,
                Status::NotJudged => &mut counts.not_judged,
                Status::Technical => &mut counts.technical,
            };
            *count += 1;
            by_scenario.entry(episode.scenario.clone()).or_default().push(episode);
        }
        let rate = |episodes: &[&EpisodeEntry]| {
            let judged = [Status::Passed, Status::Failed];
            let runs = episodes.iter().filter(|episode| judged.contains(&episode.status)).count();
            let passed = episodes.iter().filter(|episode| episode.status == Status::Passed).count();
            Rate::new(passed as u64, runs as u64)
        };
        Self {
            format: Self::FORMAT,
            suite,
            agent,
            latest,
            at_least,
            counts,
            pass_rate: rate(&episodes.iter().collect::<Vec<_>>()),
            means: means(&by_scenario),
            scenarios: by_scenario.iter().map(|(name, of)| (name.clone(), rate(of))).collect(),
            episodes,
        }
    }

    /// The exit code: technical failures before driving ones, since a result with holes says little of driving.
    pub fn exit_code(&self) -> ExitCode {
        let off_model = self.counts.off_model as f64;
        let too_often_off = off_model > limits::OFF_MODEL_SHARE * self.counts.episodes as f64;
        if self.counts.technical > 0 || too_often_off {
            return ExitCode::Technical;
        }
        let is_good = match self.at_least {
            Some(rate) => self.pass_rate.interval[0] >= rate,
            None => self.counts.failed == 0 && self.counts.not_judged == 0,
        };
        if is_good { ExitCode::Passed } else { ExitCode::Driving }
    }

    /// The file `result.json`.
    pub fn to_json(&self) -> String {
        // Numbers, texts and maps with text keys: writing them into memory cannot fail.
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }
}

/// Means over scenarios: more seeds of one scenario must not outweigh the others.
fn means(by_scenario: &BTreeMap<String, Vec<&EpisodeEntry>>) -> BTreeMap<String, MeanEntry> {
    let mut per_scenario: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for episodes in by_scenario.values() {
        let mut values: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        for (name, score) in episodes.iter().flat_map(|episode| &episode.scores) {
            if let Some(value) = score.value {
                values.entry(name).or_default().push(value);
            }
        }
        for (name, values) in values {
            if let Some(mean) = Mean::of(&values) {
                per_scenario.entry(name.to_owned()).or_default().push(mean.mean);
            }
        }
    }
    let entry = |name: &str, values: &[f64]| {
        let mean = Mean::of(values)?;
        let interval = mean.interval(range_of(name));
        Some(MeanEntry { mean: mean.mean, interval, scenarios: values.len() as u64 })
    };
    let entries = per_scenario.into_iter().filter_map(|(name, values)| {
        let entry = entry(&name, &values)?;
        Some((name, entry))
    });
    entries.collect()
}

impl Rate {
    fn new(passed: u64, runs: u64) -> Self {
        let rate = (runs > 0).then(|| passed as f64 / runs as f64);
        Self { passed, runs, rate, interval: wilson(passed, runs) }
    }
}

impl EpisodeEntry {
    pub(crate) fn new(case: &Case, finished: Option<Finished>, errors: Vec<Technical>) -> Self {
        let errors = errors
            .into_iter()
            .map(|error| TechnicalEntry { kind: error.kind.to_owned(), message: error.message });
        let mut entry = Self {
            name: case.name.clone(),
            scenario: case.scenario.clone(),
            seed: case.seed,
            values: case.values.clone(),
            scenario_hash: case.line.hash.clone(),
            version_hash: case.version_hash.clone(),
            status: Status::Technical,
            faults: Vec::new(),
            not_judged: Vec::new(),
            scores: BTreeMap::new(),
            steps: 0,
            distance_m: 0.0,
            frames_hash: String::new(),
            record: String::new(),
            mcap: None,
            errors: errors.collect(),
        };
        if let Some(Finished { record, end, result, frames_hash }) = finished {
            entry.status = match result.verdict.as_str() {
                "passed" => Status::Passed,
                "failed" => Status::Failed,
                "off_model" => Status::OffModel,
                _ => Status::NotJudged,
            };
            entry.faults = result.faults;
            entry.not_judged = result.not_judged;
            entry.scores = result.scores;
            entry.steps = end.steps;
            entry.distance_m = end.distance_m;
            entry.frames_hash = frames_hash;
            entry.record = record;
        }
        entry
    }
}

impl EpisodeEntry {
    /// Says where the MCAP file of the record is, or why there is none.
    pub(crate) fn add_mcap(&mut self, episodes: &Path, engine: &Engine) {
        if self.record.is_empty() {
            return;
        }
        let mcap = mcap_of(Path::new(&self.record));
        self.mcap = Some(match engine.export_failure(&EpisodeFile::name_of(&mcap)) {
            Some(reason) => Err(reason),
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
        self.faults.iter().map(|fault| self.fault_text(fault)).collect()
    }

    fn fault_text(&self, fault: &FaultLine) -> String {
        let actor = fault.actor.as_ref().map(|actor| format!(" with {actor}")).unwrap_or_default();
        let text = format!("{}{actor} at {:.3} s", fault.fault, fault.time_us as f64 * 1e-6);
        let part = |name: &str| self.scores.get(own::NAME)?.parts.get(name).copied().flatten();
        match (&*fault.fault, part("progress"), part("least_progress")) {
            ("progress", Some(progress), Some(least)) => {
                format!("{text}: {progress:.3} of the recorded drive, and {least} is the least")
            }
            _ => text,
        }
    }
}

impl Status {
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
