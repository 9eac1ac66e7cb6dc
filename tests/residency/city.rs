//! A city, driven from end to end with memory for a small part of it.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;
use wildcity::generate::{self, CitySettings};
use wildcity::residency::Cache;
use wildcity::scene::manifest::Provenance;
use wildcity::scene::route::Route;
use wildcity::scene::{Rig, Trajectory};
use wildcity::store::{Catalog, CommitKind, StorageOptions, VersionSettings};

use crate::{PROFILE, bytes, eyes, pixels, views};

struct City {
    dir: tempfile::TempDir,
    drive: Trajectory,
}

/// Two thin kilometres, all levels of detail.
fn city() -> &'static City {
    static CITY: OnceLock<City> = OnceLock::new();
    CITY.get_or_init(|| {
        let settings =
            CitySettings { seed: 3, length_m: 2_000.0, millions_per_km: 1.0, speed_m_s: 30.0 };
        let dir = tempfile::tempdir().unwrap();
        let catalog = Catalog::open(dir.path()).unwrap();
        let mut commit =
            catalog.begin("city", CommitKind::Import, StorageOptions::default()).unwrap();
        for cell in generate::city(&settings).unwrap() {
            commit.put(&cell.gaussians, None, &mut |_, _| {}).unwrap();
        }
        let drive = generate::city_drive(&settings).unwrap();
        let settings = VersionSettings {
            profile: PROFILE,
            rig: Rig::preset("vehicle6"),
            trajectories: vec![drive.clone()],
            sky: None,
            provenance: Provenance::of("test".into()),
        };
        commit.replace(None, settings).unwrap();
        City { dir, drive }
    })
}

#[test]
fn two_kilometres_in_the_memory_of_their_worst_frame_look_as_with_all_of_it() {
    let City { dir, drive } = city();
    let open = |limit_bytes: Option<u64>| {
        let cache = Cache::limited(Catalog::open(dir.path()).unwrap(), limit_bytes);
        let resident = cache.open("city", None).unwrap();
        (cache, resident)
    };
    let (_all, whole) = open(None);
    let route = Route::new(drive).unwrap();
    let poses: Vec<_> =
        (0..=50).map(|i| route.at(f64::from(i) * route.length_m() / 50.0).world_from_rig).collect();
    let need = |pose| bytes(&whole, &whole.demand(&eyes(&views(pose)), &PROFILE));
    let limit_bytes = poses.iter().map(|&pose| need(pose)).max().unwrap();
    assert!(8 * limit_bytes < whole.total_bytes(), "{limit_bytes} of {}", whole.total_bytes());

    let (cache, resident) = open(Some(limit_bytes));
    for pose in poses {
        let eyes = eyes(&views(pose));
        let scene = resident.scene(&eyes, &PROFILE).unwrap();
        let held_bytes = cache.stats().held_bytes;
        assert!(held_bytes <= limit_bytes, "{held_bytes} of {limit_bytes}");
        let truth = whole.scene(&eyes, &PROFILE).unwrap();
        assert_eq!(pixels(&scene, pose), pixels(&truth, pose), "at {:?}", pose.position_m);
    }
    let stats = cache.stats();
    assert!(stats.evictions > 1000, "{stats:?}");
}

#[test]
fn a_timed_drive_tells_of_every_kilometre_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let report = bench_drive(
        dir.path(),
        &["--crop", "16", "--memory-gib", "0.2", "--unpaced", "--from-m", "900", "--steps", "60"],
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
    assert_eq!(limit_bytes, (0.2 * f64::from(1 << 30)) as u64);
    let held_bytes = count("all", "held_bytes_max");
    assert!(held_bytes > 0 && held_bytes <= limit_bytes, "{held_bytes} of {limit_bytes}");
    assert!(report["peak_rss_bytes"].as_u64().unwrap() > held_bytes);

    let csv = fs::read_to_string(dir.path().join("steps.csv")).unwrap();
    assert_eq!(csv.lines().count(), 1 + 60 + 5);
    assert_eq!(csv.lines().filter(|line| line.starts_with("teleport,")).count(), 5);
    // The episode that a session writes is gone.
    let left: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left, ["steps.csv"]);
}

/// What `wildcity bench drive` says, with 5 teleports and a CSV file.
fn bench_drive(dir: &Path, arguments: &[&str]) -> Value {
    let output = Command::new(env!("CARGO_BIN_EXE_wildcity"))
        .args(["bench", "drive", "city", "--backend", "cpu", "--json", "--teleports", "5"])
        .args(arguments)
        .arg("--twins")
        .arg(city().dir.path())
        .arg("--csv")
        .arg(dir.join("steps.csv"))
        .env("TMPDIR", dir)
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    serde_json::from_slice(&output.stdout).unwrap()
}
