//! Selection of views by trust.

use wildcity_repair::Selection;

fn decide(selection: Selection, steps: &[&[f64]]) -> Vec<Vec<usize>> {
    let mut before = Vec::new();
    let mut chosen = Vec::new();
    for trust in steps {
        let decision = selection.decide(&before, trust);
        chosen.push(decision.cameras);
        before = decision.is_on;
    }
    chosen
}

#[test]
fn between_the_thresholds_a_camera_stays_as_it_was() {
    let selection = Selection::default();
    // On below 0.75, off above 0.85.
    let steps: [&[f64]; 7] = [&[1.0], &[0.8], &[0.7], &[0.8], &[0.86], &[0.8], &[0.74]];
    let expected: [&[usize]; 7] = [&[], &[], &[0], &[0], &[], &[], &[0]];
    assert_eq!(decide(selection, &steps), expected);
    // A single observation has no history.
    assert!(selection.decide(&[], &[0.8]).cameras.is_empty());
}

#[test]
fn a_recorded_pose_is_never_repaired_and_neither_is_an_invented_view() {
    let decision =
        Selection::default().decide(&[true, true, true, true], &[1.0, 0.05, f64::NAN, 0.1]);
    assert_eq!(decision.cameras, [3]);
    // They stay on: back at 0.2 they are repaired at once.
    assert_eq!(decision.is_on, [false, true, true, true]);
}

#[test]
fn a_step_repairs_the_least_trusted_then_the_first_cameras() {
    let selection = Selection { per_step: 2, ..Selection::default() };
    let decision = selection.decide(&[], &[0.5, 0.3, 0.5, 0.4]);
    assert_eq!(decision.cameras, [1, 3]);
    assert_eq!(decision.is_on, [true; 4], "the count changes nothing for the next step");
    assert_eq!(selection.decide(&[], &[0.5, 0.5, 0.5]).cameras, [0, 1]);
    assert!(Selection { per_step: 0, ..selection }.decide(&[], &[0.5]).cameras.is_empty());
}

#[test]
fn thresholds_that_contradict_each_other_are_refused() {
    let default = Selection::default();
    assert_eq!(default.check(), Ok(()));
    for (selection, field) in [
        (Selection { below: 1.5, ..default }, "below"),
        (Selection { above: 0.7, ..default }, "above"),
        (Selection { above: f64::NAN, ..default }, "above"),
        (Selection { at_least: 0.8, ..default }, "at_least"),
    ] {
        let (at, must) = selection.check().unwrap_err();
        assert_eq!(at, field, "{must}");
    }
}
