//! `wildcity report --repair`, and reports without it.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use serde_json::Value;

use crate::onnx_models::library;
use crate::reported::{commit, drive};
use crate::root::root;

fn report(dir: &Path, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    command.args(["report", "street", "--backend", "cpu", "--stations", "2", "--window", "32"]);
    command.args(["--repeat", "1", "--no-stress", "--twins"]).arg(dir).arg("--out");
    command.arg(dir.join("report")).args(more);
    command
}

fn read(dir: &Path, name: &str) -> String {
    fs::read_to_string(dir.join("report").join(name)).unwrap()
}

fn said(output: &Output) -> String {
    let all = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    all.concat()
}

/// The keys of a report, as they were before there was repair.
const KEYS: [&str; 14] = [
    "backends",
    "believed",
    "exact_rays_ms",
    "left_out",
    "needed",
    "places",
    "recommendation",
    "reference_ms",
    "sampling",
    "settings",
    "stress",
    "subject",
    "unmet",
    "wanted",
];

#[test]
fn without_models_nothing_of_repair_is_loaded_or_written() {
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), vec![drive()]);
    let mut command = report(dir.path(), &[]);
    command.env("ORT_DYLIB_PATH", library()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut running = command.spawn().unwrap();
    let mut looks = 0;
    while running.try_wait().unwrap().is_none() {
        let maps = fs::read_to_string(format!("/proc/{}/maps", running.id())).unwrap_or_default();
        assert!(!maps.contains("onnxruntime"), "{maps}");
        looks += usize::from(maps.contains("wildcity"));
        std::thread::sleep(Duration::from_millis(20));
    }
    let output = running.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", said(&output));
    assert!(looks > 3, "looked {looks} times");
    let report: Value = serde_json::from_str(&read(dir.path(), "report.json")).unwrap();
    let keys: Vec<&str> = report.as_object().unwrap().keys().map(String::as_str).collect();
    assert_eq!(keys, KEYS);
    assert!(!read(dir.path(), "report.html").contains("Repair:"));
    assert!(!said(&output).contains("repair"), "{}", said(&output));
}

#[test]
fn with_a_model_the_page_has_a_section_and_losses_are_said() {
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), vec![drive()]);
    let model = root().join("scenes/repair.json").display().to_string();
    let library = library().display().to_string();
    // Here the twin itself is the ground truth, so every change is a loss.
    let given = ["--repair", &model, "--onnxruntime", &library, "--truth", "street"];
    let offsets = ["--offsets", "3,1", "--repair-side", "96"];
    let output = report(dir.path(), &[&given[..], &offsets[..]].concat()).output().unwrap();
    let text = said(&output);
    assert!(output.status.success(), "{text}");
    assert!(text.contains("street-repair: no trust is recommended"), "{text}");
    let report: Value = serde_json::from_str(&read(dir.path(), "report.json")).unwrap();
    let repair = &report["repair"];
    let rows = repair["rows"].as_array().unwrap();
    let shown: Vec<(f64, &str)> = rows
        .iter()
        .map(|row| (row["offset_m"].as_f64().unwrap(), row["name"].as_str().unwrap()))
        .collect();
    let kinds = ["rendered", "warped", "street-repair"];
    let wanted: Vec<(f64, &str)> =
        [0.0, 1.0, 3.0].iter().flat_map(|m| kinds.map(|kind| (*m, kind))).collect();
    assert_eq!(shown, wanted);
    assert!(rows.iter().skip(2).step_by(3).all(|row| row["gain_db"].as_f64().unwrap() < 0.0));
    assert!(rows.iter().all(|row| row["images"] == 4));
    assert_eq!(repair["subject"]["size_px"], serde_json::json!([96, 64]));
    assert_eq!(repair["subject"]["truth"]["twin"], "street");
    assert_eq!(repair["below"][0]["below"], Value::Null);
    let page = read(dir.path(), "report.html");
    assert!(page.contains("<h2>Repair: error against run time</h2>"));
    assert!(page.contains("class=\"miss\">street-repair: no trust is recommended"), "{text}");
}

#[test]
fn options_of_repair_need_a_model_and_are_checked_first() {
    let nowhere = tempfile::tempdir().unwrap();
    for (given, fix) in [
        (&["--truth", "street"][..], "--repair"),
        (&["--repair", "m.json", "--offsets=-1"], "expected 0 to 100 m, for example 3"),
        (&["--repair", "m.json", "--repair-side", "4"], "16..=8192"),
    ] {
        let refused = report(nowhere.path(), given).output().unwrap();
        let text = said(&refused);
        assert!(!refused.status.success() && text.contains(fix), "{given:?}: {text}");
        assert!(!nowhere.path().join("report").exists());
    }
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), vec![drive()]);
    let refused = report(dir.path(), &["--repair", "nowhere.json"]).output().unwrap();
    assert!(said(&refused).contains("nowhere.json: No such file"), "{}", said(&refused));
    let model = root().join("scenes/repair.json").display().to_string();
    let library = library().display().to_string();
    let given = ["--repair", &model, "--onnxruntime", &library, "--truth", "missing"];
    let refused = report(dir.path(), &given).output().unwrap();
    assert!(said(&refused).contains("--truth missing"), "{}", said(&refused));
}
