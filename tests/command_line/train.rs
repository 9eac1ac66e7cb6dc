//! `wildcity train`: from images to a twin, stopped and resumed; a twin that is refined.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use wildcity_scene::Rig;
use wildcity_scene::manifest::ChunkEntry;
use wildcity_twin::store::Catalog;

use crate::data::real;
use crate::in_folder::{done, refused};
use crate::wildcity;

/// A lane of 100 m, and views of it as if they had been recorded.
fn recorded(dir: &Path) {
    done(
        dir,
        &[
            "twin",
            "generate",
            "--twin",
            "lane",
            "--twins",
            "twins",
            "--length-km",
            "0.1",
            "--density",
            "1",
        ],
    );
    let views = ["--offsets", "0.01", "--every", "25m", "--side", "160", "--cameras", "front,rear"];
    let fixed =
        ["train", "augment", "lane", "--twins", "twins", "--out", "recorded", "--points", "3000"];
    done(dir, &[&fixed[..], &views].concat());
}

const SCENE: [&str; 10] = [
    "train",
    "recorded/round_1",
    "--sky",
    "network",
    "--threads",
    "2",
    "--held-out-every",
    "5",
    "--steps",
    "60",
];

fn train(out: &str, more: &[&str]) -> Vec<String> {
    [&SCENE[..], &["--out", out], more].concat().into_iter().map(str::to_owned).collect()
}

fn as_strs(arguments: &[String]) -> Vec<&str> {
    arguments.iter().map(String::as_str).collect()
}

#[test]
fn a_run_that_is_stopped_goes_on_to_the_same_files() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    recorded(dir);
    let said = done(dir, &as_strs(&train("whole.ply", &[])));
    assert!(said.contains("held out: ") && said.contains("wildcity import"), "{said}");
    let page = fs::read_to_string(dir.join("whole.html")).unwrap();
    // Four pictures of each of the images that judge the run, and three curves.
    assert_eq!([page.matches("data:image/jpeg").count(), page.matches("<svg").count()], [16, 3]);
    assert!(page.contains("steps = 60") && page.contains(" dB on 4 images"), "{}", page.len());

    // Stopped after some steps by SIGTERM.
    let mut child = wildcity()
        .args(train("again.ply", &["--lines", "lines.jsonl"]))
        .current_dir(dir)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let began = Instant::now();
    let lines = || fs::read_to_string(dir.join("lines.jsonl")).unwrap_or_default().lines().count();
    while lines() < 3 && began.elapsed() < Duration::from_secs(120) {
        std::thread::sleep(Duration::from_millis(5));
    }
    let killed = Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    assert_eq!(child.wait().unwrap().code(), Some(1));
    assert!(dir.join("again.ply.checkpoint").is_file() && !dir.join("again.ply").exists());

    let error = refused(dir, &as_strs(&train("again.ply", &[])));
    assert!(error.contains("--resume goes on with it"), "{error}");
    let error = refused(dir, &as_strs(&train("again.ply", &["--resume", "--seed", "4"])));
    assert!(error.contains("other settings"), "{error}");
    let error = refused(dir, &as_strs(&train("again.ply", &["--resume", "--size", "0.5"])));
    assert!(error.contains("other images"), "{error}");
    let error = refused(dir, &as_strs(&train("other.ply", &["--resume"])));
    assert!(error.contains("begin without --resume"), "{error}");
    done(dir, &as_strs(&train("again.ply", &["--resume", "--lines", "lines.jsonl"])));
    for name in ["ply", "sky.safetensors"] {
        let [whole, again] =
            ["whole", "again"].map(|stem| fs::read(dir.join(format!("{stem}.{name}"))).unwrap());
        assert!(whole == again, "{name}");
    }
    assert_eq!(lines(), 60);
    assert!(!dir.join("again.ply.checkpoint").exists());

    // A scene that begins where the other ended, and a twin of it.
    let more =
        ["--start", "whole.ply", "--twin", "again", "--twins", "twins", "--axes", "identity"];
    let said = done(dir, &as_strs(&train("further.ply", &more)));
    assert!(said.contains("twin again version 1"), "{said}");
    let version = Catalog::open(&dir.join("twins")).unwrap().version("again", None).unwrap();
    assert!(version.manifest.sky.is_some());
    assert_eq!(version.manifest.gaussians(), 3_000);
    let error = refused(dir, &as_strs(&train("x.ply", &["--start", "whole.ply", "--cap", "9"])));
    assert!(error.contains("more than --cap 9"), "{error}");
}

