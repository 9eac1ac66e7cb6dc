//! Rates and means with their intervals.

use wildcity_score::statistics::{Mean, wilson};

use crate::vectors::{assert_near, cases, numbers};

#[test]
fn pass_rates_are_as_in_the_vectors() {
    let Some(cases) = cases("own", "pass rate") else { return };
    for case in cases {
        let [passed, runs] = ["passed", "runs"].map(|key| case.input[key].as_u64().unwrap());
        let found = wilson(passed, runs);
        for (end, wanted) in found.iter().zip(case.expected["interval"].as_array().unwrap()) {
            assert_near(*end, wanted, &case.name);
        }
    }
    assert_eq!(wilson(0, 0), [0.0, 1.0]);
}

#[test]
fn means_are_as_in_the_vector() {
    let Some(cases) = cases("own", "mean of") else { return };
    for case in cases {
        let found = Mean::of(&numbers(&case.input["scores"])).unwrap();
        assert_near(found.mean, &case.expected["mean"], &case.name);
        assert_near(found.deviation.unwrap(), &case.expected["sd"], &case.name);
        assert_near(found.half_width.unwrap(), &case.expected["half_width"], &case.name);
    }
    assert_eq!(Mean::of(&[]), None);
    assert_eq!(Mean::of(&[0.5]).unwrap().half_width, None);
}
