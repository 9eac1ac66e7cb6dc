//! `wildcity-bench gpu` with small scenes: the content of its report, not the speed.

use serde_json::Value;

use crate::bench;
use crate::gpu::assert_quiet;

fn report(gaussians: &str, more: &[&str]) -> String {
    let mut command = bench("gpu");
    command.args(["--gaussians", gaussians, "--repeat", "1"]).args(more);
    let output = command.output().unwrap();
    assert_quiet(&output);
    String::from_utf8(output.stdout).unwrap()
}

const STAGES: [&str; 6] = ["project", "sort", "bin", "tile sort", "expand", "rasterize"];

#[test]
fn a_report_has_every_stage_beside_its_rooflines() {
    let report: Value = serde_json::from_str(&report("20,3000", &["--json"])).unwrap();
    let number = |value: &Value| value.as_f64().unwrap();
    let bytes_per_s = number(&report["roofline"]["bytes_per_s"]);
    let multiply_adds_per_s = number(&report["roofline"]["multiply_adds_per_s"]);
    assert!(bytes_per_s > 1e8 && multiply_adds_per_s > 1e8, "{report}");
    let scenes = report["scenes"].as_array().unwrap();
    assert_eq!(scenes.len(), 2);
    for (scene, gaussians) in scenes.iter().zip([20, 3000]) {
        assert_eq!(scene["gaussians"], gaussians);
        let count = |name: &str| scene[name].as_u64().unwrap();
        let (pairs, touches) = (count("visible_pairs"), count("touches"));
        assert!(pairs > gaussians / 2 && pairs < touches, "{scene}");
        assert!(touches < count("instances") && count("instances") < count("evaluations"));
        let stages = scene["stages"].as_array().unwrap();
        let names: Vec<&str> = stages.iter().map(|s| s["stage"].as_str().unwrap()).collect();
        assert_eq!(names, STAGES);
        for stage in stages {
            let (bytes, memory_ms) = (number(&stage["bytes"]), number(&stage["memory_ms"]));
            assert!((memory_ms * bytes_per_s / (1e3 * bytes) - 1.0).abs() < 1e-9, "{stage}");
            let rasterizes = stage["stage"] == "rasterize";
            assert_eq!(number(&stage["arithmetic_ms"]) > 0.0, rasterizes, "{stage}");
            assert!(number(&stage["device_ms"]) > 0.0, "{stage}");
        }
        assert_eq!([&scene["frames"], &scene["parts"], &scene["retries"]], [1, 1, 0]);
        let host = scene["host_ms"].as_array().unwrap();
        assert_eq!(host.last().unwrap()[0], "unaccounted");
        let host_ms: f64 = host.iter().map(|row| number(&row[1])).sum();
        let device_ms: f64 = stages.iter().map(|stage| number(&stage["device_ms"])).sum();
        assert!((host_ms + device_ms - number(&scene["step_ms"])).abs() < 1e-6, "{scene}");
        // Four passes over 31 bits: 4 + 16 B per key, and 256 counters of 20 B per 4,096 keys.
        let sorted = 4 * (20 * pairs + 20 * 256 * pairs.div_ceil(4096));
        assert_eq!(stages[1]["bytes"], sorted);
        // 6,717,120 px of 3 B.
        assert!(number(&stages[5]["bytes"]) > 3.0 * 6_717_120.0);
        assert!(number(&scene["cpu_step_ms"]) > 0.0);
        let (equal, db) = (&scene["images_equal"], &scene["psnr_db"]);
        assert!(*equal == true || db.as_f64().is_some_and(|db| db > 60.0), "{scene}");
    }
}

#[test]
fn tables_are_markdown() {
    let said = report("20,1000", &["--no-cpu"]);
    assert!(said.contains("GB/s, ") && said.contains("\n1,000 Gaussians ("), "{said}");
    let rows = |name: &str| said.lines().filter(|line| line.starts_with(name)).count();
    for stage in STAGES {
        assert_eq!(rows(&format!("| {stage} |")), 2, "{stage}: {said}");
    }
    assert_eq!((rows("| **device** |"), rows("| **step** |"), rows("Goal 4.7 ms")), (2, 2, 2));
    for row in ["- device time / goal: ", "- step / goal: ", "| unaccounted (host) |"] {
        assert_eq!(rows(row), 2, "{row}: {said}");
    }
    assert!(!said.contains("cpu backend") && !said.contains("Warning"), "{said}");
    for row in said.lines().filter(|line| line.starts_with('|')) {
        assert_eq!(row.matches('|').count(), 7, "{row}");
    }
}
