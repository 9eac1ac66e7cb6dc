//! `report.html`: one page that loads nothing else.

use std::collections::BTreeMap;
use std::path::Path;

use data_encoding::BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::picture::Picture;
use crate::plot::plots;
use crate::result::{Rate, SuiteResult};

const STYLE: &str = "\
body{font:15px/1.45 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#111}
h1{font-size:1.6em}h2{margin-top:2em;font-size:1.2em}
table{border-collapse:collapse;font-size:13px}td,th{padding:2px 8px;border-bottom:1px solid #ddd;text-align:left}
.passed{color:#00703c}.failed{color:#b00020;font-weight:600}.technical{color:#b05a00}.off_model,.not_judged{color:#777}
figure{margin:0 0 1.5em 0}img{max-width:420px}svg{border:1px solid #eee;margin-right:6px}";

/// The page. `episodes` has the records, of which the worst are drawn.
pub fn page(result: &SuiteResult, pictures: &[Picture], episodes: &Path) -> String {
    let title = format!("{}: {}", result.suite, result.agent);
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { (title) }
                (outcome(result))
                h2 { "Scenarios" }
                (scenarios(result))
                h2 { "Scores" }
                (means(result))
                (worst(result, pictures, episodes))
                h2 { "Episodes" }
                (table(result))
            }
        }
    };
    markup.into_string() + "\n"
}

fn outcome(result: &SuiteResult) -> Markup {
    let counts = &result.counts;
    html! {
        p {
            (counts.episodes) " episodes: " (counts.passed) " passed, " (counts.failed) " failed, "
            (counts.off_model) " off the model, " (counts.not_judged) " not judged, "
            (counts.technical) " not driven for technical reasons."
        }
        p { "Pass rate " (rate(&result.pass_rate)) "." }
        @if let Some(least) = result.at_least {
            p { "Wanted: the lower end of the interval at least " (percent(least)) "." }
        }
        @if result.latest { p { "Run on the latest versions of the twins, whatever the scenarios name." } }
    }
}

fn rate(rate: &Rate) -> String {
    let [low, high] = rate.interval;
    match rate.rate {
        Some(value) => format!(
            "{} ({} of {}; 95 %: {} to {})",
            percent(value),
            rate.passed,
            rate.runs,
            percent(low),
            percent(high)
        ),
        None => "unknown: no episode was judged".to_owned(),
    }
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

fn scenarios(result: &SuiteResult) -> Markup {
    html! {
        table {
            tr { th { "scenario" } th { "pass rate" } }
            @for (name, of) in &result.scenarios {
                tr { td { (name) } td { (rate(of)) } }
            }
        }
    }
}

fn means(result: &SuiteResult) -> Markup {
    html! {
        table {
            tr { th { "score" } th { "mean over scenarios" } th { "95 %" } th { "scenarios" } }
            @for (name, mean) in &result.means {
                tr {
                    td { (name) }
                    td { (format!("{:.4}", mean.mean)) }
                    td { @if let Some([low, high]) = mean.interval { (format!("{low:.4} to {high:.4}")) } }
                    td { (mean.scenarios) }
                }
            }
            @for (name, reason) in without_value(result) {
                tr { td { (name) } td colspan="3" { "none: " (reason) } }
            }
        }
        p { "Intervals of means: Student's t over the scenarios, clipped to the range of the score; none below three." }
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
            @for episode in worst {
                figure {
                    figcaption { b { (episode.name) } ": " (episode.fault_texts().join("; ")) }
                    @match pictures.iter().find(|picture| picture.episode == episode.name) {
                        Some(picture) => (image(picture)),
                        None => p { "There is no picture: its frames cannot be rendered again." },
                    }
                    @if let Some(plots) = plots(episode, episodes) { div { (PreEscaped(plots)) } }
                }
            }
        }
    }
}

fn image(picture: &Picture) -> Markup {
    let source = format!("data:image/jpeg;base64,{}", BASE64.encode(&picture.jpeg));
    let text = format!("camera {}, step {}", picture.camera, picture.step);
    html! { div { img src=(source) alt=(text); br; small { (text) } } }
}

fn table(result: &SuiteResult) -> Markup {
    html! {
        table {
            tr { th { "episode" } th { "seed" } th { "result" } th { "why" } th { "steps" } th { "m" } th { "record" } }
            @for episode in &result.episodes {
                tr {
                    td { (episode.name) }
                    td { (episode.seed) }
                    td class=(episode.status.name()) { (episode.status.name()) }
                    td {
                        (episode.fault_texts().join("; "))
                        @if let Some(error) = episode.errors.last() { " " (error.kind) ": " (error.message) }
                    }
                    td { (episode.steps) }
                    td { (format!("{:.1}", episode.distance_m)) }
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
