//! The result of a run, `result.json`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use wildcity_score::score_range;
use wildcity_score::statistics::{Mean, wilson};

use crate::entry::{EpisodeEntry, Status};
use crate::error::SuiteError;
use crate::file::{OFF_MODEL, read};
use crate::limits;

/// All episodes of a run, and their rates and means. It has no clock times, so that the same drives
/// give the same bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SuiteResult {
    /// Name of the format: `wildcity.suite-result/1`.
    pub format: String,
    /// Name of the suite.
    pub suite: String,
    pub agent: String,
    /// Whether versions that scenarios name were ignored.
    pub latest: bool,
    /// Simulated time of a step, in microseconds; absent in results of older builds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dt_us: Option<i64>,
    /// The least pass rate that was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at_least: Option<f64>,
    /// The criteria that needed not be judged for a pass.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub accept_unjudged: Vec<String>,
    /// How many episodes ended how.
    pub counts: Counts,
    /// The pass rate, of the episodes that were judged, without duplicates.
    pub pass_rate: Rate,
    /// Mean of each score over the scenarios, of the means over their seeds.
    pub means: BTreeMap<String, MeanEntry>,
    /// The pass rate of each scenario.
    pub scenarios: BTreeMap<String, Rate>,
    /// The episodes, by name.
    pub episodes: Vec<EpisodeEntry>,
}

/// Setup of a run.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct RunHead {
    /// Name of the suite.
    pub(crate) suite: String,
    pub(crate) agent: String,
    /// Whether versions that scenarios name were ignored.
    pub(crate) latest: bool,
    /// Simulated time of a step, in microseconds.
    pub(crate) dt_us: Option<i64>,
    /// The least pass rate that was asked for.
    pub(crate) at_least: Option<f64>,
    /// The criteria that needed not be judged for a pass.
    pub(crate) accept_unjudged: Vec<String>,
}

/// The header of a result file: only its format, which is checked first.
#[derive(Deserialize)]
struct Head {
    format: String,
}

/// How many episodes ended how.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    pub episodes: u64,
    pub passed: u64,
    pub failed: u64,
    /// Left the trained area before any fault.
    pub off_model: u64,
    /// Without a fault, but not judged by every criterion.
    pub not_judged: u64,
    /// Not driven, for technical reasons.
    pub technical: u64,
    /// Driven as another episode of the same scenario was. They are counted above, and are in no
    /// rate and no mean.
    #[serde(default)]
    pub duplicates: u64,
}

/// What became of the episodes; what did not happen is left out.
impl std::fmt::Display for Counts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { episodes, passed, failed, off_model, not_judged, technical, .. } = *self;
        let episodes_text = if episodes == 1 { "episode" } else { "episodes" };
        if passed == episodes {
            return match episodes {
                1 => write!(f, "the episode passed"),
                _ => write!(f, "all {episodes} episodes passed"),
            };
        }
        let parts = [
            (failed, "failed"),
            (not_judged, "not judged"),
            (off_model, "left the trained area"),
            (technical, "not driven for technical reasons"),
            (passed, "passed"),
        ];
        let happened = parts.into_iter().filter(|(count, _)| *count > 0);
        let texts: Vec<String> = happened.map(|(count, what)| format!("{count} {what}")).collect();
        write!(f, "of {episodes} {episodes_text}: {}", texts.join(", "))
    }
}

/// A rate with its 95 % interval (Wilson).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    pub passed: u64,
    /// Number of judged episodes.
    pub runs: u64,
    /// Passed/runs; null without runs.
    pub rate: Option<f64>,
    /// The ends of the interval.
    pub interval: [f64; 2],
}

/// A mean with its 95 % interval ([`Mean::interval`]).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeanEntry {
    pub mean: f64,
    /// The ends of the interval, within the range of the score; null below three scenarios.
    pub interval: Option<[f64; 2]>,
    /// Number of scenarios with a value.
    pub scenarios: u64,
}

impl SuiteResult {
    /// The format of `result.json`.
    pub const FORMAT: &str = "wildcity.suite-result/1";

    /// The name of its file.
    pub const FILE: &str = "result.json";

    /// Whether an episode that left the trained area is no error of the run.
    pub(crate) fn accepts_off_model(&self) -> bool {
        self.accept_unjudged.iter().any(|name| name == OFF_MODEL)
    }

