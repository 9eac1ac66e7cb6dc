//! A comparison as text for a terminal.

use std::fmt::Write as _;

use super::scores::Direction;
use super::{Change, Comparison, ScoreChange};

/// The comparison: what changed first, then the scores. The decision is not in it, but in
/// [`Comparison::conclusion`].
pub(super) fn text(comparison: &Comparison) -> String {
    let mut text = String::new();
    let mut row = |label: &str, rest: &str| {
        // Writing into a text cannot fail.
        let _ = writeln!(text, "{label:<12}{rest}");
    };
    for (label, run) in [("before", &comparison.before), ("after", &comparison.after)] {
        row(label, &format!("{} driven by {}", run.suite, run.agent));
    }
    let counts = &comparison.counts;
    row(
        "verdicts",
        &format!(
            "{} worse, {} better, {} as before, {} without a verdict",
            counts.worse, counts.better, counts.same, counts.unknown
        ),
    );
    row("pass rate", &comparison.pass_rate.text());
    for (count, what) in [
        (counts.changed, "pairs that are not compared, because their twin or scenario differs"),
        (counts.only_before, "episodes that were driven before alone"),
        (counts.only_after, "episodes that are driven now alone"),
        (
            counts.duplicates,
            "pairs with the same drives as an earlier seed, not counted again in rates and means",
        ),
    ] {
        if count > 0 {
            row("note", &format!("{what}: {count}"));
        }
    }
    for line in &comparison.scores_not_compared {
        row("note", &format!("score not compared: {line}"));
    }
    // The worst news first. Episodes as before are counted and not listed.
    for (change, label) in [
        (Change::Worse, "worse"),
        (Change::Better, "better"),
        (Change::Unknown, "no verdict"),
        (Change::Changed, "differs"),
        (Change::OnlyBefore, "before only"),
        (Change::OnlyAfter, "after only"),
    ] {
        for episode in comparison.episodes.iter().filter(|episode| episode.change == change) {
            row(label, &format!("{:<24} {}", episode.name, episode.text()));
        }
    }
    for episode in comparison.episodes.iter().filter(|episode| episode.has_other_faults()) {
        row("other fault", &format!("{:<24} {}", episode.name, episode.text()));
    }
    scores(&mut text, comparison);
    text
}

fn scores(text: &mut String, comparison: &Comparison) {
    let valued = comparison.scores.iter().filter(|(_, score)| has_changed(score));
    let changed: Vec<(&String, &ScoreChange)> = valued.collect();
    let alike = comparison.scores.values().filter(|score| is_alike(score)).count();
    if !changed.is_empty() {
        let _ = writeln!(
            text,
            "\n{:<36} {:>5} {:>10} {:>10} {:>10}  {:<22} 95 % interval says",
            "score, means over pairs", "pairs", "before", "now", "difference", "95 %"
        );
    }
    for (name, score) in changed {
        let number =
            |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
        let _ = writeln!(
            text,
            "{name:<36} {:>5} {:>10} {:>10} {:>10}  {:<22} {}",
            score.pairs,
            number(score.before),
            number(score.after),
            score.difference.map_or("-".to_owned(), |value| format!("{value:+.4}")),
            interval(score),
            notes(score)
        );
    }
    if alike > 0 {
        let _ = writeln!(text, "{}", alike_text(alike));
    }
}

/// How many scores did not change.
pub(super) fn alike_text(alike: usize) -> String {
    let scores = if alike == 1 { "score has" } else { "scores have" };
    format!("{alike} {scores} the same value in every pair")
}

/// Whether some pair has different values, or a value in only one run.
pub(super) fn has_changed(score: &ScoreChange) -> bool {
    // Without pairs there is nothing that could have changed.
    let is_same = score.pairs == 0 || score.direction == Direction::Same;
    score.only_before + score.only_after > 0 || !is_same
}

/// Whether there are values, all unchanged.
pub(super) fn is_alike(score: &ScoreChange) -> bool {
    score.pairs > 0 && !has_changed(score)
}

pub(super) fn interval(score: &ScoreChange) -> String {
    match score.interval {
        Some([low, high]) => format!("{low:+.4} to {high:+.4}"),
        None => "too few pairs".to_owned(),
    }
}

/// The conclusion from the interval, and the number of pairs that have a value in only one run.
pub(super) fn notes(score: &ScoreChange) -> String {
    let mut notes = vec![score.direction.name().to_owned()];
    if score.lower_is_better {
        notes.push("lower is better".to_owned());
    }
    for (count, when) in [(score.only_before, "before"), (score.only_after, "now")] {
        if count > 0 {
            notes.push(format!("pairs that have it {when} alone: {count}"));
        }
    }
    notes.join("; ")
}
