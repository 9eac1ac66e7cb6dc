//! `wildcity report`: what is measured is so, and what is recommended holds.

use std::process::Command;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity::generate;
use wildcity::geometry::Pose;
use wildcity::render::Backend;
use wildcity::render::cpu::{Cpu, Simd};
use wildcity::report::choose::{Wanted, front, recommend};
use wildcity::report::ladder::ladder;
use wildcity::report::measure::{Bench, Measured};
use wildcity::report::places::{OFFSETS_M, Sampling, places};
use wildcity::report::{ReportError, needed};
use wildcity::residency::{Cache, Resident};
use wildcity::scene::manifest::Provenance;
use wildcity::scene::rig::RigCamera;
use wildcity::scene::trajectory::{Keyframe, Trajectory};
use wildcity::scene::{Record, RenderProfile, Rig};
use wildcity::store::{Catalog, NewVersion, Storage};

/// Two cameras of a twin whose levels are seen: a street of 40 m, 30,000 Gaussians.
fn commit(dir: &std::path::Path, trajectories: Vec<Trajectory>) -> Arc<Resident> {
    let catalog = Catalog::open(dir).unwrap();
    let street = generate::canyon(30_000, &mut |_, _| {});
    let new = NewVersion {
        // Full detail, so that other errors are seen alone.
        profile: RenderProfile { tau_px: 0.0, ..RenderProfile::DEFAULT },
        rig: Some(rig()),
        trajectories,
        storage: Storage { record: Record::F32, levels: true },
        ..NewVersion::of("street", &street, Provenance::of("test".to_owned()))
    };
    catalog.commit(new, &mut |_, _| {}).unwrap();
    Cache::new(catalog).open("street", None).unwrap()
}

fn rig() -> Rig {
    let mut rig = Rig::preset("vehicle6").unwrap();
    rig.cameras.truncate(2);
    for RigCamera { camera, .. } in &mut rig.cameras {
        (camera.width_px, camera.height_px) = (120, 80);
        let p = &mut camera.pinhole;
        (p.fx, p.fy, p.cx, p.cy) = (110.0, 110.0, 60.0, 40.0);
    }
    rig
}

fn drive() -> Trajectory {
    let keyframe = |i: i64| Keyframe {
        time_us: 100_000 * i,
        world_from_rig: Pose {
            position_m: DVec3::new(i as f64 - 20.0, 0.0, 0.0),
            rotation: DQuat::IDENTITY,
        },
    };
    Trajectory { name: "log".to_owned(), keyframes: (0..40).map(keyframe).collect() }
}

/// Every setting of the ladder on the cpu backend, at three stations.
fn measured(resident: &Arc<Resident>) -> Vec<Measured> {
    let sampling = Sampling { stations: 3, window_px: [64, 48] };
    let manifest = &resident.version.manifest;
    let places = places(manifest, &rig().cameras, sampling);
    let backends: Vec<Box<dyn Backend>> = vec![Box::new(Cpu::new(2, Simd::Best).unwrap())];
    let bench = Bench { resident, backends: &backends, places: &places, repeat: 2 };
    let truth = bench.truth(&mut |_| {}).unwrap();
    assert!(truth.step_ms > 0.0);
    let settings = ladder(&manifest.profile, manifest.record, &["cpu"]);
    settings.iter().map(|setting| bench.measure(setting, &truth).unwrap()).collect()
}

