//! A comparison as a page.

use std::path::PathBuf;

use maud::{Markup, PreEscaped, html};

use crate::entry::EpisodeEntry;
use crate::html::{SCORE_NAMES, capitalized, document, image};
use crate::limits;
use crate::picture::{ComparedPictures, Picture};
use crate::plot::plots;
use crate::result::SuiteResult;

use super::pair::Side;
use super::text::{alike_text, has_changed, interval, is_alike, notes};
use super::{Change, ComparedEpisode, Comparison, RunName, ScoreChange};

/// A run, and the folder of its records, from which its drives are drawn.
#[derive(Clone, Debug)]
pub struct DrivenRun<'a> {
    pub result: &'a SuiteResult,
    pub episodes: PathBuf,
}

impl DrivenRun<'_> {
    /// The entry of an episode of the comparison.
    pub(crate) fn entry(&self, of: &ComparedEpisode) -> Option<&EpisodeEntry> {
        let is_it = |entry: &&EpisodeEntry| {
            (&entry.scenario, entry.seed, &entry.values) == (&of.scenario, of.seed, &of.values)
        };
        self.result.episodes.iter().find(is_it)
    }

    /// The drive of an episode as SVG; `None` if its record is not there.
    fn plots(&self, of: &ComparedEpisode) -> Option<String> {
        plots(self.entry(of)?, &self.episodes)
    }
}

/// The page; `runs` are the earlier and the later run.
pub(super) fn page(
    comparison: &Comparison,
    runs: &[DrivenRun<'_>; 2],
    pictures: &ComparedPictures,
) -> String {
    let name = |run: &RunName| format!("{}: {}", run.suite, run.agent);
    let title = format!("{} against {}", name(&comparison.after), name(&comparison.before));
    let counts = &comparison.counts;
    let class = if comparison.worse { "worse" } else { "better" };
    let body = html! {
        p class=(format!("verdict {class}")) { (capitalized(&comparison.conclusion())) "." }
        p {
            (counts.worse) " worse, " (counts.better) " better, " (counts.same) " as before, "
            (counts.unknown) " without a verdict. " (comparison.pass_rate.text()) "."
        }
        @if counts.changed > 0 { p { "Pairs that are not compared, because their twin or scenario differs: " (counts.changed) "." } }
        @if counts.duplicates > 0 { p { "Pairs with the same drives as an earlier seed of their scenario, not counted again in rates and means: " (counts.duplicates) "." } }
        h2 { "Episodes that changed" }
        (episodes(comparison))
        (drives(comparison, runs, pictures))
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
                    td data-name="seed" { (episode.seed) }
                    td class=(episode.change.name()) { (change_text(episode)) }
                    td.text { (episode.text()) }
                }
            }
        } }
        p { "Episodes with the verdict that they had before: " (comparison.counts.same) "." }
    }
}

/// What changed, in words.
fn change_text(episode: &ComparedEpisode) -> String {
    // Such an episode would be listed as changed and called the same.
    if episode.has_other_faults() {
        return "other fault".to_owned();
    }
    episode.change.name().replace('_', " ")
}

/// The episodes whose drives are shown: those that changed, the worse ones first. Not a second seed
/// with the same drives: it would have the same pictures.
pub(super) fn shown(comparison: &Comparison) -> Vec<&ComparedEpisode> {
    let mut shown = changed(comparison);
    shown.retain(|one| !one.duplicate);
    shown.sort_by_key(|one| one.change != Change::Worse);
    shown.truncate(limits::WORST);
    shown
}

/// The drives of the episodes that changed, before and now side by side, with a picture of each.
fn drives(
    comparison: &Comparison,
    runs: &[DrivenRun<'_>; 2],
    pictures: &ComparedPictures,
) -> Markup {
    html! {
        @for episode in shown(comparison) {
            h3 { (episode.name) }
            div.beside {
                @let [before, now] = pictures.get(&episode.picture_key()).map_or([None; 2], |both| both.each_ref().map(Some));
                (side("before", episode, episode.before.as_ref(), &runs[0], before))
                (side("now", episode, episode.after.as_ref(), &runs[1], now))
            }
        }
    }
}

fn side(
    when: &str,
    episode: &ComparedEpisode,
    side: Option<&Side>,
    run: &DrivenRun<'_>,
    picture: Option<&Result<Picture, String>>,
) -> Markup {
    html! {
        div {
            @match side {
                Some(side) => {
                    p { b { (when) } ": " span class=(side.status.name()) { (side.text()) } }
                    @match picture {
                        Some(Ok(picture)) => (shot(picture)),
                        Some(Err(reason)) => p.unknown { "No picture: " (reason) "." },
                        None => {}
                    }
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

/// A picture with its camera and time.
fn shot(picture: &Picture) -> Markup {
    let time_s = picture.time_us as f64 * 1e-6;
    let text = format!("{} after {time_s:.1} s", picture.camera);
    html! { figure { (image(picture, &text)) } }
}

fn scores(comparison: &Comparison) -> Markup {
    let changed = comparison.scores.iter().filter(|(_, score)| has_changed(score));
    let alike = comparison.scores.values().filter(|score| is_alike(score)).count();
    html! {
        table {
            tr { th { "score" } th { "pairs" } th { "before" } th { "now" } th { "difference" } th { "95 %" } th { "the interval says" } }
            @for (name, score) in changed { (score_row(name, score)) }
        }
        @if alike > 0 { p { (alike_text(alike)) "." } }
        @for line in &comparison.scores_not_compared { p { "Score not compared: " (line) "." } }
        p { "Means over the pairs with a value in both runs. Intervals: Student's t of the differences; none below three pairs. " (SCORE_NAMES) }
    }
}

fn score_row(name: &str, score: &ScoreChange) -> Markup {
    let number = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.4}"));
    html! {
        tr {
            td.score { (name) }
            td data-name="pairs" { (score.pairs) }
            td data-name="before" { (number(score.before)) }
            td data-name="now" { (number(score.after)) }
            td data-name="difference" { (score.difference.map_or(String::new(), |value| format!("{value:+.4}"))) }
            td data-name="95 %" { (interval(score)) }
            td class=(format!("text {}", score.direction.name())) { (notes(score)) }
        }
    }
}
