//! `wildcity train augment`: views off a drive, read back by `wildcity eval`; runs continued after
//! damage and kills.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use serde_json::Value;
use wildcity_generate::{Spoil, StreetSettings};
use wildcity_scene::appearance::Exposure;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole, Shutter, ShutterDirection};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Gaussians, Rig};
use wildcity_twin::store::{Catalog, NewVersion};

use crate::in_folder::{copy, done, refused};
use crate::onnx_models::library;
use crate::root::root;
use crate::versions::files;
use crate::wildcity;

/// A short street, and a degraded copy of it, with a pinhole to the front and a dark fisheye with a
/// rolling shutter to the left. They are made once, and copied for each test.
fn twins(dir: &Path) {
    static MADE: OnceLock<tempfile::TempDir> = OnceLock::new();
    let made = MADE.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        make_twins(dir.path());
        dir
    });
    copy(made.path(), dir);
}

fn make_twins(dir: &Path) {
    let preset = Rig::preset("vehicle6").unwrap();
    let mounted = |name: &str, camera| {
        let preset = preset.cameras.iter().find(|camera| camera.name == name).unwrap();
        RigCamera::new(name, camera, preset.rig_from_camera)
    };
    let pinhole = Pinhole { fx: 225.0, fy: 225.0, cx: 90.0, cy: 58.0 };
    let front = mounted("front", Camera::from_pinhole(180, 116, pinhole));
    let pinhole = Pinhole { fx: 60.0, fy: 60.0, cx: 80.0, cy: 58.0 };
    let lens = Lens::Fisheye(Fisheye::new([-0.01, 0.0, 0.0, 0.0], None));
    let mut left = mounted("left", Camera { lens, ..Camera::from_pinhole(160, 120, pinhole) });
    left.shutter = Some(Shutter { direction: ShutterDirection::TopToBottom, duration_us: 30_000 });
    left.appearance.exposure = Some(Exposure::new(None, Some([0.5; 3]), [0.0; 3]).unwrap());
    let rig = Rig::new("two", vec![front, left]);

    let settings = StreetSettings {
        length_m: 100.0,
        crossing_m: 50.0,
        density: 0.5,
        ..StreetSettings::default()
    };
    let street = wildcity_generate::street(&settings).unwrap();
    let catalog = Catalog::open(&dir.join("twins")).unwrap();
    let commit = |name: &str, gaussians: &Gaussians| {
        let new = NewVersion {
            rig: Some(rig.clone()),
            trajectories: vec![street.trajectory.clone()],
            ..NewVersion::from_gaussians(name, gaussians, Provenance::new("test".to_owned()))
        };
        catalog.commit(new, &mut |_, _| {}).unwrap();
    };
    commit("street", &street.gaussians);
    let spoil = Spoil::new(0.5, 1, &street.trajectory).unwrap();
    commit("worn", &spoil.apply(&street.gaussians));
}

const COMMON: [&str; 6] = ["--twins", "twins", "--backend", "cpu", "--threads", "2"];

fn arguments<'a>(twin: &'a str, out: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let fixed = ["train", "augment", twin, "--offsets", "0.4,3", "--every", "25m", "--out", out];
    [&fixed[..], &COMMON, more].concat()
}

