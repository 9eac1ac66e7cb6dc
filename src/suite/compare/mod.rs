//! Compares two runs: which episodes and scores got worse, and whether the later run counts as
//! worse.
//!
//! Episodes are pairs by scenario, values of the sweep and seed. A pair is compared if both were
//! driven in the same version of the twin and in the same resolved scenario: otherwise a difference
//! says nothing about the driver.
//!
//! | module | what it does |
//! |---|---|
//! | `pair` | finds the pairs, and what changed in each |
//! | `scores` | the mean difference of each score over the pairs |
//! | `rule` | when a run counts as worse |
//! | `text`, `page`, `pictures` | the comparison for people |

mod page;
mod pair;
mod pictures;
mod rule;
mod scores;
mod text;

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use wildcity_render::Backend;
use wildcity_score::own;
use wildcity_twin::store::Catalog;

use crate::case::Case;
use crate::entry::{EpisodeEntry, Status};
use crate::picture::ComparedPictures;
use crate::result::SuiteResult;

pub use page::DrivenRun;
pub use pair::{Change, ComparedEpisode, Side};
pub use rule::{PASS_RATE, Rule, Tolerance};
pub use scores::{Direction, ScoreChange};

use pair::Key;

/// Comparison of a run with a previous run. The same two results give the same bytes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Name of the format: `wildcity.suite-comparison/1`.
    pub format: &'static str,
    /// Whether the later run is worse, by the rule.
    pub worse: bool,
    /// Why it is; empty if it is not.
    pub reasons: Vec<String>,
    /// Rule by which a run is worse.
    pub rule: Rule,
    /// Suite and agent of the previous run.
    pub before: RunName,
    /// Suite and agent of the later run.
    pub after: RunName,
    /// How many pairs changed how.
    pub counts: ChangeCounts,
    /// Passes of the pairs that the previous run has judged.
    pub pass_rate: PairedRate,
    /// The scores that both runs have.
    pub scores: BTreeMap<String, ScoreChange>,
    /// Scores that are not compared, in words, because only one run has them or their versions
    /// differ.
    pub scores_not_compared: Vec<String>,
    /// All episodes of both runs, by name.
    pub episodes: Vec<ComparedEpisode>,
}

/// Which run it was.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RunName {
    /// Name of the suite.
    pub suite: String,
    pub agent: String,
}

/// Number of episodes for each [`Change`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[expect(missing_docs, reason = "the names are those of Change")]
pub struct ChangeCounts {
    pub worse: u64,
    pub better: u64,
    pub same: u64,
    pub unknown: u64,
    pub changed: u64,
    pub only_before: u64,
    pub only_after: u64,
    /// Pairs that repeat another: they are counted above, and are in no rate and no mean.
    pub duplicates: u64,
}

/// Number of the same episodes that passed before, and that pass now. An episode that passed before
/// and has no verdict now does not pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct PairedRate {
    /// Pairs that the previous run has judged, without duplicates.
    pub pairs: u64,
    /// Of these, passed before.
    pub before: u64,
    /// Of these, passed now.
    pub after: u64,
}

/// Why two runs cannot be compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CompareError {
    /// No episode of one run can be compared with an episode of the other.
    #[error("the runs cannot be compared: {reason}")]
    NothingToCompare { reason: String },
    /// The steps are of different length.
    #[error(
        "the runs cannot be compared: steps took {before_us} µs before and take {after_us} µs now; run both suites with \
         one dt_us"
    )]
    StepLength { before_us: i64, after_us: i64 },
    /// The verdicts are by different rules.
    #[error(
        "the runs cannot be compared: verdicts were by {before} before and are by {after} now; run the driver of before \
         with this build"
    )]
    VerdictVersion {
        /// Name and version before.
        before: String,
        /// Name and version now.
        after: String,
    },
    /// The rule names a score that the runs do not have.
    #[error("--worse-by {name}: no such score; there is {}", known.join(", "))]
    UnknownScore {
        name: String,
        /// The existing names, with [`PASS_RATE`].
        known: Vec<String>,
    },
    /// The rule names a score that no pair has.
    #[error("--worse-by {name}: no pair of episodes has a value of it in both runs")]
    NoValue { name: String },
    /// A result has an episode twice.
    #[error("a result has two episodes of scenario {scenario:?} with seed {seed}: {names}")]
    Twice {
        scenario: String,
        seed: u64,
        /// The names of both.
        names: String,
    },
}

