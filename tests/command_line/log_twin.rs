//! From a log into twins, trainers' formats and scenarios.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use serde_json::Value;
use wildcity_log::{Log, check};
use wildcity_scene::Trajectory;

use crate::log::{Street, street};
use crate::scene_files::{gaussians, inria_columns, ply};

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// Mean PSNR of the images of an evaluation.
fn psnr_db(street: &Street, out: &str) -> f64 {
    json(&street.at(out).join("eval.json"))["all"]["psnr_db"].as_f64().unwrap()
}

#[test]
fn a_log_is_split_into_logs_with_marks() {
    let street = street();
    let said = street.done(&[
        "log",
        "split",
        "log",
        "--out",
        "parts",
        "--chunk-m",
        "20",
        "--keyframe-m",
        "2",
        "--length-m",
        "10,25",
    ]);
    assert!(said.contains("log-0002: 40 to 50 m"), "{said}");
    let split = json(&street.at("parts/split.json"));
    let chunks = split["chunks"].as_array().unwrap();
    assert_eq!(chunks.len(), 3, "{split:#}");
    let mut times = BTreeSet::new();
    let [mut images, mut held_out] = [0, 0];
    for chunk in chunks {
        let folder = street.at("parts").join(chunk["name"].as_str().unwrap());
        let log = Log::open(&folder).unwrap();
        for row in log.images().unwrap().unwrap() {
            let row = row.unwrap();
            assert!(log.path(&row.file).is_file(), "{row:?}");
            assert!(times.insert((row.camera.clone(), row.time_us)), "twice: {row:?}");
            images += 1;
            held_out += usize::from(row.held_out);
        }
        let report = check::check(&log, &check::CheckSettings::default(), &mut |_, _| {}).unwrap();
        assert!(!report.has_errors(), "{:?}", report.findings);
        assert!(report.coverage.iter().all(|camera| camera.unplaced == 0), "{:?}", report.coverage);
    }
    // 10 m/s and 10 Hz: every second image, 25 of each camera, and of them 1, 9, 17 and 25.
    assert_eq!((images, held_out), (6 * 25, 6 * 4));
    let drives = split["drives"].as_array().unwrap();
    assert_eq!(drives.len(), 4 + 1, "{drives:#?}");
    let drive: Trajectory =
        serde_json::from_value(json(&street.at("parts/drives/log-25m-0000.json"))).unwrap();
    assert!((drive.length_m() - 25.0).abs() < 1e-6, "{}", drive.length_m());
    // Its 50 m are two chunks of 25 m, and no third one of nothing.
    street.done(&["log", "split", "log", "--out", "halves", "--chunk-m", "25"]);
    let halves = json(&street.at("halves/split.json"));
    assert_eq!(halves["chunks"].as_array().unwrap().len(), 2, "{halves:#}");
    let again = street.refused(&["log", "split", "log", "--out", "parts"]);
    assert!(again.contains("parts exists"), "{again}");
}

