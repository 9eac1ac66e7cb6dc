//! `report.html`: one page that loads nothing else.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use maud::{Markup, PreEscaped, html};

use crate::ending::{Ending, ExitCode};
use crate::entry::{EpisodeEntry, LEFT, Status, TechnicalEntry};
use crate::html::{SCORE_NAMES, document, image, percent};
use crate::picture::Picture;
use crate::plot::plots;
use crate::result::{MeanEntry, Rate, SuiteResult};

/// The page. `episodes` has the records, of which the worst are drawn.
pub fn page(
    result: &SuiteResult,
    ending: &Ending,
    pictures: &[Picture],
    episodes: &Path,
) -> String {
    let title = format!("{}: {}", result.suite, result.agent);
    let body = html! {
        (verdict(ending))
        (worst(result, pictures, episodes))
        h2 { "Run" }
        (outcome(result, ending))
        (unjudged(result))
        h2 { "Scenarios" }
        (scenarios(result))
        h2 { "Scores" }
        (means(result))
        h2 { "Episodes" }
        (table(result))
    };
    document(&title, &body)
}

/// The answer to the question that the page is opened for.
fn verdict(ending: &Ending) -> Markup {
    let passed = ending.code == ExitCode::Passed;
    let kind = match ending.code {
        ExitCode::Passed => "passed",
        ExitCode::Driving | ExitCode::NotVerified | ExitCode::Usage => "failed",
        ExitCode::Technical => "technical",
        ExitCode::NotJudged => "not_judged",
    };
    html! {
        p class=(format!("verdict {kind}")) {
            b { @if passed { "Passed" } @else { "Not passed" } } ": " (ending.why) ". Exit code "
            (ending.code as u8) "."
        }
    }
}

fn outcome(result: &SuiteResult, ending: &Ending) -> Markup {
    let counts = result.counts.to_string();
    html! {
        // The verdict begins with them, unless it is about something else.
        @if !ending.why.starts_with(&counts) {
            p { (counts) "." }
        }
        p { "Pass rate: " (rate(&result.pass_rate)) "." }
        @if let Some(text) = result.duplicates_text() { p { "Note: " (text) "." } }
        @if result.latest { p { "Run on the latest versions of the twins, whatever the scenarios name." } }
    }
}

/// Episodes without a verdict, with the reasons: they come first, since a run with them says less
/// than it seems to.
fn unjudged(result: &SuiteResult) -> Markup {
    let is_unjudged =
        |episode: &&EpisodeEntry| matches!(episode.status, Status::NotJudged | Status::OffModel);
    let episodes: Vec<&EpisodeEntry> = result.episodes.iter().filter(is_unjudged).collect();
    html! {
        @if !episodes.is_empty() {
            h2 { "Without a verdict" }
            p { "These episodes neither passed nor failed." }
            table {
                tr { th { "episode" } th { "result" } th { "why" } }
                @for episode in episodes {
                    tr {
                        td { (episode.name) }
                        td class=(episode.status.name()) { (episode.status.name().replace('_', " ")) }
                        td.text { (why(episode)) }
                    }
                }
            }
        }
    }
}

fn rate(rate: &Rate) -> String {
    match rate.rate {
        Some(share) => format!("{}: {}", percent(share), rate.text()),
        None => rate.text(),
    }
}

fn scenarios(result: &SuiteResult) -> Markup {
    html! {
        table {
            tr { th { "scenario" } th { "pass rate" } th { "not judged" } }
            @for (name, of) in &result.scenarios {
                tr {
                    td { (name) }
                    td { (rate(of)) }
                    td data-name="not judged" { (not_judged(result, name).join("; ")) }
                }
            }
        }
    }
}

/// Criteria that were not judged in some episode of a scenario.
fn not_judged<'a>(result: &'a SuiteResult, scenario: &str) -> Vec<&'a str> {
    let of_scenario = result.episodes.iter().filter(|episode| episode.scenario == scenario);
    let reasons = of_scenario.flat_map(|episode| episode.not_judged.iter().map(String::as_str));
    // A set, because the same reason comes from every seed.
    reasons.collect::<BTreeSet<&str>>().into_iter().collect()
}

