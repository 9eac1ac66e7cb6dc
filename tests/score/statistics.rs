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
        let found = Mean::from_values(&numbers(&case.input["scores"])).unwrap();
        assert_near(found.mean, &case.expected["mean"], &case.name);
        assert_near(found.deviation.unwrap(), &case.expected["sd"], &case.name);
        assert_near(found.half_width.unwrap(), &case.expected["half_width"], &case.name);
    }
    assert_eq!(Mean::from_values(&[]), None);
    assert_eq!(Mean::from_values(&[0.5]).unwrap().half_width, None);
}

#[test]
fn intervals_of_means_are_those_of_scipy_within_the_range() {
    // scipy 1.17.1: stats.t.interval(0.95, len(v) - 1, mean(v), stats.sem(v)).
    let cases: [(&[f64], [f64; 2], [f64; 2]); 4] = [
        (&[0.71, 0.74, 0.78, 0.69], [0.0, 1.0], [0.667_691_201_373_278_4, 0.792_308_798_626_721_5]),
        // -0.38 to 1.78 and -1.10 to 1.77, clipped.
        (&[0.2, 0.9, 1.0], [0.0, 1.0], [0.0, 1.0]),
        (&[0.0, 0.0, 1.0], [0.0, f64::INFINITY], [0.0, 1.767_550_909_916_487_4]),
        (&[4.1, 5.0, 5.0, 3.2, 5.0], [0.0, 5.0], [3.460_479_762_128_794, 5.0]),
    ];
    for (values, range, expected) in cases {
        let found = Mean::from_values(values).unwrap().interval(range).unwrap();
        for (end, wanted) in found.iter().zip(expected) {
            assert!((end - wanted).abs() < 1e-9, "{values:?}: {found:?}");
        }
    }
    // Two values have half a width, but no interval.
    let two = Mean::from_values(&[0.5, 0.7]).unwrap();
    assert!(two.half_width.is_some_and(|half_width| half_width > 1.2));
    assert_eq!(two.interval([0.0, 1.0]), None);
    assert_eq!(Mean::from_values(&[0.5]).unwrap().interval([0.0, 1.0]), None);
}
