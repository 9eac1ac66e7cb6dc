//! The rule by which a run is worse than the previous one.

use std::collections::BTreeMap;
use std::str::FromStr;

use serde::Serialize;

use super::scores::base;
use super::{Change, CompareError, ComparedEpisode, PairedRate, ScoreChange};

/// The name of the pass rate in a rule.
pub const PASS_RATE: &str = "pass_rate";

/// Sums of the same values differ by less, whatever their order.
const ROUNDING: f64 = 1e-9;

/// Largest number of episodes that a reason names.
const NAMED: usize = 5;

/// When a run is worse: by default, if any episode passed before and does not pass now.
///
/// A tolerance of [`PASS_RATE`] replaces this by the pass rate over all pairs, for drivers that are
/// not deterministic. A tolerance of a score adds this score; by default, scores do not count.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Rule {
    /// By how much each may be worse on average, in its own unit.
    pub worse_by: BTreeMap<String, f64>,
}

/// A tolerance of one score, written `NAME=AMOUNT`.
#[derive(Clone, Debug, PartialEq)]
pub struct Tolerance {
    /// [`PASS_RATE`], or the name of a score, with or without its version.
    pub name: String,
    /// By how much it may be worse.
    pub amount: f64,
}

impl FromStr for Tolerance {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = "expected NAME=AMOUNT, for example pass_rate=0.05";
        let (name, amount) = text.split_once('=').ok_or(expected)?;
        let amount: f64 =
            amount.parse().map_err(|_| format!("{amount:?} is not a number; {expected}"))?;
        // NaN is not finite, and a negative tolerance would demand a gain.
        if name.is_empty() || !amount.is_finite() || amount < 0.0 {
            Err(format!("an amount is 0 or more; {expected}"))
        } else {
            Ok(Self { name: name.to_owned(), amount })
        }
    }
}

impl FromIterator<Tolerance> for Rule {
    fn from_iter<T: IntoIterator<Item = Tolerance>>(tolerances: T) -> Self {
        let pairs = tolerances.into_iter().map(|tolerance| (tolerance.name, tolerance.amount));
        Self { worse_by: pairs.collect() }
    }
}

impl Rule {
    /// The rule with the full names of its scores, which must be among `known`.
    pub(super) fn resolved(&self, known: &[&str]) -> Result<Self, CompareError> {
        let full = |name: &str| {
            // The full name first or the name without a version: a rule outlives versions.
            let found = known
                .iter()
                .find(|full| **full == name || base(full) == name)
                .copied()
                .or((name == PASS_RATE).then_some(PASS_RATE));
            found.map(str::to_owned).ok_or_else(|| CompareError::UnknownScore {
                name: name.to_owned(),
                known: [PASS_RATE].iter().chain(known).map(|&name| name.to_owned()).collect(),
            })
        };
        let names = self.worse_by.iter().map(|(name, amount)| Ok((full(name)?, *amount)));
        Ok(Self { worse_by: names.collect::<Result<_, _>>()? })
    }

    /// Why a run is worse; nothing if it is not.
    pub(super) fn reasons(
        &self,
        episodes: &[ComparedEpisode],
        rate: PairedRate,
        scores: &BTreeMap<String, ScoreChange>,
    ) -> Result<Vec<String>, CompareError> {
        let mut reasons = Vec::new();
        // A tolerance of the rate replaces the rule about single episodes.
        match self.worse_by.get(PASS_RATE) {
            None => reasons.extend(lost_passes(episodes)),
            Some(&most) => {
                // Use one division, so that 10 of 10 and 9 of 10 differ by exactly the value of
                // "0.1".
                let lost = rate.before as f64 - rate.after as f64;
                // Without pairs the fall is 0 / 1.
                let fall = lost / rate.pairs.max(1) as f64;
                if fall > most {
                    reasons.push(format!("{}, which is more than {most} lower", rate.text()));
                }
            }
        }
        for (name, &most) in self.worse_by.iter().filter(|(name, _)| *name != PASS_RATE) {
            let no_value = || CompareError::NoValue { name: name.clone() };
            let loss = scores.get(name).and_then(ScoreChange::loss).ok_or_else(no_value)?;
            // Means are sums in floating point, hence the margin. A tolerance of 0 must accept
            // equal values.
            if loss > most + ROUNDING {
                reasons.push(format!("{name} is worse by {loss:.4} on average, more than {most}"));
            }
        }
        Ok(reasons)
    }

    /// The criteria that a run that is not worse has met.
    pub(super) fn kept(&self, rate: PairedRate) -> String {
        let mut kept = vec![match self.worse_by.get(PASS_RATE) {
            None => "every episode that passed before passes now".to_owned(),
            Some(most) => format!("{}, which is at most {most} lower", rate.text()),
        }];
        let scores = self.worse_by.iter().filter(|(name, _)| *name != PASS_RATE);
        kept.extend(scores.map(|(name, most)| format!("{name} is worse by at most {most}")));
        kept.join("; ")
    }
}

/// The episodes that passed before and do not pass now.
fn lost_passes(episodes: &[ComparedEpisode]) -> Option<String> {
    let worse = episodes.iter().filter(|episode| episode.change == Change::Worse);
    let names: Vec<&str> = worse.map(|episode| &*episode.name).collect();
    let what = match names.len() {
        // No text at all, which makes the run not worse.
        0 => return None,
        1 => "1 episode that passed before does not pass now".to_owned(),
        count => format!("{count} episodes that passed before do not pass now"),
    };
    let more = if names.len() > NAMED { ", .." } else { "" };
    Some(format!("{what} ({}{more})", names[..names.len().min(NAMED)].join(", ")))
}

impl PairedRate {
    /// Both rates, in words.
    pub(super) fn text(&self) -> String {
        let Self { pairs, before, after } = self;
        format!("{before} of {pairs} episodes passed before, and {after} now")
    }
}
