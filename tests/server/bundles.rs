//! The last frames of each camera, cameras at different rates, warm-up, and frames that are not
//! read.

use std::sync::atomic::Ordering;

use serde_json::{Value, json};
use wildcity_render::Backend;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::geometry::Pose;
use wildcity_session::{RecordedEpisode, ReplayUntil};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::Catalog;

use crate::support::{Agent, Painter, Seen, TestServer, pose, refused, rig};

/// Image of a camera of the rig when the rig is at a point of the x axis.
fn painted(camera: usize, x_m: f64) -> Vec<u8> {
    let world_from_rig = Pose { position_m: glam::DVec3::new(x_m, 0.0, 0.0), ..Pose::IDENTITY };
    let camera = &rig().cameras[camera];
    Painter::image(&(world_from_rig * camera.rig_from_camera), &camera.camera)
}

async fn open(server: &TestServer, more: Value) -> Agent {
    let mut agent = server.agent().await;
    agent.open(more).await;
    agent
}

/// Times of the frames of a camera in an observation, in steps of 0.1 s, and their pixels: the
/// present one first.
fn bundle(seen: &Seen, camera: &str) -> Vec<(i64, Vec<u8>)> {
    let entries = ["images", "history"].map(|list| seen.meta[list].as_array().cloned());
    let entries = entries.into_iter().flatten().flatten().filter(|image| image["camera"] == camera);
    let tensors = seen.tensors();
    let read = |image: Value| {
        let start = &image["shutter_start_us"];
        let end = &image["shutter_end_us"];
        assert_eq!(start, end);
        let pixels = tensors.tensor(image["tensor"].as_str().unwrap()).unwrap().data().to_vec();
        assert_eq!(image["hash"], blake3::hash(&pixels).to_hex().as_str());
        (end.as_i64().unwrap() / 100_000, pixels)
    };
    entries.map(read).collect()
}

/// Frames of a camera that was at as many metres as tenths of a second.
fn driven(camera: usize, times: &[i64]) -> Vec<(i64, Vec<u8>)> {
    times.iter().map(|&time| (time, painted(camera, time as f64))).collect()
}

#[tokio::test]
async fn the_trust_of_earlier_frames_is_that_of_their_time() {
    let server = TestServer::start().await;
    // The drive ends at 9 m.
    let outputs = json!({ "encoding": "raw", "frames": 3, "trust": true });
    let mut agent = open(&server, json!({ "outputs": outputs, "decision_us": 200_000 })).await;
    agent.look(json!({ "type": "reset" })).await;
    let between = agent.step(29.0).await;
    assert_eq!(between.meta["images"], json!([]), "there is no decision at this step");
    let seen = agent.step(8.0).await;
    let away_m = |list: &str| -> Vec<f64> {
        let images = seen.meta[list].as_array().unwrap().iter();
        let front = images.filter(|image| image["camera"] == "front");
        front.map(|image| image["trust"]["distance_m"].as_f64().unwrap()).collect()
    };
    assert_eq!((away_m("images"), away_m("history")), (vec![0.0], vec![20.0, 0.0]));
    // The ego was off its model at a step without a decision, and that counts.
    let summary = &agent.ask(json!({ "type": "close" })).await["summary"];
    assert_eq!(summary["outcome"], "off_model");
}

#[tokio::test]
async fn the_last_frames_of_each_camera_newest_first() {
    let server = TestServer::start().await;
    let outputs = json!({ "encoding": "raw", "frames": 3, "depth": true });
    let mut agent = open(&server, json!({ "outputs": outputs })).await;
    let first = agent.look(json!({ "type": "reset" })).await;
    assert_eq!(bundle(&first, "front"), driven(0, &[0]));
    assert_eq!(first.meta.get("history"), None);
    for step in 1..=4_i64 {
        let seen = agent.step(step as f64).await;
        let times: Vec<i64> = (0..3).map(|back| step - back).filter(|&time| time >= 0).collect();
        assert_eq!(bundle(&seen, "front"), driven(0, &times));
        assert_eq!(bundle(&seen, "rear"), driven(1, &times));
        let newest = &seen.meta["images"][1];
        assert_eq!((&newest["index"], newest.get("back")), (&json!(1), None));
        let past = &seen.meta["history"][0];
        assert_eq!((&past["back"], &past["index"]), (&json!(1), &json!(0)));
        assert_eq!(past["tensor"], "camera/front/history/1/rgb");
    }
    // A new episode has no frames of the old one.
    let again = agent.look(json!({ "type": "reset" })).await;
    assert_eq!(bundle(&again, "front"), driven(0, &[0]));
    // Images of `observe` are not part of the history.
    agent.step(1.0).await;
    agent.look(json!({ "type": "observe", "poses": [pose(7.0), pose(8.0)] })).await;
    assert_eq!(bundle(&agent.step(2.0).await, "front"), driven(0, &[2, 1, 0]));
}

