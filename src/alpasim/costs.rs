//! The most that one request of AlpaSim's services may cost, from the limits and from sizes of
//! decoded messages that were counted by hand; not measured.
//! `docs/reference/alpasim-costs.md` is generated from this table, and a method without a row fails
//! a test.

use crate::limits;

/// Bytes that one message of a request takes once it is decoded.
const DECODED_BYTES: u64 = 700;

const MESSAGE: u64 = limits::MESSAGE_BYTES as u64;
/// The bytes of a request, and its messages.
const REQUEST: u64 = MESSAGE + limits::SUBMESSAGES as u64 * DECODED_BYTES;
/// An answer and its encoding.
const ANSWER: u64 = 2 * MESSAGE;
/// A point of a sweep: 32 bytes in an answer, and twice as many while it is computed.
const SWEEP: u64 = 3 * 32 * 460_800;
const LIST: u64 = (limits::LISTED_SCENES * limits::SCENE_ID_BYTES) as u64;

const RENDER_S: u64 = limits::RENDER_TIMEOUT.as_secs();

/// A method, its memory in bytes in addition to its scene's, its longest time in seconds, and what
/// bounds it.
type Cost = (&'static str, u64, u64, &'static str);

const COSTS: [Cost; 11] = [
    ("get_version", REQUEST, 0, "a constant"),
    ("get_available_scenes", REQUEST + 2 * LIST, 0, "`LISTED_SCENES`"),
    ("get_loaded_scenes", REQUEST + LIST / 10, 0, "`DRAWN_SCENES`"),
    ("get_available_cameras", REQUEST, 0, "16 cameras and a preset"),
    ("get_available_trajectories", REQUEST + ANSWER, 0, "an answer"),
    ("get_available_ego_masks", REQUEST, 0, "16 cameras of each twin"),
    ("render_rgb", REQUEST + ANSWER, RENDER_S, "an answer; raw sizes are checked first"),
    ("batch_render_rgb", REQUEST + ANSWER, RENDER_S, "an answer; `BATCH_IMAGES`"),
    ("render_aggregated", REQUEST + ANSWER + SWEEP, RENDER_S, "an answer; `BATCH_SWEEPS`"),
    ("render_lidar", REQUEST + ANSWER + SWEEP, RENDER_S, "an answer; one sweep at a time"),
    ("ground_intersection", REQUEST, 1, "`PHYSICS_BOXES`; `PHYSICS_REQUESTS` at once"),
];

fn page() -> String {
    let mut text = String::from(
        "<!-- Generated from src/alpasim/costs.rs: WILDCITY_BLESS=1 cargo test -p wildcity-alpasim --lib costs -->\n\n\
         # Costs of AlpaSim's services\n\n\
         The most that one request may cost, from the limits of the code, in addition to what its scene has reserved. All \
         requests that are being received have at most 256 MiB together.\n\n\
         | method | memory, MiB | time, s | bound by |\n|---|---|---|---|\n",
    );
    for (method, bytes, seconds, why) in COSTS {
        let mib = (bytes as f64 / f64::from(1 << 20) * 10.0).round() / 10.0;
        text.push_str(&format!("| `{method}` | {mib} | {seconds} | {why} |\n"));
    }
    text
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::fs;
    use std::path::Path;

    use super::*;

    #[test]
    fn the_page_is_that_of_the_code() {
        let path =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/reference/alpasim-costs.md");
        if std::env::var_os("WILDCITY_BLESS").is_some_and(|value| value == "1") {
            fs::write(path, page()).unwrap();
            return;
        }
        assert!(
            fs::read_to_string(path).unwrap() == page(),
            "write it again with WILDCITY_BLESS=1"
        );
    }

    #[test]
    fn every_method_has_its_cost() {
        let source = include_str!("sensorsim/listen.rs");
        let methods: BTreeSet<&str> = source
            .lines()
            .filter_map(|line| {
                let (name, _) = line.split_once("\") => ").or_else(|| line.split_once("\" => "))?;
                name.rsplit_once('"').map(|(_, name)| name)
            })
            .collect();
        let known: BTreeSet<&str> = COSTS.iter().map(|(method, ..)| *method).collect();
        assert_eq!(methods, known);
    }
}
