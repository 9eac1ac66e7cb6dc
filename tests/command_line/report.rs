//! `wildcity report`, and the libraries that `serve` loads.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::Value;
use wildcity_report::sample_points::OFFSETS_M;
use wildcity_scene::{ProfileOverrides, RenderProfile};

use crate::reported::{commit, drive};

/// A library that only some backends need is loaded only by those.
#[cfg(target_os = "linux")]
#[test]
fn a_server_on_the_cpu_has_no_library_of_a_gpu_in_memory() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Command::new(env!("CARGO_BIN_EXE_wildcity"))
        .args(["serve", "--backend", "cpu", "--listen", "127.0.0.1:0"])
        .args(["--twins", "twins", "--episodes", "episodes", "--uploads", "uploads"])
        .current_dir(dir.path())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut said).unwrap();
    let maps = std::fs::read_to_string(format!("/proc/{}/maps", server.id()));
    server.kill().unwrap();
    server.wait().unwrap();
    assert!(said.contains("listening"), "{said}");
    let maps = maps.unwrap();
    let paths = maps.lines().filter_map(|line| line.split_whitespace().nth(5));
    let libraries: BTreeSet<&str> = paths.filter(|path| path.contains(".so")).collect();
    assert!(libraries.iter().any(|path| path.contains("libc.so")), "{libraries:?}");
    for needless in ["vulkan", "libdrm", "libGL", "libEGL", "LLVM", "onnx", "cuda"] {
        assert!(!libraries.iter().any(|path| path.contains(needless)), "{libraries:?}");
    }
}

/// The smallest sampling, for tests in which the numbers of a report do not matter.
const SMALLEST: [&str; 4] = ["--stations", "2", "--window", "16"];

/// The command's report of the street in a directory, in its folder `report`.
fn run_report(dir: &Path, sampling: [&str; 4], more: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_wildcity"))
        .args(["report", "street", "--backend", "cpu"])
        .args(sampling)
        .args(["--repeat", "1", "--no-stress", "--twins"])
        .args([dir, Path::new("--out"), &dir.join("report")])
        .args(more)
        .output()
        .unwrap()
}

#[test]
fn invalid_options_are_rejected_early() {
    let nowhere = tempfile::tempdir().unwrap();
    for (given, fix) in [
        ("--at-least-db=-inf", "expected 0 to 1000 dB, for example 40"),
        ("--at-least-db=NaN", "expected 0 to 1000 dB, for example 40"),
        ("--at-most-ms=-5", "expected milliseconds above 0, for example 20"),
        ("--at-most-ms=inf", "expected milliseconds above 0, for example 20"),
        ("--backend=reference", "[possible values: cpu, gpu]"),
        ("--backend=cpu,cpu", "name each once"),
    ] {
        // The twin does not exist, but options are checked first.
        let refused = Command::new(env!("CARGO_BIN_EXE_wildcity"))
            .args(["report", "street", given, "--twins"])
            .arg(nowhere.path())
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&refused.stderr);
        assert!(!refused.status.success() && said.contains(fix), "{given}: {said}");
    }
}