/// Camera by camera, in the order of the agent's own choice, each from its newest frame on.
#[tokio::test]
async fn earlier_frames_are_listed_camera_by_camera() {
    let server = TestServer::start().await;
    for cameras in [["front", "rear"], ["rear", "front"]] {
        let outputs = json!({ "encoding": "raw", "frames": 3, "cameras": cameras });
        let mut agent = server.agent().await;
        let opened = agent.open(json!({ "outputs": outputs })).await;
        assert_eq!([0, 1].map(|k| opened["cameras"][k]["name"].clone()), cameras);
        agent.look(json!({ "type": "reset" })).await;
        agent.step(1.0).await;
        let seen = agent.step(2.0).await;
        let listed: Vec<_> = seen.meta["history"]
            .as_array()
            .unwrap()
            .iter()
            .map(|past| (&past["camera"], &past["index"], &past["back"]))
            .collect();
        let [first, second] = cameras.map(|camera| json!(camera));
        let [zero, one, two] = [0, 1, 2].map(|number| json!(number));
        let wanted = [
            (&first, &zero, &one),
            (&first, &zero, &two),
            (&second, &one, &one),
            (&second, &one, &two),
        ];
        assert_eq!(listed, wanted);
    }
}

#[tokio::test]
async fn files_of_earlier_frames_are_the_files_of_then() {
    let server = TestServer::start().await;
    for encoding in ["jpeg", "png"] {
        let outputs = json!({ "encoding": encoding, "frames": 2 });
        let mut agent = open(&server, json!({ "outputs": outputs })).await;
        let then = agent.step(1.0).await;
        let now = agent.step(2.0).await;
        for camera in ["front", "rear"] {
            let file = |seen: &Seen, tensor: String| {
                seen.tensors().tensor(&tensor).unwrap().data().to_vec()
            };
            assert_eq!(
                file(&now, format!("camera/{camera}/history/1/rgb")),
                file(&then, format!("camera/{camera}/rgb"))
            );
        }
    }
}

#[tokio::test]
async fn a_slower_camera_takes_every_second_frame() {
    let server = TestServer::start().await;
    let outputs = json!({ "encoding": "raw", "frames": 2, "period_us": { "rear": 200_000 } });
    let mut agent = server.agent().await;
    let opened = agent.open(json!({ "outputs": outputs })).await;
    let resolved = json!({ "front": 100_000, "rear": 200_000 });
    assert_eq!(opened["outputs"]["period_us"], resolved);
    agent.look(json!({ "type": "reset" })).await;
    for (step, rear) in [(1, vec![0]), (2, vec![2, 0]), (3, vec![2, 0]), (4, vec![4, 2])] {
        let seen = agent.step(step as f64).await;
        assert_eq!(bundle(&seen, "front"), driven(0, &[step, step - 1]));
        assert_eq!(bundle(&seen, "rear"), driven(1, &rear), "step {step}");
        let images = seen.meta["images"].as_array().unwrap().len();
        assert_eq!(images, if step % 2 == 0 { 2 } else { 1 });
    }
}

#[tokio::test]
async fn frames_that_no_decision_reads_are_not_drawn() {
    let server = TestServer::start().await;
    let outputs = json!({ "encoding": "raw", "frames": 4 });
    let rare = json!({ "outputs": outputs, "decision_us": 1_000_000 });
    let mut agent = open(&server, rare).await;
    let mut always = open(&server, json!({ "outputs": outputs })).await;
    let begun = || server.painter.begun.load(Ordering::SeqCst);
    agent.look(json!({ "type": "reset" })).await;
    always.look(json!({ "type": "reset" })).await;
    for second in 0..2 {
        let before = begun();
        for step in 1..=10 {
            let seen = agent.step(f64::from(10 * second + step)).await;
            let images = seen.meta["images"].as_array().unwrap().len();
            assert_eq!(images, if step == 10 { 2 } else { 0 }, "step {step}");
            assert_eq!(seen.meta.get("history").is_some(), step == 10);
            if step == 10 {
                let now = i64::from(10 * second + step);
                assert_eq!(bundle(&seen, "rear"), driven(1, &[now, now - 1, now - 2, now - 3]));
            }
        }
        assert_eq!(begun() - before, 4, "of ten frames");
    }
    for step in 1..=20 {
        let seen = always.step(f64::from(step)).await;
        if step == 20 {
            assert_eq!(bundle(&seen, "front"), driven(0, &[20, 19, 18, 17]));
        }
    }
}