#[test]
fn errors_and_costs_go_the_way_they_must() {
    let dir = tempfile::tempdir().unwrap();
    let all = measured(&commit(dir.path(), vec![drive()]));
    let of = |name: &str| all.iter().find(|m| m.setting.name == name).unwrap();
    let db = |name: &str| of(name).errors.psnr_db;
    // Full detail on the cpu backend is what the reference draws.
    assert!(db("as served") >= 70.0, "{:?}", of("as served").errors);
    for falling in [
        &["as served", "tau_px=2", "tau_px=4"][..],
        &["as served", "record q32", "record q24"],
        &["as served", "alpha_cut=0.008", "alpha_cut=0.016", "alpha_cut=0.032"],
        &["as served", "stop=0.004", "stop=0.016"],
        &["as served", "8 bits", "jpeg 98", "jpeg 90", "jpeg 75", "jpeg 50"],
        &["as served", "scale 0.5", "scale 0.25"],
    ] {
        assert!(
            falling.windows(2).all(|w| db(w[0]) > db(w[1])),
            "{falling:?}: {:?}",
            falling.iter().map(|name| db(name)).collect::<Vec<_>>()
        );
    }
    // Rounding alone is uniform over a step: 20 log10(255 √12) is 58.9 dB.
    assert!((db("8 bits") - 58.9).abs() < 1.5, "{}", db("8 bits"));
    assert!(of("tau_px=4").cost.gaussians < of("as served").cost.gaussians);
    assert!(of("jpeg 50").cost.sent_bytes < of("jpeg 90").cost.sent_bytes);
    assert_eq!(of("8 bits").cost.sent_bytes, 2 * 3 * 120 * 80);
    assert_eq!(of("scale 0.5").cost.sent_bytes, 2 * 3 * 60 * 40);
    assert_eq!([of("as served"), of("record q32")].map(|m| m.cost.stored_bytes), [92.0, 31.875]);
    for m in &all {
        let errors = &m.errors;
        assert_eq!(m.psnr_db_by_offset.len(), OFFSETS_M.len(), "{}", m.setting.name);
        assert!(errors.p99_9 <= errors.max && errors.ssim <= 1.0, "{errors:?}");
        let least_db = m.least_db[0].min(m.least_db[1]);
        assert!(least_db <= errors.psnr_db, "{}: {least_db} dB, {errors:?}", m.setting.name);
        let files = &m.worst.files;
        assert!(files.iter().all(|file| file.starts_with(b"\x89PNG")), "{}", m.setting.name);
        assert!(m.cost.step_ms > 0.0);
    }
    assert!(front(&all).iter().any(|on| *on) && !front(&all).iter().all(|on| *on));

    let names = ["cpu".to_owned()];
    let best = recommend(Wanted::AtLeastDb(35.0), &all, &names).unwrap();
    let chosen = of(&best.setting);
    assert!(best.verified >= 35.0 && chosen.least_db[1] >= 35.0, "{best:?}");
    assert!(chosen.setting.can_be_served() && chosen.setting.scale == 1.0);
    let is_worse = |m: &&Measured| m.setting.can_be_served() && m.least_db[0] >= 36.0;
    assert!(all.iter().filter(is_worse).all(|m| m.cost.step_ms >= chosen.cost.step_ms));
    let too_much = recommend(Wanted::AtLeastDb(500.0), &all, &names).unwrap_err();
    assert!(matches!(too_much, ReportError::OutOfReach { .. }), "{too_much}");
    let too_fast = recommend(Wanted::AtMostMs(1e-6), &all, &names).unwrap_err();
    assert!(matches!(too_fast, ReportError::OutOfReach { .. }), "{too_fast}");
    let slowest = all.iter().map(|m| m.p95_ms[0].max(m.p95_ms[1])).fold(0.0, f64::max);
    let exact = recommend(Wanted::AtMostMs(10.0 * slowest), &all, &names).unwrap();
    assert_eq!(of(&exact.setting).least_db[0], best_db(&all), "{exact:?}");

    // What fails elsewhere is not recommended.
    let mut elsewhere = all.clone();
    elsewhere.iter_mut().for_each(|m| m.least_db[1] = 12.0);
    let refused = recommend(Wanted::AtLeastDb(35.0), &elsewhere, &names).unwrap_err();
    assert!(matches!(refused, ReportError::NotVerified { verified: 12.0, .. }), "{refused}");
}

fn best_db(all: &[Measured]) -> f64 {
    let servable = all.iter().filter(|m| m.setting.can_be_served());
    servable.map(|m| m.least_db[0]).fold(0.0, f64::max)
}

#[test]
fn a_setting_is_beaten_by_what_is_faster_and_closer() {
    let dir = tempfile::tempdir().unwrap();
    let mut all = measured(&commit(dir.path(), vec![drive()]));
    all.truncate(4);
    for (m, (ms, db)) in all.iter_mut().zip([(1.0, 30.0), (2.0, 40.0), (2.5, 40.0), (3.0, 35.0)]) {
        (m.cost.step_ms, m.errors.psnr_db) = (ms, db);
    }
    assert_eq!(front(&all), [true, true, false, false]);
    // Equals do not beat each other.
    all[2].cost.step_ms = 2.0;
    assert_eq!(front(&all), [true, true, true, false]);
}