#[test]
fn the_command_writes_a_self_contained_page_and_a_profile_that_serve_reads() {
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), vec![drive()]);
    let out = dir.path().join("report");
    let run =
        run_report(dir.path(), ["--stations", "2", "--window", "48"], &["--at-least-db", "30"]);
    let said = String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success(), "{said}");
    let read = |name: &str| std::fs::read_to_string(out.join(name)).unwrap();
    let page = read("report.html");
    assert!(page.contains("<svg") && page.contains("data:image/png;base64,"));
    for outside in ["src=\"http", "href=\"http", "<link", "<script", "@import"] {
        assert!(!page.contains(outside), "{outside}");
    }
    let report: Value = serde_json::from_str(&read("report.json")).unwrap();
    let settings = report["settings"].as_array().unwrap();
    assert_eq!(read("report.csv").lines().count(), settings.len() + 1);
    // CSV and JSON have the same values, and the same words for infinity and NaN.
    let csv = read("report.csv");
    let mut lines = csv.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let names = lines.next().unwrap();
    for (line, setting) in lines.zip(settings) {
        let cell = |name: &str| line[names.iter().position(|own| *own == name).unwrap()];
        let same = |name: &str, value: &Value| match value {
            Value::String(word) => assert_eq!(cell(name), word, "{name}"),
            Value::Null => assert_eq!(cell(name), "", "{name}"),
            number => assert_eq!(cell(name).parse(), Ok(number.as_f64().unwrap()), "{name}"),
        };
        for name in ["psnr_db", "ssim", "max", "p99_9", "depth_l1_m"] {
            same(name, &setting["errors"][name]);
        }
        for name in ["gaussians", "scene_bytes", "device_bytes", "stored_bytes_each"] {
            same(name, &setting["cost"][name]);
        }
        for (i, offset_m) in OFFSETS_M.iter().enumerate() {
            same(&format!("psnr_db_at_{offset_m}_m"), &setting["psnr_db_by_offset"][i]);
        }
        let of_places = |name: &str| {
            let places = setting["by_place"].as_array().unwrap();
            places.iter().filter_map(|place| place[name].as_f64()).collect::<Vec<f64>>()
        };
        let p95_ms: f64 = cell("p95_ms").parse().unwrap();
        let slowest_ms = of_places("p95_ms").into_iter().fold(0.0, f64::max);
        assert!((p95_ms - slowest_ms).abs() < 1e-3, "{p95_ms} ms, {slowest_ms} ms");
        let least_db = of_places("least_db").into_iter().fold(f64::INFINITY, f64::min);
        assert_eq!(cell("least_db").parse(), Ok(least_db));
    }
    let families = settings.iter().map(|setting| setting["family"].as_str().unwrap());
    assert!(
        families.clone().any(|family| family == "record"),
        "{:?}",
        families.collect::<Vec<_>>()
    );
    let best = &report["recommendation"];
    assert_eq!(best["wanted"]["at_least_db"], 30.0);
    assert_eq!((&report["wanted"], &report["unmet"]), (&best["wanted"], &Value::Null));
    assert_eq!(best["measured"], "what is rendered, before images are encoded");
    assert_eq!(best["encoded"][3]["sent"], "jpeg 90");
    // The page and standard output have the whole command to use.
    let said = String::from_utf8_lossy(&run.stdout);
    let file = out.join("profile.json");
    let line = format!("wildcity serve --backend cpu --profile {}", file.display());
    assert!(said.lines().any(|own| own == line), "{said}");
    assert!(page.contains("wildcity serve --backend cpu --profile profile.json"));
    for told in [&*said, &page] {
        assert!(told.contains("before images are encoded"), "{told}");
        assert!(told.contains("jpeg 90 (the default)"), "{told}");
    }
    assert_eq!(report["believed"].as_array().unwrap().len(), OFFSETS_M.len());
    assert!(page.contains("data:image/jpeg;base64,") && page.contains("Not compared"));

    let profile: ProfileOverrides = serde_json::from_str(&read("profile.json")).unwrap();
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

#[test]
fn without_a_recommendation_no_profile_is_left_and_the_report_says_why() {
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), vec![drive()]);
    let out = dir.path().join("report");
    let (file, read) =
        (out.join("profile.json"), |name: &str| std::fs::read_to_string(out.join(name)).unwrap());
    let an_earlier_one = || {
        std::fs::create_dir_all(&out).unwrap();
        std::fs::write(&file, "{}").unwrap();
    };
    an_earlier_one();
    let unmet = run_report(dir.path(), SMALLEST, &["--at-least-db", "500"]);
    let said = String::from_utf8_lossy(&unmet.stderr);
    assert!(!unmet.status.success() && said.contains("at least 500 dB"), "{said}");
    assert!(!file.exists());
    let report: Value = serde_json::from_str(&read("report.json")).unwrap();
    assert_eq!(
        (&report["wanted"]["at_least_db"], &report["recommendation"]),
        (&500.0.into(), &Value::Null)
    );
    assert!(report["unmet"].as_str().unwrap().contains("the best reaches"), "{}", report["unmet"]);
    let answer = "Which setting should I use? </b>Nothing is recommended for at least 500 dB: ";
    let page = read("report.html");
    assert!(page.find(answer).unwrap() < page.find("<h2").unwrap());
    // The old profile is also removed if there is no goal.
    an_earlier_one();
    let without = run_report(dir.path(), SMALLEST, &[]);
    assert!(without.status.success() && !file.exists());
    let said = String::from_utf8_lossy(&without.stderr);
    assert!(
        said.starts_with("this takes about ") && said.contains("for the reference, "),
        "{said}"
    );
    let answer = String::from_utf8_lossy(&without.stdout);
    assert!(answer.contains(" ms a step") && answer.contains("find one for a goal"), "{answer}");
    let report: Value = serde_json::from_str(&read("report.json")).unwrap();
    assert_eq!(report["wanted"], Value::Null);
}