#[tokio::test]
async fn the_drive_before_the_start_is_history_and_frames() {
    let server = TestServer::start().await;
    let start = json!({ "trajectory": "log", "station_m": 5.5 });
    let outputs = json!({ "encoding": "raw", "frames": 4 });
    let mut agent = server.agent().await;
    let opened =
        agent.open(json!({ "outputs": outputs, "start": start, "warm_up_us": 500_000 })).await;
    assert_eq!((&opened["start"], &opened["warm_up_us"]), (&pose(5.5), &json!(500_000)));
    let first = agent.look(json!({ "type": "reset" })).await;
    let logged = |back: i64| (-back, painted(0, 5.5 - back as f64));
    assert_eq!(bundle(&first, "front"), [0, 1, 2, 3].map(logged));
    assert_eq!(first.meta["ego"]["history_count"], 6);
    assert_eq!((&first.meta["step"], &first.meta["time_us"]), (&json!(0), &json!(0)));
    let next = agent.step(6.5).await;
    let now = (1, painted(0, 6.5));
    assert_eq!(bundle(&next, "front"), [now.clone(), logged(0), logged(1), logged(2)]);
    // A step without a previous reset shows the same frames.
    let at_once = json!({ "outputs": outputs, "start": start, "warm_up_us": 500_000 });
    let mut agent = open(&server, at_once).await;
    let seen = agent.step(6.5).await;
    assert_eq!(bundle(&seen, "front"), [now, logged(0), logged(1), logged(2)]);
    // Without a start, the episode begins where the warm-up ends.
    let opened = server.agent().await.open(json!({ "warm_up_us": 300_000 })).await;
    assert_eq!(opened["start"], pose(3.0));
}

#[tokio::test]
async fn periods_that_do_not_fit_the_steps_are_refused() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let from_m = |station_m: f64| json!({ "trajectory": "log", "station_m": station_m });
    for (more, code, field, says) in [
        (json!({ "outputs": { "frames": 17 } }), "out_of_range", "outputs.frames", "1 to 16"),
        (json!({ "outputs": { "frames": 0 } }), "out_of_range", "outputs.frames", "1 to 16"),
        (
            json!({ "outputs": { "period_us": { "front": 150_000 } } }),
            "out_of_range",
            "outputs.period_us.front",
            "whole steps of 100000",
        ),
        (
            json!({ "outputs": { "period_us": { "roof": 100_000 } } }),
            "unknown_camera",
            "outputs.period_us.roof",
            "front, rear",
        ),
        (json!({ "decision_us": 50_000 }), "out_of_range", "decision_us", "whole steps"),
        (json!({ "warm_up_us": -1 }), "out_of_range", "warm_up_us", "0..="),
        (json!({ "warm_up_us": 20_000_001 }), "out_of_range", "warm_up_us", "20000000"),
        (json!({ "warm_up_us": 1_000_000 }), "out_of_range", "warm_up_us", "not within trajectory"),
        (
            json!({ "warm_up_us": 500_000, "start": from_m(4.0) }),
            "out_of_range",
            "warm_up_us",
            "-100000 µs is not within",
        ),
        (
            json!({ "warm_up_us": 500_000, "start": { "pose": pose(1.0) } }),
            "out_of_range",
            "warm_up_us",
            "along a trajectory",
        ),
    ] {
        let answer = agent.try_open(more).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{answer}");
        assert!(answer["message"].as_str().unwrap().contains(says), "{answer}");
    }
}

#[tokio::test]
async fn what_was_drawn_for_later_is_rendered_again_in_a_replay() {
    let server = TestServer::start().await;
    let outputs = json!({ "encoding": "raw", "frames": 3, "period_us": { "rear": 200_000 } });
    let more = json!({
        "session": "a", "outputs": outputs, "decision_us": 500_000, "warm_up_us": 400_000,
    });
    let mut agent = open(&server, more).await;
    agent.look(json!({ "type": "reset" })).await;
    for step in 1..=10 {
        agent.step(4.0 + f64::from(step)).await;
    }
    agent.look(json!({ "type": "observe", "poses": [pose(3.0)] })).await;
    agent.ask(json!({ "type": "close" })).await;

    let recording = RecordedEpisode::read(&server.recorded()[0]).unwrap();
    let cache = Cache::new(Catalog::open(server.twins.path()).unwrap());
    let replayed = |backend: &dyn Backend| {
        recording.replay(&cache, backend, ReplayUntil::End, &mut |_| Ok(())).unwrap()
    };
    let report = replayed(&Painter::default());
    assert_eq!(report.difference, None);
    // Reset: three of the front, three of the rear within 0.4 s. Steps: frames of the front at 3,
    // 4, 5 and 8, 9, 10 tenths, of the rear at 2, 4, 6, 8 and 10. And one look.
    assert_eq!(report.images, 3 + 3 + 6 + 5 + 2);
    assert!(replayed(&Cpu::new(1, Simd::Best).unwrap()).difference.is_some());
}