#[test]
fn a_twin_is_compared_with_the_log_and_with_what_is_exported_of_it() {
    let street = street();
    let eval = |options: &[&str], out: &str| {
        let all = ["eval", "town", "--backend", "cpu", "--show", "0", "--out", out];
        street.done(&[&all[..], options].concat())
    };
    let said = eval(&["--log", "log"], "eval-log");
    assert!(said.contains("mean of 37 images") && said.contains("LiDAR points"), "{said}");
    // JPEG of quality 92, without the pixels of moving objects.
    let from_log_db = psnr_db(street, "eval-log");
    assert!(from_log_db > 30.0, "{from_log_db}");
    let evaluation = json(&street.at("eval-log/eval.json"));
    let lidar_m = evaluation["all"]["lidar"]["median_m"].as_f64().unwrap();
    // A Gaussian of the road has the depth of its middle: some tenths of a metre at grazing angles.
    assert!(lidar_m < 0.6, "{lidar_m}");

    street.done(&["log", "export", "log", "--out", "capture", "--points", "5000"]);
    let boxes = ["--boxes", "capture/boxes.jsonl", "--every", "8"];
    eval(&[&["--images", "capture/cameras.jsonl"], &boxes[..]].concat(), "eval-list");
    let from_list_db = psnr_db(street, "eval-list");
    assert!((from_list_db - from_log_db).abs() < 0.01, "{from_list_db} and {from_log_db}");
    let identity = ["--axes", "identity", "--every", "8"];
    for source in ["capture/transforms.json", "capture/sparse/0"] {
        eval(&[&["--images", source], &identity[..]].concat(), "eval-capture");
        // Moving objects count here.
        let capture_db = psnr_db(street, "eval-capture");
        assert!(capture_db > 25.0, "{source}: {capture_db}");
    }
    let points = fs::read_to_string(street.at("capture/sparse/0/points3D.txt")).unwrap();
    let points: Vec<&str> = points.lines().filter(|line| !line.starts_with('#')).collect();
    assert_eq!(points.len(), 5000);
    let heights = points.iter().map(|line| line.split(' ').nth(3).unwrap().parse::<f64>().unwrap());
    assert!(
        heights.clone().all(|z_m| (-1.0..30.0).contains(&z_m)),
        "{:?}",
        heights.max_by(f64::total_cmp)
    );
}

#[test]
fn a_twin_takes_drive_rig_images_and_place_from_a_log() {
    let street = street();
    let columns = inria_columns(0, false);
    fs::write(street.at("scene.ply"), ply(&gaussians(500, 0, 30.0, 1), &columns)).unwrap();
    let said = street.done(&[
        "import",
        "scene.ply",
        "--twin",
        "recorded",
        "--axes",
        "identity",
        "--log",
        "log",
    ]);
    assert!(said.contains("version 2") && said.contains("recorded images"), "{said}");
    let shown: Value =
        serde_json::from_str(&street.done(&["twin", "show", "recorded", "--json"])).unwrap();
    let manifest = &shown["manifest"];
    assert_eq!(manifest["geo"]["latitude_deg"], 52.5162, "{manifest:#}");
    assert_eq!(manifest["rig"]["cameras"][1]["name"], "front_left");
    assert_eq!(manifest["trajectories"][0]["keyframes"].as_array().unwrap().len(), 101);
    // One image of each camera every 2 m of 50 m.
    assert_eq!(manifest["views"]["images"], 149);
    let said = street.refused(&["import", "scene.ply", "--twin", "none", "--log", "data"]);
    assert!(said.contains("data is no log"), "{said}");

    street.done(&[
        "scenario",
        "from-log",
        "log",
        "--twin",
        "recorded",
        "--at",
        "1.5",
        "--duration",
        "2",
        "--out",
        "replay.json",
    ]);
    let shown: Value =
        serde_json::from_str(&street.done(&["scenario", "show", "replay.json"])).unwrap();
    let scenario = &shown["scenario"];
    assert_eq!(scenario["tracks"]["start_us"], 1_500_000);
    let station_m = scenario["ego"]["start"]["station_m"].as_f64().unwrap();
    assert!((station_m - 15.0).abs() < 0.1, "{station_m}");
    let speed = scenario["ego"]["dynamics"]["speed"].as_f64().unwrap();
    assert!((speed - 10.0).abs() < 0.2, "{speed}");
    let tracks = json(&street.at("replay.tracks.json"));
    let ids: Vec<&Value> =
        tracks["tracks"].as_array().unwrap().iter().map(|one| &one["id"]).collect();
    assert_eq!(ids, ["pedestrian", "sedan", "van"]);
    let late = street.refused(&[
        "scenario",
        "from-log",
        "log",
        "--twin",
        "recorded",
        "--at",
        "99",
        "--out",
        "late.json",
    ]);
    assert!(late.contains("--at 99: the log has poses from 0 to 4.99 s"), "{late}");
    assert!(!street.at("late.json").exists());
}
