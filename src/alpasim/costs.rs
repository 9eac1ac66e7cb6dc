//! The most that one request of AlpaSim's services may cost, from the limits and from sizes of
//! decoded messages that were counted by hand; `clients/python/tests/test_alpasim_costs.py`
//! measures it. `docs/reference/alpasim-costs.md` is generated from this table, and a method
//! without a row fails a test.

use std::time::Duration;

use crate::cost_table::{Cost, Page, cost};
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

const NONE: Duration = Duration::ZERO;
const RENDER: Duration = limits::RENDER_TIMEOUT;
const SECOND: Duration = Duration::from_secs(1);

/// Nothing is written to the disk.
const COSTS: [Cost; 11] = [
    cost("get_version", REQUEST, NONE, 0, "a constant"),
    cost("get_available_scenes", REQUEST + 2 * LIST, NONE, 0, "`LISTED_SCENES`"),
    cost("get_loaded_scenes", REQUEST + LIST / 10, NONE, 0, "`DRAWN_SCENES`"),
    cost("get_available_cameras", REQUEST, NONE, 0, "16 cameras and a preset"),
    cost("get_available_trajectories", REQUEST + ANSWER, NONE, 0, "an answer"),
    cost("get_available_ego_masks", REQUEST, NONE, 0, "16 cameras of each twin"),
    cost("render_rgb", REQUEST + ANSWER, RENDER, 0, "an answer; raw sizes are checked first"),
    cost("batch_render_rgb", REQUEST + ANSWER, RENDER, 0, "an answer; `BATCH_IMAGES`"),
    cost("render_aggregated", REQUEST + ANSWER + SWEEP, RENDER, 0, "an answer; `BATCH_SWEEPS`"),
    cost("render_lidar", REQUEST + ANSWER + SWEEP, RENDER, 0, "an answer; one sweep at a time"),
    cost("ground_intersection", REQUEST, SECOND, 0, "`PHYSICS_BOXES`; `PHYSICS_REQUESTS` at once"),
];

fn page() -> Page {
    Page {
        from: "src/alpasim/costs.rs",
        test: "-p wildcity-alpasim --lib costs",
        title: "Costs of AlpaSim's services",
        introduction: "The most that one request may cost, from the limits of the code, in addition to what its scene has \
            reserved. All requests that are being received have at most 256 MiB together.",
        tables: vec![("", &COSTS)],
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::generated;

    #[test]
    fn the_page_is_that_of_the_code() {
        let page = page();
        generated::check("docs/reference/alpasim-costs.md", &page.text(), page.test);
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
        let known: BTreeSet<&str> = COSTS.iter().map(|cost| cost.of).collect();
        assert_eq!(methods, known);
    }
}
