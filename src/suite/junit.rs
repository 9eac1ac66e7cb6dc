//! `junit.xml`, for CI systems.

use std::fmt::Write as _;

use crate::ending::Ending;
use crate::entry::{EpisodeEntry, LEFT, Status, TechnicalEntry};
use crate::result::SuiteResult;

/// The result as JUnit XML: `failure` is driving; `error` technical, or an episode without a
/// verdict, since a skipped test counts as a good one; `skipped` an episode that left the trained
/// area where the suite accepts this.
///
/// Times are in seconds of wall-clock time; that of the suite is the sum over its episodes,
/// whatever ran at once. A failed episode is a `failure` even if the run passes. The properties of
/// the suite have the exit code and its reason.
pub fn junit(result: &SuiteResult, ending: &Ending) -> String {
    let counts = &result.counts;
    let skipped = if result.accepts_off_model() { counts.off_model } else { 0 };
    // `skipped` is at most `off_model`, so the subtraction is safe.
    let errors = counts.technical + counts.not_judged + counts.off_model - skipped;
    let mut text = String::from("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n");
    // Writing into a text cannot fail.
    let _ = writeln!(
        text,
        "<testsuites><testsuite name=\"{}\" tests=\"{}\" failures=\"{}\" errors=\"{}\" skipped=\"{skipped}\" time=\"{:.3}\">",
        escaped(&result.suite),
        counts.episodes,
        counts.failed,
        errors,
        result.episodes.iter().map(|episode| episode.wall.as_secs_f64()).sum::<f64>(),
    );
    text.push_str("  <properties>\n");
    let at_least = result.at_least.map(|least| least.to_string());
    for (name, value) in [
        ("agent", Some(result.agent.clone())),
        ("at_least", at_least),
        ("exit_code", Some((ending.code as u8).to_string())),
        ("why", Some(ending.why.clone())),
    ] {
        if let Some(value) = value.map(|value| escaped(&value)) {
            let _ = writeln!(text, "    <property name=\"{name}\" value=\"{value}\"/>");
        }
    }
    text.push_str("  </properties>\n");
    for episode in &result.episodes {
        case(&mut text, result, episode);
    }
    text.push_str("</testsuite></testsuites>\n");
    text
}

fn case(text: &mut String, result: &SuiteResult, episode: &EpisodeEntry) {
    let class = format!("{}.{}", result.suite, episode.scenario);
    let _ = write!(
        text,
        "  <testcase classname=\"{}\" name=\"{}\" time=\"{:.3}\"",
        escaped(&class),
        escaped(&episode.name),
        episode.wall.as_secs_f64()
    );
    // The status decides on the element; for `off_model` also whether the run accepts it.
    let inner = match episode.status {
        Status::Passed => String::new(),
        Status::Failed => {
            // The first fault names the type, because later ones may follow from it.
            let types: Vec<&str> = episode.faults.iter().map(|fault| &*fault.fault).collect();
            let kind = types.first().copied().unwrap_or("unknown");
            let lines = episode.fault_texts();
            element("failure", kind, lines.first().map_or("", |line| line), &lines.join("\n"))
        }
        Status::OffModel => {
            let message = LEFT;
            if result.accepts_off_model() {
                format!("<skipped message=\"{message}\"/>")
            } else {
                element("error", "off_model", message, message)
            }
        }
        Status::NotJudged => {
            let texts = episode.not_judged_texts();
            element("error", "not_judged", &texts.join("; "), &texts.join("\n"))
        }
        Status::Technical => {
            let last = episode.errors.last();
            // The last attempt decided; earlier ones are in the text.
            let kind = last.map_or("server_error", |error| &error.kind);
            let message = last.map_or("", |error| &error.message);
            let lines: Vec<String> = episode.errors.iter().map(TechnicalEntry::text).collect();
            element("error", kind, message, &lines.join("\n"))
        }
    };
    let inner = inner + &notes(episode);
    // A test without content is a passed one.
    if inner.is_empty() {
        text.push_str("/>\n");
    } else {
        let _ = writeln!(text, ">{inner}</testcase>");
    }
}

/// Notes in addition to the status: criteria that were not judged, what the scenario did not test,
/// and whether the episode is a duplicate.
fn notes(episode: &EpisodeEntry) -> String {
    let is_told = episode.status == Status::NotJudged;
    let not_judged = episode.not_judged.iter().filter(|_| !is_told);
    let mut lines: Vec<String> = not_judged.map(|reason| format!("not judged: {reason}")).collect();
    lines.extend(episode.untested_texts());
    lines.extend(episode.duplicate_text());
    if lines.is_empty() {
        String::new()
    } else {
        format!("<system-out>{}</system-out>", escaped(&lines.join("\n")))
    }
}

fn element(name: &str, kind: &str, message: &str, body: &str) -> String {
    // Every text from outside is escaped here, in one place.
    let [kind, message, body] = [kind, message, body].map(escaped);
    format!("<{name} type=\"{kind}\" message=\"{message}\">{body}</{name}>")
}

/// Text for XML 1.0, which has no control characters but tab and line breaks.
fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\t' | '\n' => escaped.push(character),
            // XML 1.0 cannot have most of them, not even as references.
            control if control.is_control() => escaped.push('\u{fffd}'),
            // The two code points that XML does not allow in addition to controls.
            '\u{fffe}' | '\u{ffff}' => escaped.push('\u{fffd}'),
            other => escaped.push(other),
        }
    }
    escaped
}
