//! KID against numpy.

use serde::Deserialize;

use wildcity_eval::Kid;

#[derive(Deserialize)]
struct Case {
    a: Vec<Vec<f32>>,
    b: Vec<Vec<f32>>,
    kid: f64,
}

/// The subsets of two among three images are equally frequent.
#[test]
fn subsets_are_drawn_evenly() {
    let a = [0.0, 1.0, 3.0].map(|value| vec![value]);
    let b = [0.5, 0.25].map(|value| vec![value]);
    let of_pair =
        |[i, j]: [usize; 2]| Kid::compare(&[a[i].clone(), a[j].clone()], &b).unwrap().mean;
    let values = [[0, 1], [0, 2], [1, 2]].map(of_pair);
    let mean = values.iter().sum::<f64>() / 3.0;
    let deviation = (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / 3.0).sqrt();
    let found = Kid::compare_subsets(&a, &b, 3_000, 2).unwrap();
    // The standard error is 0.018 of the deviation.
    assert!((found.mean - mean).abs() < 0.06 * deviation, "{found:?} {mean}");
    let ratio = found.standard_deviation / deviation;
    assert!((0.95..1.05).contains(&ratio), "{found:?} {deviation}");
}

#[test]
fn the_distance_is_that_of_numpy() {
    let cases: Vec<Case> = serde_json::from_str(include_str!("kid.json")).unwrap();
    assert_eq!(cases.len(), 3);
    for Case { a, b, kid } in cases {
        let found = Kid::compare(&a, &b).unwrap();
        assert!((found.mean - kid).abs() < 1e-12 * (1.0 + kid.abs()), "{found:?} {kid}");
        assert_eq!(found.subset_size, a.len().min(b.len()));
    }
}
