//! Repair of images in sessions, on the wire and on record. The models are small graphs, and a
//! trained one.

use std::fs;
use std::sync::Arc;

use serde_json::{Value, json};
use wildcity_repair::{LoadOptions, Models};
use wildcity_session::{RecordedEpisode, ReplayReport, ReplayUntil};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::Catalog;

use crate::episodes::{lines, tamper};
use crate::onnx_doubles as doubles;
use crate::onnx_models::{Folder, library, trained};
use crate::support::{Agent, Painter, Seen, TestServer, refused};

/// The models of some folders, with a number of threads.
fn models(folders: &[&Folder], threads: usize) -> Arc<Models> {
    let paths: Vec<_> = folders.iter().map(|folder| folder.path()).collect();
    let options = LoadOptions { threads, ..LoadOptions::new(library()) };
    Arc::new(Models::read(&paths, options).unwrap())
}

pub(crate) async fn server(folders: &[&Folder], threads: usize) -> TestServer {
    let repairs = models(folders, threads);
    TestServer::configured(|config| config.repairs = repairs).await
}

/// A model that adds a tenth of the range.
pub(crate) fn brighter() -> Folder {
    Folder::new(&doubles::arithmetic("Add", 0.1), json!({"name": "brighter", "timeout_ms": 10_000}))
}

/// Two cameras without ground in their images, so that the trust depends only on the distance from
/// the drive: half of it is lost in 3.5 m.
fn rig() -> Value {
    let camera = |name: &str, width: u64| {
        json!({"name": name, "width": width, "height": 16, "fx": 20.0, "fy": 20.0, "cx": 12.0, "cy": 12.0,
            "camera_to_rig": {"xyz": [0.5, 0.0, 1.5], "q": [0.5, -0.5, 0.5, -0.5]}})
    };
    json!({"name": "pair", "cameras": [camera("left", 24), camera("right", 20)]})
}

/// Fields of `open` in addition to the repair.
pub(crate) fn opening(name: &str, repair: Value) -> Value {
    let mut open =
        json!({"session": name, "rig": rig(), "outputs": {"encoding": "raw", "trust": true}});
    if !repair.is_null() {
        open["repair"] = repair;
    }
    open
}

/// A step to a pose with a lateral offset from the drive.
pub(crate) fn beside(y_m: f64) -> Value {
    json!({"type": "step", "pose": {"xyz": [3.0, y_m, 0.0], "q": [1.0, 0.0, 0.0, 0.0]}})
}

pub(crate) async fn step(agent: &mut Agent, y_m: f64) -> Seen {
    agent.look(beside(y_m)).await
}

/// The status of each image.
pub(crate) fn statuses(seen: &Seen) -> Vec<String> {
    let images = seen.meta["images"].as_array().unwrap();
    images.iter().map(|image| image["repair"]["status"].as_str().unwrap().to_owned()).collect()
}

pub(crate) fn hashes(seen: &Seen) -> Vec<String> {
    let images = seen.meta["images"].as_array().unwrap();
    images.iter().map(|image| image["hash"].as_str().unwrap().to_owned()).collect()
}

pub(crate) fn pixels(seen: &Seen, camera: &str) -> Vec<u8> {
    seen.tensors().tensor(&format!("camera/{camera}/rgb")).unwrap().data().to_vec()
}

