//! The stress cases on a device. That each check can fail is tested in `mutations.rs`.

use wildcity_stress::{CASES, Verdict};

use crate::gpu::gpu;

#[test]
fn the_table_holds() {
    let gpu = gpu();
    let outcomes = CASES.iter().map(|case| case.run(&*gpu, false));
    let wrong = outcomes.filter(|outcome| match outcome.case {
        // 70 million keys take gigabytes.
        "T21" => outcome.verdict != Verdict::NotRun,
        // A driver may support at most 65,535 layers.
        "T28" => !matches!(outcome.verdict, Verdict::Held | Verdict::Refused),
        _ => outcome.verdict != Verdict::Held,
    });
    let wrong: Vec<_> = wrong.collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}
