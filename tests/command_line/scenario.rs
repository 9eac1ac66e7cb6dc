//! `wildcity scenario` and `wildcity twin map`: files in, files and errors with their place out.

use std::fs;
use std::path::Path;
use std::process::Output;

use serde_json::{Value, json};

use crate::{support, wildcity};

fn run(arguments: &[&str], dir: &Path) -> Output {
    wildcity().args(arguments).current_dir(dir).output().unwrap()
}

fn done(arguments: &[&str], dir: &Path) -> String {
    let output = run(arguments, dir);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn refused(arguments: &[&str], dir: &Path) -> String {
    let output = run(arguments, dir);
    // A mistake in a scenario has the code that it has in `episode run`.
    let code = if arguments.starts_with(&["scenario", "check"]) { 2 } else { 1 };
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {output:?}");
    String::from_utf8(output.stderr).unwrap()
}

/// On the 9 m of the twin `test`.
fn scenario() -> Value {
    json!({
        "format": "wildcity.scenario/1", "name": "two", "twin": {"name": "test"},
        "map": {"file": "test.map.json"},
        "ego": {"start": {"trajectory": "log", "station_m": 1}},
        "actors": [
            {"name": "car", "idm": {"lanes": ["log"], "station_m": 5, "speed": "$v"},
             "jitter": {"longitudinal_m": 1, "lateral_m": 0}},
            {"name": "van", "stand": {"xyz": [7, 3, 0]}}],
        "sweep": {"seeds": [0, 1], "v": [1, 2, 3]}})
}

#[test]
fn a_scenario_is_checked_and_shown_with_its_map() {
    let dir = support::twins();
    let at = dir.path();
    let twins = ["--twins", "."];
    let strips = [
        "twin",
        "map",
        "strips",
        "test",
        "--left-m",
        "3",
        "--right-m",
        "2",
        "--out",
        "test.map.json",
    ];
    assert!(done(&[&strips[..], &twins].concat(), at).contains("1 lane\n"));
    assert!(done(&["twin", "map", "check", "test.map.json"], at).contains("1 lane, 1 area, "));
    fs::write(at.join("two.json"), scenario().to_string()).unwrap();
    let checked = done(&[&["scenario", "check", "two.json"][..], &twins].concat(), at);
    assert!(checked.contains("6 episodes in test@1, 2 actors"), "{checked}");

    let show = |more: &[&str]| -> Value {
        let arguments = [&["scenario", "show", "two.json"][..], &twins, more].concat();
        serde_json::from_str(&done(&arguments, at)).unwrap()
    };
    let shown = show(&["--seed", "1", "--value", "v=2"]);
    let jitter = &shown["scenario"]["actors"][0]["jitter"]["drawn"]["longitudinal_m"];
    assert!(jitter.as_f64().unwrap().abs() <= 1.0, "{shown}");
    assert_eq!(shown["scenario"]["actors"][0]["idm"]["speed"], 2.0);
    assert_eq!(shown["scenario"]["twin"]["version_hash"].as_str().unwrap().len(), 64);
    assert_ne!(shown["hash"], show(&["--seed", "0", "--value", "v=2"])["hash"]);
    // The output is a scenario, and the same episode.
    fs::write(at.join("two.json"), shown["scenario"].to_string()).unwrap();
    assert_eq!(show(&["--seed", "9"]), shown);

    // A changed map is a different map, unless the user accepts it.
    let map = fs::read_to_string(at.join("test.map.json")).unwrap();
    fs::write(at.join("test.map.json"), format!("{map}\n")).unwrap();
    let error = refused(&[&["scenario", "check", "two.json"][..], &twins].concat(), at);
    assert!(error.contains("map.hash") && error.contains("--latest"), "{error}");
    let accepted = [&["scenario", "check", "two.json", "--latest"][..], &twins].concat();
    assert!(done(&accepted, at).contains("not pinned: map.hash"));
}

#[test]
fn mistakes_name_the_file_the_place_and_the_fix() {
    let dir = support::twins();
    let at = dir.path();
    let mut file = scenario();
    file.as_object_mut().unwrap().remove("map");
    fs::write(at.join("two.json"), file.to_string()).unwrap();
    let check = ["scenario", "check", "two.json", "--twins", "."];
    let error = refused(&check, at);
    assert!(error.contains("two.json") && error.contains("actors[0].idm.lanes"), "{error}");
    assert!(error.contains("\"map\""), "{error}");
    file["twin"]["name"] = "town".into();
    fs::write(at.join("two.json"), file.to_string()).unwrap();
    assert!(refused(&check, at).contains("town"));
    fs::write(at.join("two.json"), "{").unwrap();
    assert!(refused(&check, at).contains("two.json"));
    assert!(refused(&["scenario", "check", "none.json", "--twins", "."], at).contains("none"));
}

#[test]
fn check_warns_of_what_images_do_not_show() {
    let dir = support::twins();
    let at = dir.path();
    let stand = |y_m: f64| json!({"xyz": [5, y_m, 0], "yaw_rad": 0});
    let file = json!({
        "format": "wildcity.scenario/1", "name": "two", "twin": {"name": "test"},
        "actors": [
            {"name": "seen", "size": [4.6, 1.8, 1.5], "stand": stand(0.0)},
            {"name": "hidden", "asset": "none", "stand": stand(5.0)},
            {"name": "late", "present": false, "stand": stand(10.0)},
            {"name": "tram", "size": [30, 2.6, 3.6], "stand": stand(15.0)},
        ],
    });
    fs::write(at.join("two.json"), file.to_string()).unwrap();
    let checked = done(&["scenario", "check", "two.json", "--twins", "."], at);
    let warnings: Vec<&str> = checked.lines().filter(|line| line.contains("warning")).collect();
    let wanted = ["hidden", "late", "tram"];
    assert_eq!(warnings.len(), wanted.len(), "{checked}");
    for (warning, name) in warnings.iter().zip(wanted) {
        assert!(warning.contains(&format!("actor {name:?}")), "{warning}");
    }
    let suite =
        json!({"format": "wildcity.suite/1", "name": "s", "scenarios": ["two.json", "three.json"]});
    fs::write(at.join("suite.json"), suite.to_string()).unwrap();
    let driven = run(&["episode", "run", "suite.json", "--twins", "."], at);
    assert_eq!(driven.status.code(), Some(2));
    let error = String::from_utf8(driven.stderr).unwrap();
    assert!(error.contains("suite.json: scenarios[1]") && error.contains("three.json"), "{error}");
}

#[test]
fn check_says_what_never_happens_and_what_agents_need() {
    let dir = support::twins();
    let at = dir.path();
    let walker = |when: Value| json!({"name": "go", "when": when, "do": [{"speed": {"to": 1.4, "rate": 1}}]});
    let mut file = json!({
        "format": "wildcity.scenario/1", "name": "cross", "twin": {"name": "test"},
        "ego": {"start": {"pose": {"xyz": [0, 0, 0], "yaw_rad": 0}}},
        "actors": [{"name": "walker", "class": "pedestrian",
            "path": {"points": [[5, -6, 0], [5, 7, 0]], "speed": 0},
            "script": [walker(json!({"ego_station_m": 50}))]}],
        "end": {"time_s": 1}});
    let check = |file: &Value| {
        fs::write(at.join("cross.json"), file.to_string()).unwrap();
        done(&["scenario", "check", "cross.json", "--twins", "."], at)
    };
    let checked = check(&file);
    let warning = "warning: trigger \"go\" of actor \"walker\" never fires: ego_station_m is 50 m";
    assert!(
        checked.contains(warning) && checked.contains("has 13.0 m; write within_m"),
        "{checked}"
    );
    assert!(checked.contains("note: route: is missing: the agent idm"), "{checked}");
    assert!(checked.contains("note: route.trajectory: is missing: the agent log"), "{checked}");

    file["route"] = json!({"trajectory": "log"});
    for (when, never) in [
        (json!({"time_s": 2}), true),
        (json!({"time_s": 0.5}), false),
        (json!({"within_m": 4}), false),
        (json!({"any": [{"station_m": 14}, {"within_m": 4}]}), false),
        (json!({"any": [{"station_m": 14}, {"time_s": 2}]}), true),
        (json!({"all": [{"station_m": 14}, {"within_m": 4}]}), true),
    ] {
        file["actors"][0]["script"] = json!([walker(when.clone())]);
        let checked = check(&file);
        assert_eq!(checked.contains("never fires"), never, "{when}: {checked}");
        assert!(!checked.contains("note: "), "{checked}");
    }
    // The last one did not fire: the record says so.
    let twins = ["--twins", ".", "--backend", "cpu", "--threads", "1", "--mcap", "false"];
    let suite = json!({"format": "wildcity.suite/1", "name": "s", "scenarios": ["cross.json"],
        "cameras": ["front"]});
    fs::write(at.join("s.json"), suite.to_string()).unwrap();
    let driven = run(&[&["episode", "run", "s.json", "--agent", "stand"][..], &twins].concat(), at);
    assert!(driven.status.code().is_some_and(|code| code != 2), "{driven:?}");
    let record = "wildcity-run/episodes/cross-0-1.jsonl";
    let shown = done(&["episode", "show", record], at);
    assert!(shown.contains("not fired   walker: trigger go"), "{shown}");
    // Without a route, the agent cannot drive: the setup is wrong, and nothing was tried.
    file.as_object_mut().unwrap().remove("route");
    fs::write(at.join("cross.json"), file.to_string()).unwrap();
    let none = ["episode", "run", "cross.json", "--agent", "idm", "--out", "none"];
    let refused = run(&[&none[..], &twins].concat(), at);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    let error = String::from_utf8(refused.stderr).unwrap();
    assert!(error.contains("scenario \"cross\": route: is missing"), "{error}");
}

#[test]
fn files_of_others_become_maps_and_scenarios() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let square = json!([[[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]]);
    let area = json!({"type": "Feature", "properties": {"layer": "drivable"},
                      "geometry": {"type": "Polygon", "coordinates": square}});
    let collection = json!({"type": "FeatureCollection", "features": [area]});
    fs::write(at.join("a.geojson"), collection.to_string()).unwrap();
    let import = ["twin", "map", "import", "a.geojson", "--out", "a.map.json"];
    assert!(done(&import, at).contains("0 lanes, 1 area\n"));
    assert!(done(&["twin", "map", "check", "a.map.json"], at).contains(", 1 area, "));
    fs::write(at.join("a.geojson"), collection.to_string().replace("drivable", "lava")).unwrap();
    let error = refused(&import, at);
    assert!(
        error.contains("a.geojson") && error.contains("features[0].properties.layer"),
        "{error}"
    );

    let entity = "<ScenarioObject name=\"Ego\"><Vehicle vehicleCategory=\"car\"><BoundingBox>\
                  <Center x=\"1.4\" y=\"0\" z=\"0.7\"/><Dimensions length=\"5\" width=\"2\" height=\"1.5\"/></BoundingBox></Vehicle></ScenarioObject>";
    let xosc = format!(
        "<OpenSCENARIO>\n<FileHeader revMajor=\"1\" revMinor=\"0\"/>\n<Entities>{entity}</Entities>\n\
         <Storyboard><Init><Actions/></Init></Storyboard>\n</OpenSCENARIO>"
    );
    fs::write(at.join("a.xosc"), &xosc).unwrap();
    let error = refused(&["twin", "map", "import", "a.xosc", "--out", "b.map.json"], at);
    assert!(error.contains("a.xosc is OpenSCENARIO: `wildcity scenario import`"), "{error}");
    let capital = ["scenario", "import", "a.xosc", "--twin", "street", "--out", "A.json"];
    assert!(refused(&capital, at).contains("\"A\" is no name"), "what check would refuse");
    let import = ["scenario", "import", "a.xosc", "--twin", "street", "--out", "a.json"];
    assert!(done(&import, at).contains("wildcity scenario check"));
    let file: Value = serde_json::from_slice(&fs::read(at.join("a.json")).unwrap()).unwrap();
    assert_eq!((&file["name"], &file["twin"]["name"]), (&json!("a"), &json!("street")));
    fs::write(at.join("a.xosc"), xosc.replace("<Actions/>", "<Actions><GlobalAction/></Actions>"))
        .unwrap();
    let error = refused(&import, at);
    assert!(error.contains("line 4, <GlobalAction>"), "{error}");
}
