//! `wildcity-bench step` and `load`.

use std::fs;

use serde_json::Value;
use tempfile::TempDir;

use crate::gpu::assert_quiet;
use crate::scene_files::{inria_columns, ply};
use crate::streets::street;
use crate::{CITY, bench};

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

#[test]
fn a_step_can_begin_on_the_cpu() {
    let dir = scene();
    let step = |more: &[&str]| {
        let mut command = bench("step");
        command.current_dir(dir.path()).args(["street.ply", "--cameras", "cameras.json"]);
        let output = command.args(["--repeat", "1", "--json"]).args(more).output().unwrap();
        assert_quiet(&output);
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    let (cpu, half) = (step(&["--backend", "cpu"]), step(&["--cpu-through", "sort"]));
    assert_eq!(half["backend"], "cpu+gpu");
    assert!(half["detail"].as_str().unwrap().contains("through sort"), "{half}");
    let stages = half["stages_ms"].as_object().unwrap();
    assert!(["project", "sort"].iter().all(|stage| stages.contains_key(*stage)), "{half}");
    for count in ["visible_pairs", "instances"] {
        assert_eq!(cpu[count], half[count]);
    }
}

#[test]
fn a_load_is_compared_with_the_bare_bytes() {
    let mut command = bench("load");
    command.args(["city", "--repeat", "1", "--twins"]).arg(CITY.dir.path());
    let output = command.output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && said.contains("bare bytes"), "{said}");
}