fn augment(dir: &Path, twin: &str, out: &str, more: &[&str]) -> String {
    done(dir, &arguments(twin, out, more))
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// PSNR of each image by name, in dB, against a twin.
fn psnr_db(dir: &Path, twin: &str, images: &str, more: &[&str]) -> BTreeMap<String, f64> {
    let fixed = ["eval", twin, "--images", images, "--out", "eval"];
    done(dir, &[&fixed, &COMMON[..], more].concat());
    let made = json(&dir.join("eval/eval.json"));
    let db = |value: &Value| value.as_f64().unwrap_or(f64::INFINITY);
    let images = made["images"].as_array().unwrap().iter();
    images
        .map(|image| (image["name"].as_str().unwrap().to_owned(), db(&image["psnr_db"])))
        .collect()
}

/// All files of a folder with their bytes.
fn contents(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let name = |path: &Path| path.strip_prefix(dir).unwrap().to_str().unwrap().to_owned();
    files(dir).into_iter().map(|path| (name(&path), fs::read(path).unwrap())).collect()
}

#[test]
fn eval_reads_the_views_back_as_the_twin_draws_them() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    twins(at);
    let said = augment(at, "street", "out", &["--round", "2", "--points", "500"]);
    assert!(said.contains("round 2: 32 images of 2 cameras at 0.4, -0.4, 1, -1 m"), "{said}");
    let round = at.join("out/round_2");
    let record = json(&round.join("augment.json"));
    assert_eq!((&record["complete"], &record["made_with"]["repair"]), (&true.into(), &Value::Null));
    assert_eq!(record["samples"].as_array().unwrap().len(), 32);
    assert!(!round.join("rendered").exists(), "without a model nothing is there to compare");
    assert_eq!(fs::read_dir(at.join("out")).unwrap().count(), 1, "no remains of the server");

    // With the poses of OpenGL and with those of COLMAP, for all pixels and for those of the masks.
    for images in ["out/round_2/transforms.json", "out/round_2"] {
        let db = psnr_db(at, "street", images, &["--axes", "identity"]);
        assert_eq!(db.len(), 32);
        let worst = db.values().copied().fold(f64::INFINITY, f64::min);
        assert!(worst >= 50.0, "{images}: {db:?}");
    }
    let sparse = fs::read_to_string(round.join("sparse/0/cameras.txt")).unwrap();
    assert!(sparse.contains("1 PINHOLE 180 116 225 225 90 58"), "{sparse}");
    let points = fs::read_to_string(round.join("sparse/0/points3D.txt")).unwrap();
    assert_eq!(points.lines().filter(|line| !line.starts_with('#')).count(), 500);
    for sample in record["samples"].as_array().unwrap() {
        let name = sample["name"].as_str().unwrap();
        let trust = sample["trust"].as_f64().unwrap();
        assert!(trust > 0.2 && trust < 1.0, "{sample}");
        assert!((sample["weight"].as_f64().unwrap() - 0.3 * trust).abs() < 1e-12);
        let mask = image::open(round.join("masks").join(name)).unwrap().into_luma8();
        let depth = image::open(round.join("depth").join(name)).unwrap();
        assert_eq!(depth.color(), image::ColorType::L16);
        let depth = depth.into_luma16();
        let pairs = mask.iter().zip(depth.iter());
        assert!(pairs.clone().all(|(mask, mm)| *mm == 0 || *mask == 255), "{name}");
        assert!(depth.iter().all(|mm| *mm <= 65_000));
        let told = depth.iter().filter(|mm| **mm > 0).count() as f64 / depth.len() as f64;
        assert!(told > 0.3, "{name}: {told}");
    }
}

#[test]
fn lenses_are_kept_where_the_formats_know_them() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    twins(at);
    let said = refused(at, &arguments("street", "out", &["--lenses"]));
    assert!(said.contains("camera \"left\" is OPENCV_FISHEYE, and others are PINHOLE"), "{said}");
    augment(at, "street", "out", &["--lenses", "--cameras", "left", "--colmap", "bin"]);
    for images in ["out/round_1/transforms.json", "out/round_1"] {
        let db = psnr_db(at, "street", images, &["--axes", "identity"]);
        assert_eq!(db.len(), 2 * 2 * 4);
        assert!(db.values().all(|db| *db >= 50.0), "{images}: {db:?}");
    }
    let said = refused(at, &arguments("street", "out", &["--cameras", "rear"]));
    assert!(said.contains("--cameras \"rear\": the rig has front, left"), "{said}");
}

#[test]
fn what_is_missing_or_damaged_is_drawn_again_and_other_sets_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    twins(at);
    augment(at, "street", "out", &[]);
    let round = at.join("out/round_1");
    let whole = contents(&round);
    let names: Vec<&String> = whole.keys().filter(|name| name.starts_with("depth/")).collect();
    fs::remove_file(round.join(names[0])).unwrap();
    let damaged = round.join(names[9].replace("depth/", "images/"));
    let mut bytes = fs::read(&damaged).unwrap();
    bytes[100] ^= 1;
    fs::write(&damaged, bytes).unwrap();
    fs::remove_file(round.join("transforms.json")).unwrap();
    let said = augment(at, "street", "out", &[]);
    assert!(said.contains("30 from an earlier run"), "{said}");
    assert!(contents(&round) == whole, "the same bytes");

    let said = refused(at, &arguments("worn", "out", &[]));
    assert!(said.contains("made with another twin: \"street\" there, \"worn\" here"), "{said}");
    let said = refused(at, &arguments("street", "out", &["--side", "90"]));
    assert!(said.contains("another options.side_px: none there, 90 here"), "{said}");
    let catalog = Catalog::open(&at.join("twins")).unwrap();
    let worn = catalog.version("worn", None).unwrap();
    let mut gaussians = Gaussians::default();
    catalog.visit_full_detail(&worn, &|_| true, &mut |section| gaussians = section).unwrap();
    let new = NewVersion {
        rig: worn.manifest.rig.clone(),
        trajectories: worn.manifest.trajectories.clone(),
        ..NewVersion::from_gaussians("street", &gaussians, Provenance::new("trained".to_owned()))
    };
    catalog.commit(new, &mut |_, _| {}).unwrap();
    let said = refused(at, &arguments("street", "out", &[]));
    assert!(said.contains("another version_hash") && said.contains("--round"), "{said}");
    assert!(contents(&round) == whole, "a refusal changes nothing");
    let said = augment(at, "street@1", "out", &[]);
    assert!(said.contains("32 from an earlier run"), "{said}");
}