#[tokio::test]
async fn beside_the_drive_images_are_repaired_and_on_it_no_byte_changes() {
    let folder = brighter();
    let server = server(&[&folder], 1).await;
    let mut agent = Agent::connect(server.address()).await;
    assert_eq!(agent.hello().await["repairs"], json!(["brighter"]));
    let opened = agent.open(opening("a", json!({"model": "brighter", "at_least": 0.05}))).await;
    let told = &opened["repair"];
    assert_eq!((&told["below"], &told["above"]), (&json!(0.75), &json!(0.85)), "{told}");
    assert_eq!((&told["at_least"], &told["per_step"]), (&json!(0.05), &json!(16)), "{told}");
    assert_eq!((&told["on_failure"], &told["provider"]), (&json!("unrepaired"), &json!("cpu")));
    assert_eq!(told["deterministic"], true);
    let mut plain = server.agent().await;
    assert_eq!(plain.open(opening("b", Value::Null)).await.get("repair"), None);

    // The trust falls below 0.75 at 1.44 m, and above 0.85 at 0.81 m.
    for (y_m, status) in [
        (0.0, "kept"),
        (1.2, "kept"),
        (2.0, "repaired"),
        (1.2, "repaired"),
        (0.5, "kept"),
        (1.2, "kept"),
        (20.0, "kept"),
    ] {
        let seen = step(&mut agent, y_m).await;
        let rendered = step(&mut plain, y_m).await;
        assert_eq!(statuses(&seen), [status; 2], "{y_m}");
        for (index, camera) in ["left", "right"].into_iter().enumerate() {
            let image = &seen.meta["images"][index];
            let bytes = pixels(&seen, camera);
            let before = pixels(&rendered, camera);
            assert_eq!(image["hash"], blake3::hash(&bytes).to_hex().as_str());
            assert_eq!(image["repair"]["rendered_hash"], rendered.meta["images"][index]["hash"]);
            assert_eq!(image["trust"], rendered.meta["images"][index]["trust"]);
            let brighter: Vec<u8> = before
                .iter()
                .map(|value| (f32::from(*value) + 25.5).round().min(255.0) as u8)
                .collect();
            let wanted = if status == "repaired" { &brighter } else { &before };
            let off = bytes.iter().zip(wanted).map(|(a, b)| a.abs_diff(*b)).max();
            // A tenth of 255 is half-way between two steps.
            assert!(off <= Some(1), "{y_m} {camera}: {off:?}");
            assert_eq!(bytes == before, status == "kept", "{y_m} {camera}");
        }
        assert!(seen.meta["timings"]["repair_ms"].is_number());
        // A session that does not ask for repair gets no field of it.
        assert_eq!(rendered.meta["images"][0].get("repair"), None);
        assert_eq!(rendered.meta["timings"].get("repair_ms"), None);
    }
    // An observation has no history: 1.2 m is not repaired, whatever was before.
    let at = |y_m: f64| json!({"xyz": [3.0, y_m, 0.0], "q": [1.0, 0.0, 0.0, 0.0]});
    step(&mut agent, 2.0).await;
    let seen = agent.look(json!({"type": "observe", "poses": [at(2.0), at(1.2)]})).await;
    assert_eq!(statuses(&seen), ["repaired", "repaired", "kept", "kept"]);
    assert_eq!(statuses(&step(&mut agent, 1.2).await), ["repaired"; 2], "the history went on");
}

#[tokio::test]
async fn files_that_are_sent_are_of_the_repaired_pixels_and_the_count_is_per_pose() {
    let folder = brighter();
    let server = server(&[&folder], 1).await;
    let mut agent = server.agent().await;
    let mut open = opening("a", json!({"model": "brighter", "per_step": 1}));
    // Without `outputs.trust` the same images are selected, but their trust is not reported.
    open["outputs"] = json!({"encoding": "png", "frames": 2});
    assert_eq!(agent.open(open).await["outputs"]["trust"], false);
    for _ in 0..2 {
        let seen = step(&mut agent, 2.0).await;
        assert_eq!(statuses(&seen), ["repaired", "kept"]);
        assert_eq!(seen.meta["images"][0].get("trust"), None);
        let file = pixels(&seen, "left");
        let decoded = image::load_from_memory(&file).unwrap().into_rgb8();
        assert_eq!(blake3::hash(&decoded).to_hex().as_str(), hashes(&seen)[0]);
    }
    // The earlier frame of a bundle is the repaired one.
    let seen = step(&mut agent, 2.5).await;
    let past = &seen.meta["history"][0];
    assert_eq!((&past["camera"], &past["repair"]["status"]), (&json!("left"), &json!("repaired")));
    assert_ne!(past["hash"], past["repair"]["rendered_hash"]);
    let closed = agent.ask(json!({"type": "close"})).await;
    assert_eq!(closed["summary"].get("least_trust"), None, "{closed}");
}

/// A PNG of 24 x 16 px that is opaque in its upper half and clear below.
fn overlay() -> String {
    let half = |_, y| image::Rgba(if y < 8 { [9, 8, 7, 255] } else { [0; 4] });
    let picture = image::RgbaImage::from_fn(24, 16, half);
    let mut png = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut png, image::ImageFormat::Png).unwrap();
    format!("data:image/png;base64,{}", data_encoding::BASE64.encode(png.get_ref()))
}

