//! Suites and scenarios as files, and the cases that they make.

use serde_json::json;

use crate::street::{Bench, scenario};

#[test]
fn a_suite_is_its_scenarios_times_its_seeds() {
    let bench = Bench::new();
    let cases = bench.cases(&bench.suite()).unwrap();
    let names: Vec<&str> = cases.iter().map(|case| case.name.as_str()).collect();
    assert_eq!(names, ["car-3", "car-4", "rails-3", "rails-4"]);
    let case = &cases[0];
    assert_eq!((case.seed, case.steps, case.drive_start_us), (3, 20, 2_000_000));
    // The recorded drive from 20 m on for two seconds, in keyframes of 0.5 s.
    let route: Vec<(i64, f64)> =
        case.line.route.iter().map(|point| (point.0, point.1[0])).collect();
    let wanted =
        [(0, 20.0), (500_000, 25.0), (1_000_000, 30.0), (1_500_000, 35.0), (2_000_000, 40.0)];
    assert_eq!(route, wanted);
    assert_ne!(cases[0].line.hash, cases[1].line.hash, "the seed is part of the identity");
    assert_eq!(bench.cases(&bench.path("rails.json")).unwrap().len(), 1, "a scenario alone");
}

#[test]
fn a_sweep_makes_a_case_of_each_combination() {
    let bench = Bench::new();
    let mut swept = scenario("swept", &json!({ "model": "kinematic", "speed": "$v" }));
    swept["sweep"] = json!({ "seeds": [0, 1], "v": [8.0, 10.0] });
    let cases = bench.cases(&bench.write("swept.json", &swept)).unwrap();
    let names: Vec<&str> = cases.iter().map(|case| case.name.as_str()).collect();
    assert_eq!(names, ["swept-0-0", "swept-0-1", "swept-1-0", "swept-1-1"]);
    assert_eq!(*cases[2].values["v"], 10.0);
    assert_eq!(cases[2].resolved.dynamics.unwrap().speed_m_s, 10.0);
}

#[test]
fn mistakes_name_the_file_and_the_place() {
    let bench = Bench::new();
    let suite = |change: &dyn Fn(&mut serde_json::Value)| {
        let mut value =
            json!({ "format": "wildcity.suite/1", "name": "a", "scenarios": ["rails.json"] });
        change(&mut value);
        bench.suite();
        bench.cases(&bench.write("changed.json", &value)).unwrap_err().to_string()
    };
    for (change, wanted) in [
        (suite(&|value| value["scenarios"] = json!([])), "scenarios: is empty"),
        (suite(&|value| value["seeds"] = json!([4, 3])), "seeds: [4, 3]"),
        (suite(&|value| value["seeds"] = json!([0, u64::MAX])), "are more than 100000 seeds"),
        (suite(&|value| value["seed"] = json!(4)), "unknown field `seed`"),
        (suite(&|value| value["format"] = json!("wildcity.suite/9")), "write \"wildcity.suite/1\""),
        (suite(&|value| value["at_least"] = json!(90)), "a rate is from 0 to 1"),
        (
            suite(&|value| value["cameras"] = json!(["front", "roof"])),
            "cameras[1]: \"roof\" is no camera of twin \"street\", which has front, left",
        ),
        (suite(&|value| value["cameras"] = json!([])), "cameras: is empty"),
        (
            suite(&|value| value["cameras"] = json!(["left", "left"])),
            "cameras[1]: \"left\" is there",
        ),
        (suite(&|value| value["size"] = json!([0, 24])), "size: [0, 24]"),
        (suite(&|value| value["dt_us"] = json!(0)), "dt_us: 0"),
        (suite(&|value| value["dt_us"] = json!(1_000_000)), "dt_us: 1000000"),
    ] {
        assert!(change.contains("changed.json") && change.contains(wanted), "{change}");
    }
    let missing = suite(&|value| value["scenarios"] = json!(["nowhere.json"]));
    assert!(missing.contains("nowhere.json"), "{missing}");
    let mut other = scenario("rails", &json!({ "model": "teleport" }));
    other["ego"]["start"]["station_m"] = json!(2000.0);
    let far = bench.cases(&bench.write("far.json", &other)).unwrap_err().to_string();
    assert!(far.contains("far.json") && far.contains("station_m"), "{far}");
}

#[test]
fn a_version_that_is_gone_is_an_error_unless_the_latest_will_do() {
    let bench = Bench::new();
    let mut pinned = scenario("pinned", &json!({ "model": "teleport" }));
    pinned["twin"]["version_hash"] = json!("a".repeat(64));
    let path = bench.write("pinned.json", &pinned);
    let error = bench.cases(&path).unwrap_err().to_string();
    assert!(error.contains("not in the store") && error.contains("--latest"), "{error}");
    let (suite, scenarios) = wildcity_suite::SuiteFile::read(&path).unwrap();
    let latest = wildcity_suite::CaseOptions { latest: true, bare: false };
    let latest = wildcity_suite::cases(&suite, &scenarios, &bench.catalog(), latest).unwrap();
    let there = bench.catalog().version("street", None).unwrap().hash;
    assert_eq!(latest[0].version_hash, there);
    pinned["twin"]["version_hash"] = json!(there);
    assert!(bench.cases(&bench.write("pinned.json", &pinned)).is_ok());
}

#[test]
fn two_episodes_of_one_name_are_refused() {
    let bench = Bench::new();
    bench.write("a.json", &scenario("rails", &json!({ "model": "teleport" })));
    bench.write("b.json", &scenario("rails", &json!({ "model": "teleport" })));
    let suite =
        json!({ "format": "wildcity.suite/1", "name": "a", "scenarios": ["a.json", "b.json"] });
    let error = bench.cases(&bench.write("suite.json", &suite)).unwrap_err().to_string();
    assert!(error.contains("\"rails-0\""), "{error}");
}