#[test]
fn without_a_drive_a_twin_is_looked_at_from_around() {
    let dir = tempfile::tempdir().unwrap();
    let resident = commit(dir.path(), Vec::new());
    let sampling = Sampling { stations: 4, window_px: [64, 48] };
    let manifest = &resident.version.manifest;
    let places = places(manifest, &rig().cameras, sampling);
    assert_eq!(places.len(), 4);
    let bounds = manifest.bounds();
    for place in &places {
        let [view] = place.views[..] else { panic!("one camera") };
        let middle_m = 0.5 * (bounds.min_m + bounds.max_m);
        let seen = view.world_from_camera.inverse().transform_point(middle_m);
        let at = view.camera.pinhole.project(seen);
        assert!(seen.z > 0.0 && (at.x - 320.0).abs() < 1e-6 && (at.y - 240.0).abs() < 1e-6, "{at}");
    }
    assert_eq!(places.iter().filter(|place| place.chooses).count(), 2);
}

#[test]
fn the_base_pays_for_no_feature_of_others() {
    let cpu = Cpu::new(2, Simd::Best).unwrap();
    let rows = needed::rows(&cpu, &|| None).unwrap();
    let of = |with: &str| rows.iter().find(|row| row.with == with).unwrap().counts;
    let base = of("nothing else");
    // 14 columns of 4 B, and no more than 1 % of ends of blocks and clusters.
    assert!((56.0..58.0).contains(&base.host_bytes), "{base:?}");
    assert!((92.0..95.0).contains(&of("SH degree 1").host_bytes));
    assert!((236.0..242.0).contains(&of("SH degree 3").host_bytes));
    for alike in ["SH degree 1", "SH degree 3", "depth", "depth and opacity"] {
        assert_eq!(of(alike).evaluations, base.evaluations, "{alike}");
    }
    assert!(rows.iter().all(|row| row.counts.device.is_none()));
}

#[test]
fn the_command_writes_a_page_that_needs_nothing_and_a_profile_that_serve_takes() {
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), vec![drive()]);
    let out = dir.path().join("report");
    let run = Command::new(env!("CARGO_BIN_EXE_wildcity"))
        .args(["report", "street", "--backend", "cpu", "--stations", "2", "--window", "48"])
        .args(["--repeat", "1", "--no-stress", "--at-least-db", "30", "--twins"])
        .arg(dir.path())
        .arg("--out")
        .arg(&out)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success(), "{said}");
    let read = |name: &str| std::fs::read_to_string(out.join(name)).unwrap();
    let page = read("report.html");
    assert!(page.contains("<svg") && page.contains("data:image/png;base64,"));
    for outside in ["src=\"http", "href=\"http", "<link", "<script", "@import"] {
        assert!(!page.contains(outside), "{outside}");
    }
    let report: serde_json::Value = serde_json::from_str(&read("report.json")).unwrap();
    let settings = report["settings"].as_array().unwrap();
    assert_eq!(read("report.csv").lines().count(), settings.len() + 1);
    let families = settings.iter().map(|setting| setting["family"].as_str().unwrap());
    assert!(
        families.clone().any(|family| family == "record"),
        "{:?}",
        families.collect::<Vec<_>>()
    );
    assert_eq!(report["recommendations"][0]["wanted"]["at_least_db"], 30.0);

    let profile: wildcity::scene::ProfileChanges =
        serde_json::from_str(&read("profile.json")).unwrap();
    profile.apply(RenderProfile::default()).unwrap();
    let bad = dir.path().join("bad.json");
    std::fs::write(&bad, r#"{"tau_px": -2}"#).unwrap();
    let refused = Command::new(env!("CARGO_BIN_EXE_wildcity"))
        .args(["serve", "--listen", "127.0.0.1:0", "--twins"])
        .arg(dir.path())
        .arg("--profile")
        .arg(&bad)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(
        !refused.status.success() && said.contains("bad.json") && said.contains("tau_px"),
        "{said}"
    );
}