#[tokio::test]
async fn an_overlay_stays_on_top() {
    let folder = brighter();
    let server = server(&[&folder], 1).await;
    let mut open = opening("a", json!({"model": "brighter"}));
    open["rig"]["cameras"][0]["overlay"] = overlay().into();
    let mut plain_open = opening("b", Value::Null);
    plain_open["rig"] = open["rig"].clone();
    let mut agent = server.agent().await;
    agent.open(open).await;
    let mut plain = server.agent().await;
    plain.open(plain_open).await;
    let seen = pixels(&step(&mut agent, 2.0).await, "left");
    let rendered = pixels(&step(&mut plain, 2.0).await, "left");
    let (above, below) = seen.split_at(3 * 24 * 8);
    let (rendered_above, rendered_below) = rendered.split_at(3 * 24 * 8);
    assert_eq!(above, rendered_above);
    let changed = below.iter().zip(rendered_below).filter(|(a, b)| a != b).count();
    // All but those that are white already.
    assert!(changed > below.len() * 8 / 10, "{changed} of {}", below.len());
}

#[tokio::test]
async fn a_model_gets_depth_opacity_and_normals_whether_or_not_they_are_sent() {
    let input = |name: &str, role: &str| json!({"name": name, "role": role});
    let inputs = json!([
        input("image", "rgb"),
        input("depth", "depth"),
        input("opacity", "opacity"),
        input("normals", "normals")
    ]);
    let changes = json!({"name": "maps", "timeout_ms": 10_000, "inputs": inputs});
    let folder = Folder::new(&doubles::sum_of_maps(), changes);
    let server = server(&[&folder], 1).await;
    let mut plain = server.agent().await;
    plain.open(opening("plain", Value::Null)).await;
    let rendered = step(&mut plain, 2.0).await;
    let mut all = Vec::new();
    for (name, sent) in [
        ("none", json!({})),
        ("depth", json!({"depth": true})),
        ("all", json!({"depth": true, "opacity": true, "normals": true, "instances": true})),
    ] {
        let mut open = opening(name, json!({"model": "maps"}));
        open["outputs"] = json!({"encoding": "raw"});
        open["outputs"].as_object_mut().unwrap().extend(sent.as_object().unwrap().clone());
        let mut agent = server.agent().await;
        agent.open(open).await;
        let seen = step(&mut agent, 2.0).await;
        assert_eq!(statuses(&seen), ["repaired"; 2]);
        // The painter's depth is 1.5 m, and 2.5 m in the second view; its opacity 0.25, its normals
        // -0.5.
        for (camera, depth_m) in [("left", 1.5), ("right", 2.5)] {
            let more = 255.0 * (0.02 * depth_m + 0.5 * 0.25 - 0.2 * 0.5);
            for (value, before) in pixels(&seen, camera).iter().zip(pixels(&rendered, camera)) {
                let wanted = (f64::from(before) + more).min(255.0);
                assert!(
                    (f64::from(*value) - wanted).abs() <= 0.51,
                    "{camera}: {before} to {value}"
                );
            }
        }
        all.push(hashes(&seen));
    }
    assert!(all.iter().all(|hashes| *hashes == all[0]), "{all:?}");
}

#[tokio::test]
async fn a_trained_model_gives_the_same_hashes_with_any_threads_and_beside_other_sessions() {
    let Some(onnx) = trained("zero_dce_pp_rgb.onnx") else { return };
    let ports = json!([{"name": "input", "role": "rgb"}]);
    let output = json!([{"name": "output", "role": "rgb"}]);
    let changes =
        json!({"name": "zero-dce", "timeout_ms": 10_000, "inputs": ports, "outputs": output});
    let folder = Folder::new(&onnx, changes);
    let drive = async |agent: &mut Agent| {
        let mut all = Vec::new();
        for k in 0..6 {
            let seen = step(agent, 2.0 + 0.3 * f64::from(k)).await;
            assert_eq!(statuses(&seen), ["repaired"; 2]);
            all.extend(hashes(&seen));
        }
        all
    };
    let mut runs = Vec::new();
    for threads in [1, 2] {
        let server = server(&[&folder], threads).await;
        for name in ["alone", "again"] {
            let mut agent = server.agent().await;
            agent.open(opening(name, json!({"model": "zero-dce"}))).await;
            runs.push(drive(&mut agent).await);
        }
        let mut first = server.agent().await;
        let mut second = server.agent().await;
        first.open(opening("first", json!({"model": "zero-dce"}))).await;
        second.open(opening("second", json!({"model": "zero-dce"}))).await;
        let (a, b) = tokio::join!(drive(&mut first), drive(&mut second));
        runs.extend([a, b]);
    }
    assert_eq!(runs.len(), 8);
    assert!(runs.iter().all(|run| *run == runs[0]), "{runs:?}");
}