    /// The result of some episodes, which are in order of their names.
    pub(crate) fn new(head: RunHead, mut episodes: Vec<EpisodeEntry>) -> Self {
        // First, because rates and means leave duplicates out.
        mark_duplicates(&mut episodes);
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
            counts.duplicates += u64::from(episode.duplicate_of.is_some());
            by_scenario.entry(episode.scenario.clone()).or_default().push(episode);
        }
        Self {
            format: Self::FORMAT.to_owned(),
            suite: head.suite,
            agent: head.agent,
            latest: head.latest,
            dt_us: head.dt_us,
            at_least: head.at_least,
            accept_unjudged: head.accept_unjudged,
            counts,
            pass_rate: Rate::count(episodes.iter()),
            means: means(&by_scenario),
            scenarios: by_scenario
                .iter()
                .map(|(name, of)| (name.clone(), Rate::count(of.iter().copied())))
                .collect(),
            episodes,
        }
    }

    /// Reads the result of a run: its `result.json`, or the directory that has it.
    ///
    /// # Errors
    /// The file cannot be read, or is not a result of a run; names the file, and the place of the
    /// first mistake.
    pub fn read(run: &Path) -> Result<Self, SuiteError> {
        let path = if run.is_dir() { run.join(Self::FILE) } else { run.to_owned() };
        let bytes = read(&path, limits::RESULT_BYTES)?;
        let wrong = |reason: String| SuiteError::NoResult { path: path.clone(), reason };
        // The format alone first: another version may have other fields.
        let Head { format } = serde_json::from_slice(&bytes)
            .map_err(|error| wrong(format!("no JSON object with a format: {error}")))?;
        if format != Self::FORMAT {
            return Err(wrong(format!("its format is {format:?}, not {:?}", Self::FORMAT)));
        }
        let mut reader = serde_json::Deserializer::from_slice(&bytes);
        // With the path to the mistake, because a result has up to 100,000 episodes.
        serde_path_to_error::deserialize(&mut reader)
            .map_err(|error| wrong(format!("{}: {}", error.path(), error.inner())))
    }

    /// The folder with the records of a run; `run` as for [`SuiteResult::read`].
    pub fn records(run: &Path) -> PathBuf {
        let dir = if run.is_dir() { run } else { run.parent().unwrap_or(Path::new("")) };
        dir.join("episodes")
    }

    /// The note about duplicates; `None` if there are none.
    pub fn duplicates_text(&self) -> Option<String> {
        let Counts { duplicates, episodes, .. } = self.counts;
        (duplicates > 0).then(|| {
            format!(
                "{duplicates} of {episodes} episodes {} the drive of an earlier seed of the scenario: rates and means count it \
                 once. Without `jitter`, `jitter_frames` or sensor effects a seed changes nothing: add one of these, or drive \
                 one seed",
                if duplicates == 1 { "repeats" } else { "repeat" },
            )
        })
    }

    /// The text of the file `result.json`.
    pub fn to_json(&self) -> String {
        // Numbers, texts and maps with text keys: writing them into memory cannot fail.
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }
}

/// Means over scenarios: more seeds of one scenario must not outweigh the others.
fn means(by_scenario: &BTreeMap<String, Vec<&EpisodeEntry>>) -> BTreeMap<String, MeanEntry> {
    // Two levels: values of a score within a scenario, then the means of scenarios.
    let mut per_scenario: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for episodes in by_scenario.values() {
        let mut values: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        let distinct = episodes.iter().filter(|episode| episode.duplicate_of.is_none());
        for (name, score) in distinct.flat_map(|episode| &episode.scores) {
            if let Some(value) = score.value {
                values.entry(name).or_default().push(value);
            }
        }
        for (name, values) in values {
            if let Some(mean) = Mean::from_values(&values) {
                per_scenario.entry(name.to_owned()).or_default().push(mean.mean);
            }
        }
    }
    // No scenario with a value means no entry, instead of a mean of nothing.
    let entry = |name: &str, values: &[f64]| {
        let mean = Mean::from_values(values)?;
        let interval = mean.interval(score_range(name));
        Some(MeanEntry { mean: mean.mean, interval, scenarios: values.len() as u64 })
    };
    let entries = per_scenario.into_iter().filter_map(|(name, values)| {
        let entry = entry(&name, &values)?;
        Some((name, entry))
    });
    entries.collect()
}

/// Marks episodes that were driven in the same way as an earlier one of their scenario, as two
/// seeds of a scenario without jitter are. Counted twice, they would narrow the intervals without
/// adding information.
fn mark_duplicates(episodes: &mut [EpisodeEntry]) {
    let mut first: BTreeMap<(String, Status, String), String> = BTreeMap::new();
    for episode in episodes.iter_mut().filter(|episode| !episode.drive_hash.is_empty()) {
        // The status too, so that episodes with different verdicts stay apart.
        let drive = (episode.scenario.clone(), episode.status, episode.drive_hash.clone());
        match first.get(&drive) {
            Some(name) => episode.duplicate_of = Some(name.clone()),
            None => {
                first.insert(drive, episode.name.clone());
            }
        }
    }
}

impl Rate {
    /// The pass rate of the episodes that were judged, without duplicates.
    fn count<'a>(episodes: impl Iterator<Item = &'a EpisodeEntry>) -> Self {
        let distinct = episodes.filter(|episode| episode.duplicate_of.is_none());
        let judged = distinct.filter(|episode| episode.status.is_judged());
        let passes: Vec<bool> = judged.map(|episode| episode.status == Status::Passed).collect();
        let passed = passes.iter().filter(|passed| **passed).count();
        Self::new(passed as u64, passes.len() as u64)
    }

    /// In words: `4 of 4 (95 %: 51.0 to 100.0 %)`; of no runs, that there are none.
    pub fn text(&self) -> String {
        let [low, high] = self.interval.map(|end| 100.0 * end);
        match self.runs {
            0 => "no episode was judged".to_owned(),
            runs => format!("{} of {runs} (95 %: {low:.1} to {high:.1} %)", self.passed),
        }
    }

    fn new(passed: u64, runs: u64) -> Self {
        // No rate instead of 0 / 0. The interval is then all of 0 to 1.
        let rate = (runs > 0).then(|| passed as f64 / runs as f64);
        Self { passed, runs, rate, interval: wilson(passed, runs) }
    }
}
