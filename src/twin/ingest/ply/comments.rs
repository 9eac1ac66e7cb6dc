//! Comments in which programs say how a scene was trained.

use crate::ingest::notes::{BLUR_BRUSH_PX2, BLUR_PX2, Reading};

/// First words of comments that have no effect on the picture.
const WITHOUT_EFFECT: [&str; 10] = [
    "created",
    "exported",
    "file",
    "generated",
    "generator",
    "https://",
    "sh degree",
    "splat file",
    "www.",
    "this file",
];

/// Whether a comment gives a value, and is no prose.
fn is_setting(comment: &str) -> bool {
    let last = comment.split_ascii_whitespace().next_back().unwrap_or_default();
    comment.contains([':', '=']) || last.parse::<f64>().is_ok() || last.parse::<bool>().is_ok()
}

/// Takes from a comment what it says, and warns of a setting that is not understood.
pub(super) fn read(comment: &str, reading: &mut Reading) {
    let said_by = || format!("comment {comment:?}");
    let lower = comment.to_ascii_lowercase();
    // Programs write `key value` or `key: value`.
    let words: Vec<&str> = lower.split([' ', ':']).filter(|word| !word.is_empty()).collect();
    match words[..] {
        // Brush and splat-transform.
        ["splatrendermode", "mip"] => reading.set_antialiased(BLUR_BRUSH_PX2, said_by()),
        ["splatrendermode", "2dgs"] => reading.set_flat(&said_by()),
        ["splatrendermode", "default"] => reading.set_antialiasing(None, said_by()),
        [] => {}
        // Postshot.
        ["antialiased", "1" | "true"] => reading.set_antialiased(BLUR_PX2, said_by()),
        ["antialiased", "0" | "false"] => reading.set_antialiasing(None, said_by()),
        // nerfstudio: which of its axes is up, and not where the others point.
        ["vertical", "axis", axis] => reading.hint_axes(format!(
            "{} says that {axis} is up or down, and no axes are given: give --axes",
            said_by()
        )),
        _ if WITHOUT_EFFECT.iter().any(|start| lower.starts_with(start)) => {}
        _ if is_setting(&lower) => reading.warn(format!("{} has no effect", said_by())),
        _ => {}
    }
}
