//! A comparison as a page.

use std::path::PathBuf;

use maud::{Markup, PreEscaped, html};

use crate::entry::EpisodeEntry;
use crate::html::document;
use crate::limits;
use crate::plot::plots;
use crate::result::SuiteResult;

use super::pair::Side;
use super::text::{has_changed, interval, is_alike, notes};
use super::{Change, ComparedEpisode, Comparison, RunName, ScoreChange};

/// A run, and the folder of its records, from which its drives are drawn.
#[derive(Clone, Debug)]
pub struct DrivenRun<'a> {
    pub result: &'a SuiteResult,
    pub episodes: PathBuf,
}

impl DrivenRun<'_> {
    /// The drive of an episode as SVG; `None` if its record is not there.
    fn plots(&self, of: &ComparedEpisode) -> Option<String> {
        let is_it = |entry: &&EpisodeEntry| {
            (&entry.scenario, entry.seed, &entry.values) == (&of.scenario, of.seed, &of.values)
        };
        plots(self.result.episodes.iter().find(is_it)?, &self.episodes)
    }
}

/// The page; `runs` are the earlier and the later run.
pub(super) fn page(comparison: &Comparison, runs: &[DrivenRun<'_>; 2]) -> String {
    let name = |run: &RunName| format!("{}: {}", run.suite, run.agent);
    let title = format!("{} against {}", name(&comparison.after), name(&comparison.before));
    let counts = &comparison.counts;
    let class = if comparison.worse { "worse" } else { "better" };
    let body = html! {
        p class=(format!("verdict {class}")) { (comparison.conclusion()) "." }
        p {
            (counts.worse) " worse, " (counts.better) " better, " (counts.same) " as before, "
            (counts.unknown) " without a verdict. " (comparison.pass_rate.text()) "."
        }
        @if counts.changed > 0 { p { (counts.changed) " pairs are not compared: their twin or scenario differs." } }
        @if counts.duplicates > 0 { p { (counts.duplicates) " pairs repeat another one, and are in no rate and no mean." } }
        h2 { "Episodes that changed" }
        (episodes(comparison))
        (drives(comparison, runs))
        h2 { "Scores" }
        (scores(comparison))
    };
    document(&title, &body)
}

/// The episodes that changed. Those with the same verdict are shown only if they failed in another
/// way.
fn changed(comparison: &Comparison) -> Vec<&ComparedEpisode> {
    let is_shown = |one: &&ComparedEpisode| one.change != Change::Same || one.has_other_faults();
    comparison.episodes.iter().filter(is_shown).collect()
}

fn episodes(comparison: &Comparison) -> Markup {
    let changed = changed(comparison);
    html! {
        @if !changed.is_empty() { table {
            tr { th { "episode" } th { "seed" } th { "change" } th { "how" } }
            @for episode in &changed {
                tr {
                    td { (episode.name) }
                    td { (episode.seed) }
                    td class=(episode.change.name()) { (episode.change.name().replace('_', " ")) }
                    td { (episode.text()) }
                }
            }
        } }
        p { (comparison.counts.same) " episodes have the verdict that they had before." }
    }
}

/// The drives of the episodes that changed, before and now side by side: the worse ones first.
fn drives(comparison: &Comparison, runs: &[DrivenRun<'_>; 2]) -> Markup {
    let mut shown = changed(comparison);
    shown.sort_by_key(|one| one.change != Change::Worse);
    shown.truncate(limits::WORST);
    html! {
        @for episode in shown {
            h3 { (episode.name) }
            div.beside {
                (side("before", episode, episode.before.as_ref(), &runs[0]))
                (side("now", episode, episode.after.as_ref(), &runs[1]))
            }
        }
    }
}

fn side(when: &str, episode: &ComparedEpisode, side: Option<&Side>, run: &DrivenRun<'_>) -> Markup {
    html! {
        div {
            @match side {
                Some(side) => {
                    p { b { (when) } ": " span class=(side.status.name()) { (side.text()) } }
                    @match run.plots(episode) {
                        Some(plots) => (PreEscaped(plots)),
                        None => p.unknown { "No record in " (run.episodes.display()) "." },
                    }
                }
                None => p { b { (when) } ": not driven" },
            }
        }
    }
}

fn scores(comparison: &Comparison) -> Markup {
    let changed = comparison.scores.iter().filter(|(_, score)| has_changed(score));
    let alike = comparison.scores.values().filter(|score| is_alike(score)).count();
    html! {
        table {
            tr { th { "score" } th { "pairs" } th { "before" } th { "now" } th { "difference" } th { "95 %" } th { "the interval says" } }
            @for (name, score) in changed { (score_row(name, score)) }
        }
        p { (alike) " scores have the same value in every pair." }
        @for line in &comparison.scores_not_compared { p { "Score not compared: " (line) "." } }
        p { "Means over the pairs with a value in both runs. Intervals: Student's t of the differences; none below three pairs." }
    }
}

fn score_row(name: &str, score: &ScoreChange) -> Markup {
    let number = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.4}"));
    html! {
        tr {
            td { (name) }
            td { (score.pairs) }
            td { (number(score.before)) }
            td { (number(score.after)) }
            td { (score.difference.map_or(String::new(), |value| format!("{value:+.4}"))) }
            td { (interval(score)) }
            td class=(score.direction.name()) { (notes(score)) }
        }
    }
}
