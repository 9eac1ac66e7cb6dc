//! A comparison as a page.

use maud::{Markup, html};

use crate::html::document;

use super::text::{has_changed, interval, is_alike, notes};
use super::{Change, ComparedEpisode, Comparison, RunName, ScoreChange};

pub(super) fn page(comparison: &Comparison) -> String {
    let name = |run: &RunName| format!("{}: {}", run.suite, run.agent);
    let title = format!("{} against {}", name(&comparison.after), name(&comparison.before));
    let counts = &comparison.counts;
    let class = if comparison.worse { "worse" } else { "better" };
    let body = html! {
        p class=(class) { (comparison.conclusion()) "." }
        p {
            (counts.worse) " worse, " (counts.better) " better, " (counts.same) " as before, "
            (counts.unknown) " without a verdict. " (comparison.pass_rate.text()) "."
        }
        @if counts.changed > 0 { p { (counts.changed) " pairs are not compared: their twin or scenario differs." } }
        @if counts.duplicates > 0 { p { (counts.duplicates) " pairs repeat another one, and are in no rate and no mean." } }
        h2 { "Episodes that changed" }
        (episodes(comparison))
        h2 { "Scores" }
        (scores(comparison))
    };
    document(&title, &body)
}

fn episodes(comparison: &Comparison) -> Markup {
    // Episodes with the same verdict are shown only if they failed in another way.
    let is_shown = |one: &&ComparedEpisode| one.change != Change::Same || one.has_other_faults();
    let changed: Vec<&ComparedEpisode> = comparison.episodes.iter().filter(is_shown).collect();
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