impl Comparison {
    /// The format of the file.
    pub const FORMAT: &str = "wildcity.suite-comparison/1";

    /// Compares a run with a previous run.
    ///
    /// # Errors
    /// [`CompareError`]: no episode can be compared, or the rule names a score that cannot.
    pub fn new(
        before: &SuiteResult,
        after: &SuiteResult,
        rule: &Rule,
    ) -> Result<Self, CompareError> {
        // What makes every comparison meaningless comes first.
        check_steps(before.dt_us, after.dt_us)?;
        check_verdicts(before, after)?;
        // Find the pairs, and those of them that are compared.
        let pairs = pair::pairs(before, after)?;
        // The pairs of drives so far, each by the first episode that was driven so in its run.
        let mut distinct = BTreeSet::new();
        let mut compared = Vec::new();
        let mut episodes = Vec::new();
        for pair in &pairs {
            let mut episode = pair.episode();
            // A pair that cannot be compared stays in the list, with its reason, but is in no rate.
            if let Some((before, after)) = pair.comparable() {
                let drives = (before.drive_name(), after.drive_name());
                episode.duplicate = !distinct.insert(drives);
                if !episode.duplicate {
                    compared.push((before, after));
                }
            }
            episodes.push(episode);
        }
        // No comparison at all must not look like one without a loss.
        if compared.is_empty() {
            return Err(CompareError::NothingToCompare { reason: why_nothing(&episodes) });
        }
        // Apply the rule.
        let pass_rate = PairedRate::from_pairs(&compared);
        let scores = scores::changes(&compared);
        // Names are resolved now, since only the compared pairs say which scores there are.
        let rule = rule.resolved(&scores.keys().map(String::as_str).collect::<Vec<_>>())?;
        let reasons = rule.reasons(&episodes, pass_rate, &scores)?;
        Ok(Self {
            format: Self::FORMAT,
            worse: !reasons.is_empty(),
            reasons,
            rule,
            before: RunName::from_result(before),
            after: RunName::from_result(after),
            counts: counts(&episodes),
            pass_rate,
            scores,
            scores_not_compared: scores::not_compared(&[before, after].map(scores::names)),
            episodes,
        })
    }

    /// Checks, before anything is driven, that a run of these cases can be compared with a previous
    /// run.
    ///
    /// # Errors
    /// As for [`Comparison::new`].
    pub fn check(before: &SuiteResult, cases: &[Case], rule: &Rule) -> Result<(), CompareError> {
        // The step is the same for all cases of a suite.
        let dt_us = cases.first().and_then(|case| case.options.dt_us);
        check_steps(before.dt_us, dt_us)?;
        // The names of the previous run: those of the next one do not exist yet.
        let names = scores::names(before);
        rule.resolved(&names.iter().copied().collect::<Vec<_>>())?;
        let by_key = pair::by_key(before)?;
        let is_there = |case: &&Case| by_key.contains_key(&Key::from_case(case));
        let there: Vec<&Case> = cases.iter().filter(is_there).collect();
        let is_alike = |case: &&&Case| {
            // `there` has only cases with a key in the map, so the index does not fail.
            let entry = by_key[&Key::from_case(case)];
            entry.version_hash == case.version_hash && entry.scenario_hash == case.line.hash
        };
        // One comparable episode is enough to start; the others are reported as changed.
        match there.iter().find(is_alike) {
            Some(_) => Ok(()),
            None => Err(CompareError::NothingToCompare {
                reason: match there.len() {
                    0 => "no episode of the suite was driven before".to_owned(),
                    count => format!(
                        "{count} episodes were driven before, all in other versions of the twins or of the scenarios"
                    ),
                },
            }),
        }
    }

