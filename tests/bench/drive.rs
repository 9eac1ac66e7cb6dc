//! `wildcity-bench drive` along a city.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::{CITY, bench};

#[test]
fn a_timed_drive_reports_every_kilometre_and_leaves_no_files() {
    let dir = tempfile::tempdir().unwrap();
    let report = drive(
        dir.path(),
        &["--crop", "16", "--memory-gib", "0.13", "--unpaced", "--from-m", "900", "--steps", "60"],
    );
    let count = |of: &str, field: &str| report[of][field].as_u64().unwrap();
    assert_eq!(count("all", "steps"), 60);
    // 900 to 1,080 m: 33 steps of 3 m, the one that ends on 1,000 m being on the other side.
    let kilometres = report["kilometres"].as_array().unwrap();
    let steps: Vec<_> = kilometres.iter().map(|row| row["steps"].as_u64().unwrap()).collect();
    assert_eq!(steps, [33, 27]);
    assert_eq!(count("teleports", "steps"), 5);
    assert!(count("teleports", "loads") > 0);
    let limit_bytes = report["limit_bytes"].as_u64().unwrap();
    assert_eq!(limit_bytes, (0.13 * f64::from(1 << 30)) as u64);
    let held_bytes = count("all", "held_bytes_max");
    assert!(held_bytes > 0 && held_bytes <= limit_bytes, "{held_bytes} of {limit_bytes}");
    assert!(report["peak_rss_bytes"].as_u64().unwrap() > held_bytes);

    let csv = fs::read_to_string(dir.path().join("steps.csv")).unwrap();
    assert_eq!(csv.lines().count(), 1 + 60 + 5);
    assert_eq!(csv.lines().filter(|line| line.starts_with("teleport,")).count(), 5);
    // The file of the recorded episode was removed.
    let left: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left, ["steps.csv"]);
}

/// The JSON output of `wildcity-bench drive`, with 5 teleports and a CSV file.
fn drive(dir: &Path, arguments: &[&str]) -> Value {
    let output = bench("drive")
        .args(["city", "--backend", "cpu", "--json", "--teleports", "5"])
        .args(arguments)
        .arg("--twins")
        .arg(CITY.dir.path())
        .arg("--csv")
        .arg(dir.join("steps.csv"))
        .env("TMPDIR", dir)
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    serde_json::from_slice(&output.stdout).unwrap()
}