fn means(result: &SuiteResult) -> Markup {
    html! {
        table {
            tr { th { "score" } th { "mean over scenarios" } th { "95 %" } th { "scenarios" } }
            @for (name, mean) in &result.means {
                tr {
                    td.score { (name) }
                    td data-name="mean" { (format!("{:.4}", mean.mean)) }
                    td data-name="95 %" { (mean_interval(mean)) }
                    td data-name="scenarios" { (mean.scenarios) }
                }
            }
            @for (name, reason) in without_value(result) {
                tr { td.score { (name) } td colspan="3" { "none: " (reason) } }
            }
        }
        p { "Intervals of means: Student's t over the scenarios, clipped to the range of the score; none below three. " (SCORE_NAMES) }
    }
}

fn mean_interval(mean: &MeanEntry) -> String {
    match mean.interval {
        Some([low, high]) => format!("{low:.4} to {high:.4}"),
        None => "too few scenarios".to_owned(),
    }
}

/// Scores that no episode has a value of, and the reason that the first episode gives.
fn without_value(result: &SuiteResult) -> BTreeMap<&str, &str> {
    let all = result.episodes.iter().flat_map(|episode| &episode.scores);
    let missing = all.filter(|(name, _)| !result.means.contains_key(*name));
    let mut reasons = BTreeMap::new();
    for (name, score) in missing {
        reasons.entry(&**name).or_insert(score.reason.as_deref().unwrap_or("unknown"));
    }
    reasons
}

fn worst(result: &SuiteResult, pictures: &[Picture], episodes: &Path) -> Markup {
    let worst = result.worst();
    html! {
        @if !worst.is_empty() {
            h2 { "Worst episodes" }
            p {
                "To see them again: " code { "wildcity serve --episodes " (shown(episodes)) }
                ", then a name below opens the episode in the viewer."
            }
            @for episode in worst {
                figure {
                    figcaption { b { (viewer_link(episode)) } ": " (episode.fault_texts().join("; ")) }
                    @match pictures.iter().find(|picture| picture.episode == episode.name) {
                        Some(picture) => {
                            (image(picture, &format!("camera {}, step {}", picture.camera, picture.step)))
                        }
                        None => p { "There is no picture: its frames cannot be rendered again." },
                    }
                    @if let Some(plots) = plots(episode, episodes) { div { (PreEscaped(plots)) } }
                }
            }
        }
    }
}

/// The folder of the records, as an argument of a command anywhere.
fn shown(episodes: &Path) -> String {
    std::path::absolute(episodes).unwrap_or(episodes.to_owned()).display().to_string()
}

/// The name of an episode, with the address of its record in the viewer of a server with the
/// default address.
fn viewer_link(episode: &EpisodeEntry) -> Markup {
    let name = episode.record.trim_end_matches(".jsonl");
    let address = format!("http://{}/#/episode/{name}", wildcity_server::limits::LISTEN);
    html! { @if name.is_empty() { (episode.name) } @else { a href=(address) { (episode.name) } } }
}

fn table(result: &SuiteResult) -> Markup {
    html! {
        table {
            tr { th { "episode" } th { "seed" } th { "result" } th { "why" } th { "steps" } th { "distance" } th { "record" } }
            @for episode in &result.episodes {
                tr {
                    td { (episode.name) }
                    td data-name="seed" { (episode.seed) }
                    td class=(episode.status.name()) { (episode.status.name().replace('_', " ")) }
                    td.text { (why(episode)) }
                    td data-name="steps" { (episode.steps) }
                    td data-name="distance" { (format!("{:.1} m", episode.distance_m)) }
                    td {
                        @if !episode.record.is_empty() { a href=(format!("episodes/{}", episode.record)) { (episode.record) } }
                        @match &episode.mcap {
                            Some(Ok(file)) => { " " a href=(format!("episodes/{file}")) { "MCAP" } }
                            Some(Err(reason)) => { " no MCAP file: " (reason) }
                            None => {}
                        }
                    }
                }
            }
        }
    }
}

/// Reason of the status of an episode.
fn why(episode: &EpisodeEntry) -> Markup {
    let mut texts = episode.fault_texts();
    texts.extend(episode.not_judged_texts());
    if episode.status == Status::OffModel {
        texts.push(LEFT.to_owned());
    }
    texts.extend(episode.untested_texts());
    texts.extend(episode.duplicate_text());
    html! {
        (texts.join("; "))
        @if let Some(error) = episode.errors.last() { pre { (TechnicalEntry::text(error)) } }
    }
}
