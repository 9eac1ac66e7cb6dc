//! Pairs of episodes: the same scenario, values and seed in two runs.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use serde_json::Value;

use wildcity_sim::scenario::written_values;

use crate::case::Case;
use crate::entry::{EpisodeEntry, Status};
use crate::result::SuiteResult;

use super::CompareError;

/// Change of an episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// Passed before, and does not pass now: it failed, or has no verdict.
    Worse,
    /// Failed before, and passes now.
    Better,
    /// Passed both times, or failed both times.
    Same,
    /// Had no verdict before, or failed before and has none now.
    Unknown,
    /// The twin or the scenario differs, so that the episodes say nothing about the driver.
    Changed,
    /// Was not driven now.
    OnlyBefore,
    /// Was not driven before.
    OnlyAfter,
}

/// An episode of one or of both runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ComparedEpisode {
    /// Its name in the later run, or in the only one.
    pub name: String,
    /// Name of the scenario.
    pub scenario: String,
    pub seed: u64,
    /// The values of the sweep.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, Value>,
    pub change: Change,
    /// How it ended before.
    pub before: Option<Side>,
    /// How it ended now.
    pub after: Option<Side>,
    /// Why the two are not compared.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub differs: Option<String>,
    /// Whether another pair was driven in the same way in both runs: then this pair is in no rate
    /// and no mean.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub duplicate: bool,
    /// The scores that differ: before and now.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub scores: BTreeMap<String, [Option<f64>; 2]>,
}

/// How an episode ended in a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Side {
    pub status: Status,
    /// The names of its faults, by time.
    pub faults: Vec<String>,
    /// Reason of its status, in words.
    pub why: Vec<String>,
}

/// Identity of an episode, by which two episodes are a pair.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Key {
    scenario: String,
    /// The values of the sweep as JSON.
    values: String,
    seed: u64,
}

/// An episode of one or of both runs.
pub(super) struct Pair<'a> {
    before: Option<&'a EpisodeEntry>,
    after: Option<&'a EpisodeEntry>,
}

impl Key {
    fn new(scenario: &str, values: &BTreeMap<String, Value>, seed: u64) -> Self {
        // A map with text keys: writing it into memory cannot fail.
        // As text, because JSON values have no order. A `BTreeMap` writes its keys in one order.
        let values = serde_json::to_string(values).unwrap_or_default();
        Self { scenario: scenario.to_owned(), values, seed }
    }

    fn from_entry(entry: &EpisodeEntry) -> Self {
        Self::new(&entry.scenario, &entry.values, entry.seed)
    }

    pub(super) fn from_case(case: &Case) -> Self {
        Self::new(&case.scenario, &written_values(&case.values), case.seed)
    }
}

/// The episodes of a run.
pub(super) fn by_key(run: &SuiteResult) -> Result<BTreeMap<Key, &EpisodeEntry>, CompareError> {
    let mut by_key: BTreeMap<Key, &EpisodeEntry> = BTreeMap::new();
    for entry in &run.episodes {
        // Two entries with one key would make the pair depend on their order.
        if let Some(other) = by_key.insert(Key::from_entry(entry), entry) {
            return Err(CompareError::Twice {
                scenario: entry.scenario.clone(),
                seed: entry.seed,
                names: format!("{}, {}", other.name, entry.name),
            });
        }
    }
    Ok(by_key)
}

/// All episodes of two runs, in order of their names.
pub(super) fn pairs<'a>(
    before: &'a SuiteResult,
    after: &'a SuiteResult,
) -> Result<Vec<Pair<'a>>, CompareError> {
    let before = by_key(before)?;
    let after = by_key(after)?;
    // A set of both, so that episodes of one run alone are listed too.
    let keys: BTreeSet<&Key> = before.keys().chain(after.keys()).collect();
    let pair =
        |key: &Key| Pair { before: before.get(key).copied(), after: after.get(key).copied() };
    let mut pairs: Vec<Pair<'a>> = keys.into_iter().map(pair).collect();
    pairs.sort_by_key(Pair::name);
    Ok(pairs)
}

impl<'a> Pair<'a> {
    fn name(&self) -> Option<&'a str> {
        // The name of the later run wins, since a reader looks for it there.
        self.after.or(self.before).map(|entry| &*entry.name)
    }

    /// Both episodes, if they can be compared.
    pub(super) fn comparable(&self) -> Option<(&'a EpisodeEntry, &'a EpisodeEntry)> {
        let both = self.before.zip(self.after);
        both.filter(|(before, after)| differs(before, after).is_none())
    }

    /// The pair as a part of a comparison.
    pub(super) fn episode(&self) -> ComparedEpisode {
        let any = self.after.or(self.before);
        let both = self.before.zip(self.after);
        let differs = both.and_then(|(before, after)| differs(before, after));
        // From what is missing over what differs to what changed.
        let change = match (both, &differs) {
            (None, _) if self.before.is_some() => Change::OnlyBefore,
            (None, _) => Change::OnlyAfter,
            (Some(_), Some(_)) => Change::Changed,
            (Some((before, after)), None) => change(before.status, after.status),
        };
        ComparedEpisode {
            name: any.map_or(String::new(), |entry| entry.name.clone()),
            scenario: any.map_or(String::new(), |entry| entry.scenario.clone()),
            seed: any.map_or(0, |entry| entry.seed),
            values: any.map_or(BTreeMap::new(), |entry| entry.values.clone()),
            change,
            before: self.before.map(Side::from_entry),
            after: self.after.map(Side::from_entry),
            differs,
            duplicate: false,
            scores: self.comparable().map_or(BTreeMap::new(), |(a, b)| differing_scores(a, b)),
        }
    }
}

