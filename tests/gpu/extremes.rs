//! The stress table on a device. That its bounds can be missed: `tests/render/extremes.rs`.

use wildcity::report::stress::{CASES, Verdict};

use crate::gpu::gpu;

/// 70 million keys take gigabytes.
const NOT_RUN: &[&str] = &["T21"];

#[test]
fn the_table_holds() {
    let gpu = gpu();
    let outcomes = CASES.iter().map(|case| case.run(&*gpu, false));
    let wrong = outcomes.filter(|outcome| {
        let is_limit = NOT_RUN.contains(&outcome.case);
        outcome.verdict != if is_limit { Verdict::NotRun } else { Verdict::Held }
    });
    let wrong: Vec<_> = wrong.collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}
