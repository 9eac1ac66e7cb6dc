//! `--cpu-through` and `wildcity dev bisect` on the command line.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use tempfile::TempDir;

use crate::gpu::assert_quiet;
use crate::scene_files::{inria_columns, ply};
use crate::streets::street;

/// A directory with a scene file of a street, and a list of two cameras in it.
fn scene() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("street.ply"), ply(&street(5_000, 1, 51), &inria_columns(1, true)))
        .unwrap();
    let camera = |name: &str, z: f64| {
        format!(
            r#"{{"name": "{name}", "width": 120, "height": 80, "fx": 100, "fy": 100, "cx": 60,
            "cy": 40, "position": [0, 0, {z}], "R_world_to_cam": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}}"#
        )
    };
    let cameras = format!("[{}, {}]", camera("near", 20.0), camera("far", 60.0));
    fs::write(dir.path().join("cameras.json"), cameras).unwrap();
    dir
}

fn run(dir: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    command.current_dir(dir).args(arguments).args(["street.ply", "--cameras", "cameras.json"]);
    command.output().unwrap()
}

fn said(output: &Output) -> String {
    assert_quiet(output);
    String::from_utf8(output.stdout.clone()).unwrap()
}

#[test]
fn bisect_reports_every_camera() {
    let dir = scene();
    let said = said(&run(dir.path(), &["dev", "bisect"]));
    let lines: Vec<Vec<&str>> =
        said.lines().map(|line| line.split_whitespace().collect()).collect();
    assert_eq!(lines[1], ["cpu", "through", "none", "project", "sort", "bin"]);
    assert_eq!(lines.len(), 4, "{said}");
    for (line, name) in lines[2..].iter().zip(["near", "far"]) {
        assert!(line[0] == name && line.last() == Some(&"right"), "{said}");
        let db: Vec<f64> = line[1..5].iter().map(|db| db.parse().unwrap()).collect();
        assert!(db.iter().all(|db| *db >= 70.0), "{said}");
    }
}

#[test]
fn a_frame_can_begin_on_the_cpu() {
    let dir = scene();
    let stdout = said(&run(dir.path(), &["render", "--out", "half", "--cpu-through", "bin"]));
    assert_eq!(stdout, "half/near.png\nhalf/far.png\n");
}

#[test]
fn cpu_through_requires_the_gpu_backend() {
    let dir = scene();
    let arguments = ["render", "--out", "half", "--backend", "cpu", "--cpu-through", "sort"];
    let output = run(dir.path(), &arguments);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && error.contains("--backend"), "{error}");
    assert!(!dir.path().join("half").exists());
}
