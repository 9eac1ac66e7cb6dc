//! The mean difference of each score over the pairs.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use wildcity_score::statistics::Mean;
use wildcity_score::{lower_is_better, score_range};

use crate::entry::EpisodeEntry;
use crate::result::SuiteResult;

/// Change of a score.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ScoreChange {
    /// Pairs with a value before and now, without duplicates.
    pub pairs: u64,
    /// Mean of their values before.
    pub before: Option<f64>,
    /// Mean of their values now.
    pub after: Option<f64>,
    /// Mean of the differences, now less before.
    pub difference: Option<f64>,
    /// The ends of its 95 % interval: Student's t over the pairs, within the range of the score;
    /// null for fewer than three pairs.
    pub interval: Option<[f64; 2]>,
    /// Whether lower values are better.
    pub lower_is_better: bool,
    /// Conclusion from the interval.
    pub direction: Direction,
    /// Pairs with a value before and none now.
    pub only_before: u64,
    /// Pairs with a value now and none before.
    pub only_after: u64,
}

/// Conclusion from the interval of a mean difference.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// Every value is as before.
    Same,
    /// The whole interval is on the worse side of zero.
    Worse,
    /// The whole interval is on the better side of zero.
    Better,
    /// The interval contains zero, or there are too few pairs for one.
    Unclear,
}

/// A name without its version: `alpasim.scene` of `alpasim.scene@3032e0c`.
pub(super) fn base(name: &str) -> &str {
    name.split_once('@').map_or(name, |(base, _)| base)
}

/// The names of all scores of a run.
pub(super) fn names(run: &SuiteResult) -> BTreeSet<&str> {
    run.episodes.iter().flat_map(|episode| episode.scores.keys().map(String::as_str)).collect()
}

/// Scores that only one run has, in words.
pub(super) fn not_compared([before, after]: &[BTreeSet<&str>; 2]) -> Vec<String> {
    let mut texts = Vec::new();
    // A run of which nothing was driven has no scores at all.
    if before.is_empty() || after.is_empty() {
        return texts;
    }
    for name in before.difference(after) {
        texts.push(match after.iter().find(|other| base(other) == base(name)) {
            Some(other) => format!("{name} before, {other} now"),
            None => format!("{name} before alone"),
        });
    }
    // Two versions of one score were told as one line above.
    let is_told = |name: &str| before.iter().any(|other| base(other) == base(name));
    let new = after.difference(before).filter(|name| !is_told(name));
    texts.extend(new.map(|name| format!("{name} now alone")));
    texts
}

/// The change of each score that some pair has.
pub(super) fn changes(pairs: &[(&EpisodeEntry, &EpisodeEntry)]) -> BTreeMap<String, ScoreChange> {
    let of_pair = |(before, after): &(&EpisodeEntry, &EpisodeEntry)| {
        // In both runs: a score of one alone is told elsewhere.
        let both = before.scores.keys().filter(|name| after.scores.contains_key(*name));
        both.cloned().collect::<Vec<String>>()
    };
    let names: BTreeSet<String> = pairs.iter().flat_map(of_pair).collect();
    names.into_iter().map(|name| (name.clone(), ScoreChange::new(&name, pairs))).collect()
}

impl ScoreChange {
    fn new(name: &str, pairs: &[(&EpisodeEntry, &EpisodeEntry)]) -> Self {
        let mut before = Vec::new();
        let mut after = Vec::new();
        let mut only = [0, 0];
        for pair in pairs {
            // Absent and without a value are alike: neither can be compared.
            let value = |entry: &EpisodeEntry| entry.scores.get(name).and_then(|score| score.value);
            match (value(pair.0), value(pair.1)) {
                (Some(old), Some(new)) => {
                    before.push(old);
                    after.push(new);
                }
                (Some(_), None) => only[0] += 1,
                (None, Some(_)) => only[1] += 1,
                (None, None) => {}
            }
        }
        let differences: Vec<f64> = before.iter().zip(&after).map(|(old, new)| new - old).collect();
        let mean = Mean::from_values(&differences);
        let [least, most] = score_range(name);
        // A difference of two values within [least, most] lies within ± (most - least).
        let interval = mean.and_then(|mean| mean.interval([least - most, most - least]));
        let lower_is_better = lower_is_better(name);
        let is_same = differences.iter().all(|difference| *difference == 0.0);
        let direction = match interval {
            // Before the interval, because equal values have an interval without a width, or none.
            _ if is_same && !differences.is_empty() => Direction::Same,
            // All of it above zero: the score has risen.
            Some([low, _]) if low > 0.0 => direction(!lower_is_better),
            Some([_, high]) if high < 0.0 => direction(lower_is_better),
            _ => Direction::Unclear,
        };
        Self {
            pairs: differences.len() as u64,
            before: Mean::from_values(&before).map(|mean| mean.mean),
            after: Mean::from_values(&after).map(|mean| mean.mean),
            difference: mean.map(|mean| mean.mean),
            interval,
            lower_is_better,
            direction,
            only_before: only[0],
            only_after: only[1],
        }
    }

    /// By how much it got worse on average; negative if it got better.
    pub(super) fn loss(&self) -> Option<f64> {
        self.difference.map(|rise| if self.lower_is_better { rise } else { -rise })
    }
}

fn direction(is_better: bool) -> Direction {
    if is_better { Direction::Better } else { Direction::Worse }
}

impl Direction {
    /// The name in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Same => "same",
            Self::Worse => "worse",
            Self::Better => "better",
            Self::Unclear => "unclear",
        }
    }
}