pub(crate) fn replay(server: &TestServer, episode: &str, models: &Models) -> ReplayReport {
    let path = server.episodes.path().join(format!("{episode}.jsonl"));
    let recording = RecordedEpisode::read(&path).unwrap();
    let cache = Cache::new(Catalog::open(server.twins.path()).unwrap());
    let painter = Painter::default();
    let until = ReplayUntil::End;
    recording.replay_repaired(&cache, &painter, models, until, &mut |_| Ok(())).unwrap()
}

#[tokio::test]
async fn a_replay_decides_and_repairs_again() {
    let folder = brighter();
    let server = server(&[&folder], 1).await;
    let mut agent = server.agent().await;
    agent.open(opening("a", json!({"model": "brighter"}))).await;
    agent.look(json!({"type": "reset", "seed": 1})).await;
    for y_m in [0.5, 1.2, 2.0, 1.2, 0.5, 1.2] {
        step(&mut agent, y_m).await;
    }
    agent.ask(json!({"type": "snapshot", "name": "off"})).await;
    step(&mut agent, 2.0).await;
    step(&mut agent, 1.2).await;
    agent.ask(json!({"type": "snapshot", "name": "on"})).await;
    let at = json!({"xyz": [3.0, 2.0, 0.0], "q": [1.0, 0.0, 0.0, 0.0]});
    agent.look(json!({"type": "observe", "poses": [at]})).await;
    step(&mut agent, 0.0).await;
    // A restored state remembers which cameras were in repair.
    let restore = |name: &str| json!({"type": "restore", "name": name});
    assert_eq!(statuses(&agent.look(restore("on")).await), ["repaired"; 2]);
    assert_eq!(statuses(&step(&mut agent, 1.2).await), ["repaired"; 2]);
    assert_eq!(statuses(&agent.look(restore("off")).await), ["kept"; 2]);
    assert_eq!(statuses(&step(&mut agent, 1.2).await), ["kept"; 2]);
    agent.ask(json!({"type": "close"})).await;

    let again = models(&[&folder], 2);
    for (episode, repaired) in [("a-1", 10), ("a-2", 4), ("a-3", 0)] {
        let report = replay(&server, episode, &again);
        assert_eq!((&report.difference, &report.wrong_value), (&None, &None), "{episode}");
        assert_eq!(report.changes, []);
        assert_eq!((report.repaired.compared, report.repaired.not_compared), (repaired, 0));
        let report = replay(&server, episode, &Models::default());
        assert_eq!((&report.difference, &report.wrong_value), (&None, &None), "{episode}");
        assert_eq!((report.repaired.compared, report.repaired.not_compared), (0, repaired));
    }
    // Another model of that name is named, and not compared.
    let other = Folder::new(
        &doubles::arithmetic("Add", 0.2),
        json!({"name": "brighter", "timeout_ms": 10_000}),
    );
    let report = replay(&server, "a-1", &models(&[&other], 1));
    assert_eq!((report.changes[0].what, report.repaired.not_compared), ("repair hash", 10));

    // Line 5 is the step to 2.0 m. A repaired hash that is altered is found with the model only.
    let path = server.episodes.path().join("a-1.jsonl");
    let whole = fs::read_to_string(&path).unwrap();
    let at_line = 4;
    assert!(lines(&path)[at_line]["repairs"][0]["repaired"].is_string());
    tamper(&path, at_line, 0);
    assert_eq!(replay(&server, "a-1", &again).difference.unwrap().line, at_line + 1);
    assert_eq!(replay(&server, "a-1", &Models::default()).difference, None);
    // A decision that does not follow from the trust is named: the step to 0.5 m repaired nothing.
    let mut values: Vec<Value> = whole.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    let kept = 2;
    assert_eq!(values[kept].get("repairs"), None);
    let hash = values[kept]["images"][0].clone();
    values[kept]["repairs"] = json!([{ "repaired": hash }, null]);
    let text: Vec<String> = values.iter().map(Value::to_string).collect();
    fs::write(&path, text.join("\n") + "\n").unwrap();
    let wrong = replay(&server, "a-1", &Models::default()).wrong_value.unwrap();
    assert_eq!((wrong.line, wrong.field), (kept + 1, "repairs"), "{wrong}");
    // A recorded episode with repair cannot be continued: the model's images are not in it.
    let mut other = server.agent().await;
    let branch = json!({"type": "branch", "from": {"episode": "a-2", "step": 9}});
    let answer = other.ask(branch).await;
    refused(&answer, "unknown_state");
    assert!(answer["message"].as_str().unwrap().contains("repaired by a model"), "{answer}");
}
