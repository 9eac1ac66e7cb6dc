//! KID against numpy.

use serde::Deserialize;

use wildcity_eval::Kid;

#[derive(Deserialize)]
struct Case {
    a: Vec<Vec<f32>>,
    b: Vec<Vec<f32>>,
    kid: f64,
}

#[test]
fn the_distance_is_that_of_numpy() {
    let cases: Vec<Case> = serde_json::from_str(include_str!("kid.json")).unwrap();
    assert_eq!(cases.len(), 3);
    for Case { a, b, kid } in cases {
        let found = Kid::of(&a, &b).unwrap();
        assert!((found.mean - kid).abs() < 1e-12 * (1.0 + kid.abs()), "{found:?} {kid}");
        assert_eq!(found.subset_size, a.len().min(b.len()));
    }
}
