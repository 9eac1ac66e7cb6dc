//! Where two episodes part: every field that can differ is named, in the order of cause and effect.

use serde_json::json;
use wildcity_episode::{What, diff};

use crate::written::{self, Made, ego_at};

#[test]
fn equal_episodes_do_not_differ() {
    assert_eq!(diff(&Made::default().read(), &Made::default().read()), None);
}

#[test]
fn the_first_difference_is_found_by_cause() {
    let made = Made { steps: 5, ..Made::default() };
    let whole = made.read();
    // Lines: header, scenario, then actors and frame of steps 0, 1, ..
    let frame = |step: usize| 3 + 2 * step;
    type Change = fn(&mut [serde_json::Value], usize);
    let changes: [(What, Change); 4] = [
        (What::Image, |lines, at| lines[at]["images"][1] = json!("f".repeat(64))),
        (What::Actor, |lines, at| lines[at - 1]["actors"][1][1][0] = json!(3.25)),
        (What::Ego, |lines, at| lines[at]["poses"][0] = json!(ego_at(77.0))),
        (What::Command, |lines, at| lines[at]["command"]["action"]["curvature_1_m"] = json!(0.1)),
    ];
    // Each further change is nearer to the cause, at the same step.
    let mut lines = made.lines();
    for (what, change) in changes {
        change(&mut lines, frame(3));
        let found = diff(&whole, &written::read(&lines)).unwrap();
        assert_eq!((found.step, found.what), (3, what), "{found}");
    }
    // A difference at an earlier step comes first, whatever it is.
    lines[frame(2)]["images"][0] = json!("f".repeat(64));
    let found = diff(&whole, &written::read(&lines)).unwrap();
    assert_eq!((found.step, found.what), (2, What::Image));
    assert!(found.how.contains("left"), "{found}");
}

#[test]
fn lengths_and_setups_differ() {
    let whole = Made { steps: 5, ..Made::default() };
    let shorter = Made { steps: 4, ..whole.clone() };
    let mut lines = shorter.lines();
    lines[1]["limit_us"] = json!(500_000);
    let found = diff(&whole.read(), &written::read(&lines)).unwrap();
    assert_eq!((found.step, found.what), (4, What::Length));
    let mut lines = whole.lines();
    lines[0]["seed"] = json!(8);
    let found = diff(&whole.read(), &written::read(&lines)).unwrap();
    assert_eq!((found.what, found.how.as_str()), (What::Setup, "seed 7 against 8"));
}

#[test]
fn a_setup_that_differs_is_named_with_both_values() {
    let whole = Made::default();
    let found = |change: &dyn Fn(&mut [serde_json::Value])| {
        let mut lines = whole.lines();
        change(&mut lines);
        let found = diff(&whole.read(), &written::read(&lines)).unwrap();
        assert_eq!(found.what, What::Setup);
        found.how
    };
    let scenario = |change: &dyn Fn(&mut serde_json::Value)| {
        found(&|lines| {
            change(&mut lines[1]);
            lines[1]["hash"] = json!("f".repeat(64));
        })
    };
    let twin = whole.lines()[0]["twin"].as_str().unwrap().to_owned();
    assert_eq!(
        found(&|lines| lines[0]["twin"] = json!("other")),
        format!("twin {twin} against other")
    );
    let version = found(&|lines| lines[0]["version_hash"] = json!("f".repeat(64)));
    assert!(version.starts_with(&format!("version of twin {twin} ")), "{version}");
    assert!(version.ends_with("(ffffffff)"), "{version}");
    assert_eq!(
        found(&|lines| lines[0]["dt_us"] = json!(50_000)),
        "length of a step 0.1 s against 0.05 s"
    );
    let dynamics = found(&|lines| lines[0]["dynamics"]["speed_m_s"] = json!(77.0));
    assert!(
        dynamics.starts_with("dynamics: speed_m_s ") && dynamics.ends_with(" against 77.0"),
        "{dynamics}"
    );
    let start = found(&|lines| lines[0]["start"]["xyz"][1] = json!(3.5));
    assert!(start.starts_with("start: xyz[1] ") && start.ends_with(" against 3.5"), "{start}");
    let name = whole.lines()[1]["name"].as_str().unwrap().to_owned();
    assert_eq!(
        scenario(&|line| line["name"] = json!("cut-in")),
        format!("scenario {name} against cut-in")
    );
    let ended = scenario(&|line| line["scenario"]["end"] = json!({ "contact": "any" }));
    assert!(ended.starts_with(&format!("scenario {name}: end")), "{ended}");
    assert!(ended.contains(" against ") && ended.contains("any"), "{ended}");
    // A hash that nothing explains.
    assert!(scenario(&|_| {}).starts_with(&format!("scenario {name}: hash ")));
}