/// Why an episode cannot be compared with the previous one of the same scenario and seed.
fn differs(before: &EpisodeEntry, after: &EpisodeEntry) -> Option<String> {
    let short = |hash: &str| hash.chars().take(8).collect::<String>();
    let [before_version, after_version] = [before, after].map(|entry| short(&entry.version_hash));
    // The twin first: a scenario that is resolved in another twin may differ for that reason.
    if before.version_hash != after.version_hash {
        return Some(format!(
            "the twin's version was {before_version} before and is {after_version} now"
        ));
    }
    let [before_hash, after_hash] = [before, after].map(|entry| short(&entry.scenario_hash));
    (before.scenario_hash != after.scenario_hash)
        .then(|| format!("the scenario was {before_hash} before and is {after_hash} now"))
}

fn change(before: Status, after: Status) -> Change {
    match (before, after) {
        (Status::Passed, Status::Passed) | (Status::Failed, Status::Failed) => Change::Same,
        // It is not known whether it still passes.
        (Status::Passed, _) => Change::Worse,
        (Status::Failed, Status::Passed) => Change::Better,
        // A lack of a verdict before, or after a failure, shows neither a loss nor a gain.
        _ => Change::Unknown,
    }
}

fn differing_scores(
    before: &EpisodeEntry,
    after: &EpisodeEntry,
) -> BTreeMap<String, [Option<f64>; 2]> {
    // Of both runs, so that a score of one run alone is listed with a missing value.
    let names: BTreeSet<&String> = before.scores.keys().chain(after.scores.keys()).collect();
    let value = |entry: &EpisodeEntry, name: &str| entry.scores.get(name)?.value;
    let both = names.into_iter().map(|name| (name, [value(before, name), value(after, name)]));
    both.filter(|(_, [before, after])| before != after)
        .map(|(name, both)| (name.clone(), both))
        .collect()
}

impl Side {
    fn from_entry(entry: &EpisodeEntry) -> Self {
        let mut why = entry.fault_texts();
        match entry.status {
            Status::NotJudged => why.extend(entry.not_judged.iter().cloned()),
            Status::Technical => why.extend(
                // The last attempt decided.
                entry.errors.last().map(|error| format!("{}: {}", error.kind, error.message)),
            ),
            _ => {}
        }
        let faults = entry.faults.iter().map(|fault| fault.fault.clone()).collect();
        Self { status: entry.status, faults, why }
    }

    /// The status and its reason.
    pub(super) fn text(&self) -> String {
        if self.why.is_empty() {
            self.status.name().to_owned()
        } else {
            format!("{}: {}", self.status.name(), self.why.join("; "))
        }
    }
}

impl ComparedEpisode {
    /// What its pictures are found by: its scenario, values and seed as JSON. Two pairs may share a
    /// name, which has the index of a sweep's values and not the values.
    pub(super) fn picture_key(&self) -> String {
        // A map with text keys: writing it into memory cannot fail.
        serde_json::to_string(&(&self.scenario, &self.values, self.seed)).unwrap_or_default()
    }

    /// The change, in words.
    pub(super) fn text(&self) -> String {
        match (&self.before, &self.after, &self.differs) {
            // A pair that is not compared has its reason and no change.
            (Some(_), Some(_), Some(differs)) => differs.clone(),
            (Some(before), Some(after), None) => {
                let after = after.text();
                format!("{} before, now {after}", before.status.name())
            }
            (Some(only), None, _) | (None, Some(only), _) => only.text(),
            (None, None, _) => String::new(),
        }
    }

    /// Whether it failed both times, for other reasons.
    pub(super) fn has_other_faults(&self) -> bool {
        let both = self.before.as_ref().zip(self.after.as_ref());
        self.change == Change::Same && both.is_some_and(|(a, b)| a.faults != b.faults)
    }
}

impl Change {
    /// The name in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Worse => "worse",
            Self::Better => "better",
            Self::Same => "same",
            Self::Unknown => "unknown",
            Self::Changed => "changed",
            Self::OnlyBefore => "only_before",
            Self::OnlyAfter => "only_after",
        }
    }
}
