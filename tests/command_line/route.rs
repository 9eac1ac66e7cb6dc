//! `wildcity twin route`, file in, file out.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use wildcity_scene::Trajectory;

use crate::drives::straight;

fn route(arguments: &[&str], dir: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    command.args(["twin", "route"]).args(arguments).current_dir(dir).output().unwrap()
}

fn done(arguments: &[&str], dir: &Path) -> String {
    let output = route(arguments, dir);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn refused(arguments: &[&str], dir: &Path) -> String {
    let output = route(arguments, dir);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {output:?}");
    String::from_utf8(output.stderr).unwrap()
}

fn read(path: &Path) -> Trajectory {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn a_drive_is_measured_thinned_cut_and_matched() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    fs::write(at.join("log.json"), serde_json::to_vec(&straight(6_000)).unwrap()).unwrap();
    fs::write(at.join("times.json"), "[50000, 100000, 333333]").unwrap();

    let report: Value =
        serde_json::from_str(&done(&["measure", "log.json", "--json"], at)).unwrap();
    assert_eq!(report["length_m"], 6000.0);
    assert_eq!(report["chunks"][1]["keyframes"], serde_json::json!([5000, 6001]));
    assert!(done(&["measure", "log.json"], at).contains("6001 keyframes, 6000.0 m in 600.0 s"));

    done(&["subsample", "log.json", "--step-m", "3", "--out", "thin.json"], at);
    assert_eq!(read(&at.join("thin.json")).keyframes.len(), 2001);

    done(&["cut", "log.json", "--out", "cuts"], at);
    let index: Value =
        serde_json::from_slice(&fs::read(at.join("cuts/index.json")).unwrap()).unwrap();
    let names: Vec<_> = index["cuts"].as_array().unwrap().iter().map(|cut| &cut["name"]).collect();
    // 120 + 24 + 12 + 6 + 2 + 1.
    assert_eq!(names.len(), 165);
    let last = read(&at.join("cuts/log-5km-0000.json"));
    assert_eq!((last.check(), last.length_m()), (Ok(()), 5000.0));
    assert_eq!(fs::read_dir(at.join("cuts")).unwrap().count(), 166);

    let times = ["--times", "times.json"];
    let report =
        done(&["associate", "log.json", times[0], times[1], "--tolerance-us", "40000"], at);
    let report: Value = serde_json::from_str(&report).unwrap();
    assert_eq!(report["alone_us"], serde_json::json!([50000]));
    assert_eq!(report["pairs"][1]["keyframe"], 3);
    assert_eq!(report["residual_us_largest"], 33_333);

    done(&["interpolate", "log.json", times[0], times[1], "--out", "at.json"], at);
    let found: Vec<f64> =
        read(&at.join("at.json")).keyframes.iter().map(|k| k.world_from_rig.position_m.x).collect();
    assert_eq!(found, [0.5, 1.0, 3.33333]);
}

#[test]
fn invalid_requests_are_refused_and_nothing_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    fs::write(at.join("log.json"), serde_json::to_vec(&straight(10)).unwrap()).unwrap();
    fs::write(at.join("late.json"), "[1000001]").unwrap();
    fs::write(at.join("words.json"), "[\"noon\"]").unwrap();
    fs::write(
        at.join("endless.json"),
        r#"{"name": "log", "keyframes": [
            {"time_us": 0, "world_from_rig": {"xyz": [1e400, 0, 0], "q": [1, 0, 0, 0]}}]}"#,
    )
    .unwrap();
    let out = ["--out", "out.json"];
    let told = refused(&["interpolate", "log.json", "--times", "late.json", out[0], out[1]], at);
    assert!(told.contains("1000001 µs") && told.contains("not extrapolated"), "{told}");
    let told = refused(&["interpolate", "log.json", "--times", "words.json", out[0], out[1]], at);
    assert!(told.contains("words.json") && told.contains("whole microseconds"), "{told}");
    let told = refused(&["measure", "endless.json"], at);
    assert!(told.contains("endless.json"), "{told}");
    let told = refused(&["subsample", "log.json", "--step-m", "nan", out[0], out[1]], at);
    assert!(told.contains("step_m is NaN"), "{told}");
    assert!(!at.join("out.json").exists());
    let told = refused(&["cut", "log.json", "--length-m", "2,5,2.0001", "--out", "cuts"], at);
    assert!(told.contains("--length-m") && told.contains("2m"), "{told}");
    assert!(!at.join("cuts").exists());
}