    /// Whether it is worse, and why, in one line.
    pub fn conclusion(&self) -> String {
        if self.worse {
            format!("worse than before: {}", self.reasons.join("; "))
        } else {
            format!("not worse than before: {}", self.rule.kept(self.pass_rate))
        }
    }

    /// The comparison as JSON.
    pub fn to_json(&self) -> String {
        // Numbers, texts and maps with text keys: writing them into memory cannot fail.
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }

    /// The comparison as text for a terminal.
    pub fn to_text(&self) -> String {
        text::text(self)
    }

    /// The comparison as a page that loads nothing else. `runs` are the earlier and the later run:
    /// the drives of the episodes that changed are drawn from their records, side by side, below
    /// their pictures.
    pub fn to_page(&self, runs: &[DrivenRun<'_>; 2], pictures: &ComparedPictures) -> String {
        page::page(self, runs, pictures)
    }

    /// Pictures of the episodes that the page shows, rendered again from the records of both runs.
    pub fn pictures(
        &self,
        runs: &[DrivenRun<'_>; 2],
        catalog: &Catalog,
        backend: &dyn Backend,
    ) -> ComparedPictures {
        pictures::compared_pictures(&page::shown(self), runs, catalog, backend)
    }
}

impl RunName {
    fn from_result(run: &SuiteResult) -> Self {
        Self { suite: run.suite.clone(), agent: run.agent.clone() }
    }
}

impl PairedRate {
    /// The rate of the pairs that are compared.
    fn from_pairs(compared: &[(&EpisodeEntry, &EpisodeEntry)]) -> Self {
        // By the previous run alone: an episode that lost its verdict counts as not passed.
        let judged = compared.iter().filter(|(before, _)| before.status.is_judged());
        let passes = |entry: &EpisodeEntry| u64::from(entry.status == Status::Passed);
        let none = Self { pairs: 0, before: 0, after: 0 };
        judged.fold(none, |rate, (before, after)| Self {
            pairs: rate.pairs + 1,
            before: rate.before + passes(before),
            after: rate.after + passes(after),
        })
    }
}

fn check_steps(before_us: Option<i64>, after_us: Option<i64>) -> Result<(), CompareError> {
    match (before_us, after_us) {
        (Some(before_us), Some(after_us)) if before_us != after_us => {
            Err(CompareError::StepLength { before_us, after_us })
        }
        // A result of an older build has no step; it is taken as equal.
        _ => Ok(()),
    }
}

/// Refuses verdicts of two versions, because a difference could be caused by the rules.
fn check_verdicts(before: &SuiteResult, after: &SuiteResult) -> Result<(), CompareError> {
    let versions = |run: &SuiteResult| -> Vec<String> {
        let names = scores::names(run).into_iter();
        let of_verdict = |name: &&str| scores::base(name) == scores::base(own::NAME);
        names.filter(of_verdict).map(str::to_owned).collect()
    };
    let before = versions(before);
    let after = versions(after);
    // A run of which nothing was driven has no verdicts to differ.
    if before == after || before.is_empty() || after.is_empty() {
        return Ok(());
    }
    Err(CompareError::VerdictVersion { before: before.join(", "), after: after.join(", ") })
}

fn counts(episodes: &[ComparedEpisode]) -> ChangeCounts {
    let mut counts = ChangeCounts::default();
    for episode in episodes {
        let count = match episode.change {
            Change::Worse => &mut counts.worse,
            Change::Better => &mut counts.better,
            Change::Same => &mut counts.same,
            Change::Unknown => &mut counts.unknown,
            Change::Changed => &mut counts.changed,
            Change::OnlyBefore => &mut counts.only_before,
            Change::OnlyAfter => &mut counts.only_after,
        };
        *count += 1;
        counts.duplicates += u64::from(episode.duplicate);
    }
    counts
}

/// Why no pair is compared.
fn why_nothing(episodes: &[ComparedEpisode]) -> String {
    let changed = episodes.iter().find(|episode| episode.change == Change::Changed);
    match changed {
        Some(episode) => format!(
            "every pair differs in its twin or scenario; of {}, {}",
            episode.name,
            episode.differs.as_deref().unwrap_or_default()
        ),
        None => "no episode is in both runs".to_owned(),
    }
}