/// Few images determine few Gaussians, unless --cap or a settings file says how many.
#[test]
fn without_a_cap_the_pixels_bound_the_gaussians() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    recorded(dir);
    let text = fs::read(dir.join("recorded/round_1/transforms.json")).unwrap();
    let transforms: serde_json::Value = serde_json::from_slice(&text).unwrap();
    let frames = transforms["frames"].as_array().unwrap().iter();
    let pixels: u64 =
        frames.map(|frame| frame["w"].as_u64().unwrap() * frame["h"].as_u64().unwrap()).sum();
    let by_pixels = pixels.div_ceil(32);
    fs::write(dir.join("degree.toml"), "sh_degree = 0\n").unwrap();
    fs::write(dir.join("cap.toml"), "[growth]\ncap = 5000\n").unwrap();
    let plan = ["train", "plan", "recorded/round_1", "--steps", "4000"];
    let cap = |options: &[&str]| -> u64 {
        let said = done(dir, &[&plan[..], options].concat());
        let cap = said.split("(--cap ").nth(1).and_then(|rest| rest.split(')').next());
        cap.unwrap().parse().unwrap()
    };
    assert!(by_pixels < 100_000, "{by_pixels}");
    assert_eq!(cap(&[]), by_pixels);
    assert_eq!(cap(&["--settings", "degree.toml"]), by_pixels);
    assert_eq!(cap(&["--settings", "cap.toml"]), 5_000);
    assert_eq!(cap(&["--settings", "cap.toml", "--cap", "6000"]), 6_000);
    // A quarter of the pixels, of each image rounded.
    assert!(cap(&["--size", "0.5"]).abs_diff(by_pixels / 4) < 10);
}

