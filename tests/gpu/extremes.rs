//! The stress table on a device. That its bounds can be missed: `tests/render/extremes.rs`.

use wildcity::report::stress::{CASES, Verdict};

use crate::gpu::gpu;

#[test]
fn the_table_holds() {
    let gpu = gpu();
    for case in &CASES {
        let outcome = case.run(&*gpu, false);
        // 70 million keys take gigabytes; the others are limits of every backend.
        let is_limit = ["T21", "T22", "T23", "T24"].contains(&case.number);
        let wanted = if is_limit { Verdict::NotRun } else { Verdict::Held };
        assert_eq!(outcome.verdict, wanted, "{outcome:?}");
    }
}