#[test]
fn a_killed_run_is_continued_to_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    twins(at);
    let more = ["--every", "5m", "--round", "6"];
    let fixed = ["train", "augment", "street", "--offsets", "0.4,3"];
    let run = |out| [&fixed[..], &COMMON, &more, &["--out", out]].concat();
    done(at, &run("whole"));
    let whole = contents(&at.join("whole/round_6"));
    let journal = at.join("cut/round_6/samples.partial.jsonl");
    let mut kills = 0;
    for wanted in [1, 9, 30] {
        let mut command = wildcity();
        command.args(run("cut")).current_dir(at).stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        let begun = Instant::now();
        let lines = || fs::read(&journal).map_or(0, |text| text.split(|b| *b == b'\n').count() - 1);
        while lines() < wanted && child.try_wait().unwrap().is_none() {
            assert!(begun.elapsed() < Duration::from_secs(120), "it draws nothing");
            std::thread::sleep(Duration::from_millis(2));
        }
        kills += usize::from(child.try_wait().unwrap().is_none());
        child.kill().unwrap();
        child.wait().unwrap();
    }
    assert!(kills >= 2, "{kills} kills came in time");
    assert_eq!(json(&at.join("cut/round_6/augment.json"))["complete"], false);
    let said = done(at, &run("cut"));
    let (_, kept) = said.split_once("repaired, ").unwrap();
    let kept: usize = kept.split(' ').next().unwrap().parse().unwrap();
    assert!(kept >= 40, "{said}");
    let continued = contents(&at.join("cut/round_6"));
    assert_eq!(continued.keys().collect::<Vec<_>>(), whole.keys().collect::<Vec<_>>());
    assert!(continued == whole);
    assert_eq!(fs::read_dir(at.join("cut")).unwrap().count(), 1, "no remains of the server");
}

#[test]
fn a_model_repairs_the_images_and_another_one_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    twins(at);
    let manifest = root().join("scenes/repair.json").display().to_string();
    let library = library().display().to_string();
    let repair = ["--repair", &manifest, "--onnxruntime", &library, "--round", "4"];
    let said = augment(at, "worn", "out", &[&repair[..], &["--cameras", "front"]].concat());
    assert!(said.contains("16 images") && said.contains("16 repaired"), "{said}");
    let round = at.join("out/round_4");
    let record = json(&round.join("augment.json"));
    let model = &record["made_with"]["repair"];
    assert_eq!(
        (&model["model"], &model["references"]),
        (&"street-repair".into(), &"rendered".into())
    );
    for sample in record["samples"].as_array().unwrap() {
        let name = sample["name"].as_str().unwrap();
        assert_eq!(sample["repair"]["status"], "repaired", "{sample}");
        assert_eq!(sample["files"].as_object().unwrap().len(), 4);
        let bytes = |folder: &str| image::open(round.join(folder).join(name)).unwrap().into_bytes();
        assert!(bytes("images") != bytes("rendered"), "{name}");
    }
    // The rendered images show the degraded twin; the repaired ones are nearer to the street.
    let colmap = |twin, folder| {
        let folder = format!("out/round_4/{folder}");
        let more = ["--axes", "identity", "--image-dir", &folder];
        psnr_db(at, twin, "out/round_4/sparse/0", &more)
    };
    let same = colmap("worn", "rendered");
    assert!(same.len() == 16 && same.values().all(|db| *db >= 50.0), "{same:?}");
    let mean = |db: BTreeMap<String, f64>| db.values().sum::<f64>() / db.len() as f64;
    let rendered_db = mean(colmap("street", "rendered"));
    let repaired_db = mean(colmap("street", "images"));
    // The twin has no recorded images to compare with: 22.7 dB become 23.0 dB.
    assert!(repaired_db > rendered_db + 0.1, "{rendered_db:.2} dB, repaired {repaired_db:.2} dB");

    // Nothing is repaired where the trust is too low, and the images say so.
    let low = [&repair[..], &["--cameras", "front", "--at-least", "1"]].concat();
    let said = augment(at, "worn", "low", &low);
    assert!(said.contains("; 0 repaired"), "{said}");
    let kept = json(&at.join("low/round_4/augment.json"));
    assert_eq!(kept["samples"][0]["repair"]["status"], "kept");

    let said = refused(at, &arguments("worn", "out", &["--round", "4", "--cameras", "front"]));
    assert!(said.contains("another repair: \"street-repair\" there, none here"), "{said}");
    let said = refused(at, &arguments("worn", "out", &low));
    assert!(said.contains("another repair.at_least: 0.1 there, 1.0 here"), "{said}");
    // The hash depends on the manifest, even on its version.
    let mut other: Value = json(Path::new(&manifest));
    other["version"] = "2".into();
    fs::write(at.join("repair.json"), other.to_string()).unwrap();
    fs::copy(root().join("scenes/repair.onnx"), at.join("repair.onnx")).unwrap();
    let other = ["--repair", "repair.json", "--onnxruntime", &library, "--round", "4"];
    let said =
        refused(at, &arguments("worn", "out", &[&other[..], &["--cameras", "front"]].concat()));
    assert!(said.contains("another repair."), "{said}");
}