#[test]
fn settings_are_compared_by_the_same_images() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    recorded(dir);
    let fixed = ["train", "compare", "recorded/round_1", "--sky", "network", "--out", "compared"];
    let settings = ["--held-out-every", "5", "--size", "1,0.5", "--steps", "60,20,20"];
    let said = done(dir, &[&fixed[..], &settings, &["--cap", "1000"]].concat());
    assert!(said.contains(" dB in ") && said.contains("wildcity train recorded/round_1"), "{said}");
    assert!(said.contains("--sky network --held-out-every 5 --out scene.ply --size"), "{said}");

    #[derive(serde::Deserialize)]
    struct Run {
        size: f64,
        steps: usize,
        gaussians: usize,
        seconds: f64,
        held_out_db: f64,
    }
    let json = fs::read(dir.join("compared/compare.json")).unwrap();
    let runs: Vec<Run> = serde_json::from_slice(&json).unwrap();
    let settings: Vec<(f64, usize)> = runs.iter().map(|run| (run.size, run.steps)).collect();
    assert_eq!(settings, [(0.5, 20), (0.5, 60), (1.0, 20), (1.0, 60)]);
    assert!(runs.iter().all(|run| run.gaussians <= 1_000 && run.seconds > 0.0));
    // More steps show more of the images.
    assert!(runs[1].held_out_db > runs[0].held_out_db && runs[3].held_out_db > runs[2].held_out_db);
    let page = fs::read_to_string(dir.join("compared/index.html")).unwrap();
    let best = runs.iter().map(|run| run.held_out_db).fold(0.0, f64::max);
    assert!(page.contains(&format!("{best:.2} dB in ")), "the page names the best run");
    // Of one image: as recorded, and as each run shows it.
    assert_eq!(page.matches("<img").count(), 5);
    assert_eq!(page.matches(r#"width="160" "#).count(), 5, "all are as large");

    let error = refused(dir, &[&fixed[..], &["--held-out-every", "0"]].concat());
    assert!(error.contains("give --held-out-every"), "{error}");
}

#[test]
fn a_worn_twin_gets_better_by_its_recorded_images() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    recorded(dir);
    let worn = ["--length-km", "0.1", "--density", "1", "--spoil", "1"];
    done(dir, &[&["twin", "generate", "--twin", "worn", "--twins", "twins"][..], &worn].concat());
    let images = ["--images", "recorded/round_1", "--axes", "identity"];
    let fixed = ["train", "loop", "worn", "--twins", "twins", "--out", "rounds", "--rounds", "2"];
    let small = ["--every", "50", "--offsets", "1", "--side", "160", "--steps", "40"];
    let said = done(dir, &[&fixed[..], &images, &small].concat());
    let rounds: Vec<&str> = said.lines().filter(|line| line.starts_with("held out: ")).collect();
    assert_eq!(rounds.len(), 2, "{said}");
    let decibels =
        |line: &str| -> Vec<f64> { line.split(' ').filter_map(|word| word.parse().ok()).collect() };
    for round in &rounds {
        let values = decibels(round);
        assert!(values[1] > values[0] + 0.1, "{round}");
    }
    for (round, offset) in [(1, "0.50"), (2, "1.00")] {
        let judged = format!("{offset} m off the drives, ");
        assert!(said.lines().any(|line| line.starts_with(&judged)), "{said}");
        let page = fs::read_to_string(dir.join(format!("rounds/round_{round}.html"))).unwrap();
        assert!(page.contains("data:image/jpeg"), "{round}");
    }
    let catalog = Catalog::open(&dir.join("twins")).unwrap();
    let [first, last] = [1, 3].map(|number| catalog.version("worn", Some(number)).unwrap());
    assert_eq!(last.manifest.gaussians(), first.manifest.gaussians());
    assert_eq!(last.manifest.trajectories, first.manifest.trajectories);
    assert_eq!(last.manifest.rig, first.manifest.rig);
    let options = &last.manifest.provenance.options;
    assert!(options.iter().any(|option| option == "refine=40 steps, round_2"), "{options:?}");
    let log = done(dir, &["twin", "log", "worn", "--twins", "twins"]);
    let last = log.lines().last().unwrap();
    assert!(
        last.contains("training of 2 ") && last.ends_with("  refine=40 steps, round_2"),
        "{log}"
    );

    let refine = ["train", "refine", "worn", "--twins", "twins"];
    let error = refused(dir, &[&refine[..], &images, &["--augmented", "nowhere"]].concat());
    assert!(error.contains("--augmented nowhere"), "{error}");
    let error = refused(dir, &[&refine[..], &["--images", "recorded/round_1/images"]].concat());
    assert!(error.contains("--images"), "{error}");
    let fixed = ["train", "loop", "worn", "--twins", "twins", "--out", "rounds", "--from", "11"];
    let error = refused(dir, &[&fixed[..], &images].concat());
    assert!(error.contains("--from 11 is after the last round"), "{error}");
}

#[test]
fn a_log_becomes_a_twin() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let street = ["--length-km", "0.1", "--density", "1"];
    done(dir, &[&["twin", "generate", "--twin", "lane", "--twins", "twins"][..], &street].concat());
    let small = ["--length-m", "12", "--width", "96"];
    done(
        dir,
        &[&["log", "generate", "lane", "--twins", "twins", "--out", "log"][..], &small].concat(),
    );
    let plan = ["train", "plan", "log", "--steps", "40", "--cap", "40000", "--blocks", "2"];
    let said = done(dir, &plan);
    for line in
        ["images     ", "Gaussians  40000 at the beginning", "time       about ", "block 2/2"]
    {
        assert!(said.lines().any(|said| said.starts_with(line)), "{said}");
    }
    assert!(said.contains(": 40 steps of "), "{said}");
    let by_default = done(dir, &["train", "plan", "log"]);
    assert!(
        by_default.contains(": 7000 steps (the default; --steps changes it) of "),
        "{by_default}"
    );
    let train = ["train", "log", "--out", "lane.ply", "--steps", "40", "--cap", "40000"];
    let twin = ["--twin", "again", "--twins", "twins"];
    let said = done(dir, &[&train[..], &twin].concat());
    assert!(said.contains("twin again version 1"), "{said}");

    let catalog = Catalog::open(&dir.join("twins")).unwrap();
    let manifest = catalog.version("again", None).unwrap().manifest;
    assert!(manifest.sky.is_some() && manifest.geo.is_some() && manifest.views.is_some());
    let names: Vec<&str> = manifest.trajectories.iter().map(|drive| &*drive.name).collect();
    // Sessions begin on the first one.
    assert_eq!(names, ["log-refined", "log"]);
    // Poses were right: in 40 steps they hardly move, and move.
    let [recorded, refined] = [1, 0].map(|drive| &manifest.trajectories[drive].keyframes);
    let first = refined[3];
    let before = recorded.iter().find(|key| key.time_us >= first.time_us).unwrap();
    let moved_m = before.world_from_rig.position_m.distance(first.world_from_rig.position_m);
    assert!(moved_m < 0.5, "{moved_m}");
    let rig = manifest.rig.unwrap();
    let preset = Rig::preset("vehicle6").unwrap();
    assert_eq!(rig.cameras.len(), 6);
    assert!(rig.cameras[0].rig_from_camera != preset.cameras[0].rig_from_camera);

    // A round of refinement takes the trained poses.
    let refine =
        ["train", "refine", "again", "--twins", "twins", "--images", "log", "--steps", "10"];
    let said = done(dir, &refine);
    assert!(said.contains("held out: ") && said.contains("twin again version 3"), "{said}");
    let error = refused(dir, &[&train[..], &["--masks", "log"]].concat());
    assert!(error.contains("leave --image-dir and --masks out"), "{error}");
    fs::remove_file(dir.join("log/lidar.jsonl")).unwrap();
    let error = refused(dir, &train);
    assert!(error.contains("--points"), "{error}");
}

#[test]
fn a_gradient_that_exceeds_its_bound_ends_with_1() {
    let Some(vectors) = real("gradients/vectors.safetensors") else { return };
    let dir = tempfile::tempdir().unwrap();
    let mut bytes = fs::read(vectors).unwrap();
    // The last values of the file are derivatives of the loss by a pixel.
    let last = bytes.len() - 8 * 4;
    bytes[last - 8..last].copy_from_slice(&0.5_f64.to_le_bytes());
    fs::write(dir.path().join("vectors.safetensors"), bytes).unwrap();
    let check = ["train", "check", "--vectors", "vectors.safetensors"];
    let error = refused(dir.path(), &check);
    assert!(error.contains("bounds are exceeded"), "{error}");
}

#[test]
fn blocks_of_a_twin_make_the_same_twin_in_any_order() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let twins = ["--twins", "twins"];
    let size = ["--length-km", "0.1", "--density", "1"];
    done(dir, &[&["twin", "generate", "--twin", "lane"], &twins[..], &size].concat());
    let log = ["log", "generate", "lane", "--out", "log", "--length-m", "20", "--width", "160"];
    done(dir, &[&log[..], &twins].concat());
    let block = |block: &str, more: &[&str]| {
        let fixed =
            ["train", "block", "lane@1", "--images", "log", "--steps", "3", "--block", block];
        done(dir, &[&fixed[..], &twins, &["--held-out-every", "3"], more].concat())
    };
    let said = block("1/2", &["--checkpoint", "block.checkpoint"]);
    assert!(said.contains("across the borders") && said.contains("by the twin"), "{said}");
    assert!(!dir.join("block.checkpoint").exists());
    block("2/2", &[]);
    let catalog = Catalog::open(&dir.join("twins")).unwrap();
    let one = catalog.version("lane", Some(3)).unwrap();
    done(dir, &[&["twin", "rollback", "lane", "1"], &twins[..]].concat());
    block("2/2", &[]);
    block("1/2", &[]);
    let other = catalog.version("lane", None).unwrap();
    assert_eq!(other.number, 6);
    assert_eq!(one.hash, other.hash);
    let before = catalog.version("lane", Some(1)).unwrap();
    let changed = |(before, after): (&ChunkEntry, &ChunkEntry)| before.object != after.object;
    let chunks = before.manifest.chunks.iter().zip(&one.manifest.chunks);
    assert!(chunks.filter(|pair| changed(*pair)).count() >= 2);

    let fixed = ["train", "block", "lane@1", "--images", "log", "--block", "9/99"];
    let said = refused(dir, &[&fixed[..], &twins].concat());
    assert!(said.contains("give at most"), "{said}");
}
