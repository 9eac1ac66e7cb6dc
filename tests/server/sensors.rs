//! Effects of sensors: their changes, which depend only on a seed, and are the same in branches,
//! replays and records.

use std::collections::BTreeSet;

use serde_json::{Value, json};

use crate::branches::assert_all_same;
use crate::replay::replay;
use crate::support::{Agent, Painter, Seen, TestServer, pose, refused};

/// Every effect, strong enough to be seen in 200 steps.
fn all() -> Value {
    let camera = |by_us: u64| {
        json!({
            "drop": 0.15, "late": { "chance": 0.2, "by_us": by_us }, "freeze": { "chance": 0.2, "for_us": 2 * by_us },
            "noise": { "full_well": 500, "read": 10 }, "exposure": { "stops": 0.5, "period_us": 700_000 },
            "dirt": { "spots": 3, "radius": 0.1, "opacity": 0.75 },
        })
    };
    json!({
        "cameras": { "front": camera(200_000), "rear": camera(400_000) },
        "imu": { "accelerometer": { "noise": 0.1, "bias": 0.2 }, "gyroscope": { "noise": 0.01, "bias": 0.02 },
                 "bias_period_us": 1_000_000 },
        "wheel_speed": { "noise": 0.1, "scale": 0.02 }, "delay_us": 300_000,
    })
}

fn outputs() -> Value {
    json!({ "encoding": "raw", "depth": true, "frames": 3, "period_us": { "rear": 200_000 } })
}

fn command(model: &str, step: u64) -> Value {
    let phase = step as f64 * 0.1;
    match model {
        "teleport" => {
            let q = [(0.1 * phase.sin()).cos(), 0.0, 0.0, (0.1 * phase.sin()).sin()];
            json!({ "type": "step", "pose": { "xyz": [5.0 + 0.3 * phase, phase.sin(), 0.1], "q": q } })
        }
        _ if step.is_multiple_of(3) => {
            let ahead = |k: u64| json!({ "time_us": 250_000 * k, "pose": pose(2.0 * k as f64) });
            json!({ "type": "step", "trajectory": [ahead(1), ahead(2), ahead(3)] })
        }
        _ => {
            let action = json!({ "acceleration": -phase.sin(), "curvature": 0.1 * phase.cos() });
            json!({ "type": "step", "action": action })
        }
    }
}

async fn drive(agent: &mut Agent, model: &str, done: u64, until: u64) -> Vec<Seen> {
    let mut seen = Vec::new();
    for step in done + 1..=until {
        seen.push(agent.look(command(model, step)).await);
    }
    seen
}

async fn open(agent: &mut Agent, name: &str, model: &str, sensors: Value) {
    let speed = if model == "teleport" { 0.0 } else { 9.0 };
    let mut fields = json!({
        "session": name, "seed": 5, "outputs": outputs(), "warm_up_us": 500_000,
        "dynamics": { "model": model, "speed": speed }, "contact": "report",
    });
    if !sensors.is_null() {
        fields["sensors"] = sensors;
    }
    agent.open(fields).await;
}

fn images(seen: &Seen) -> impl Iterator<Item = &Value> {
    let [images, history] = ["images", "history"].map(|name| seen.meta[name].as_array());
    images.into_iter().chain(history).flatten()
}

fn bytes<'a>(seen: &'a Seen, image: &Value) -> &'a [u8] {
    let tensors = safetensors::SafeTensors::deserialize(&seen.bytes).unwrap();
    let name = image["tensor"].as_str().unwrap();
    let (_, info) = safetensors::SafeTensors::read_metadata(&seen.bytes).unwrap();
    assert!(tensors.tensor(name).is_ok());
    let (start, end) = info.info(name).unwrap().data_offsets;
    let length = u64::from_le_bytes(seen.bytes[..8].try_into().unwrap()) as usize;
    &seen.bytes[8 + length + start..8 + length + end]
}

#[tokio::test(flavor = "multi_thread")]
async fn a_branch_with_every_effect_gives_the_same_bytes_over_200_steps() {
    let server = TestServer::start().await;
    for model in ["teleport", "dynamic"] {
        let mut agent = server.agent().await;
        open(&mut agent, model, model, all()).await;
        let mut original = vec![agent.look(json!({ "type": "reset", "seed": 9 })).await];
        for done in [0, 37, 101] {
            let from = original.len() as u64 - 1;
            original.extend(drive(&mut agent, model, from, done).await);
            let name = format!("at-{done}");
            assert_eq!(agent.ask(json!({ "type": "snapshot", "name": name })).await["type"], "ok");
        }
        original.extend(drive(&mut agent, model, 101, 200).await);

        // The session itself, and then another session.
        for done in [37, 0] {
            let name = format!("at-{done}");
            let restored = agent.look(json!({ "type": "restore", "name": name })).await;
            let again = drive(&mut agent, model, done, 200).await;
            assert_all_same(&[restored], &original[done as usize..=done as usize]);
            assert_all_same(&again, &original[done as usize + 1..]);
        }
        let mut other = server.agent().await;
        let from = json!({ "session": model, "snapshot": "at-101" });
        let opened = other.ask(json!({ "type": "branch", "from": from })).await;
        assert_eq!(opened["sensors"], json_with_floats(all()), "{opened}");
        assert_all_same(&drive(&mut other, model, 101, 200).await, &original[102..]);
        agent.ask(json!({ "type": "close" })).await;

        // Alone on another server, and from the record.
        let alone = TestServer::start().await;
        let mut agent = alone.agent().await;
        open(&mut agent, "alone", model, all()).await;
        let mut again = vec![agent.look(json!({ "type": "reset", "seed": 9 })).await];
        again.extend(drive(&mut agent, model, 0, 200).await);
        assert_all_same(&again, &original);
        for done in [0, 60, 199] {
            let from = json!({ "episode": "alone-1", "step": done });
            let mut other = alone.agent().await;
            let opened = other.ask(json!({ "type": "branch", "from": from })).await;
            assert_eq!(opened["type"], "opened", "{opened}");
            let again = drive(&mut other, model, done, 200).await;
            assert_all_same(&again, &original[done as usize + 1..]);
            other.ask(json!({ "type": "close" })).await;
        }
        agent.ask(json!({ "type": "close" })).await;
        let path = alone.episodes.path().join("alone-1.jsonl");
        let report = replay(&alone, &path, &Painter::default()).unwrap();
        assert_eq!((report.difference, report.wrong_value, report.diverged), (None, None, None));
        assert!(report.images > 200, "{}", report.images);
    }
}

/// Converts numbers to floats, as they are in answers.
fn json_with_floats(sensors: Value) -> Value {
    let typed: wildcity_protocol::message::Sensors = serde_json::from_value(sensors).unwrap();
    serde_json::to_value(typed).unwrap()
}

#[tokio::test]
async fn every_effect_occurs_and_every_image_says_what_was_done_to_it() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    open(&mut agent, "sensed", "teleport", all()).await;
    let mut seen = vec![agent.look(json!({ "type": "reset", "seed": 9 })).await];
    seen.extend(drive(&mut agent, "teleport", 0, 200).await);
    let mut reasons: BTreeSet<String> = BTreeSet::new();
    let mut last: [Option<(i64, String)>; 2] = [None, None];
    for one in &seen {
        let now_us = one.meta["time_us"].as_i64().unwrap();
        let order: Vec<_> =
            one.meta["images"].as_array().unwrap().iter().map(|i| i["index"].as_u64()).collect();
        assert!(order.is_sorted(), "{order:?}");
        for image in images(one) {
            let sensor = &image["sensor"];
            let told: Vec<&str> = sensor["reasons"]
                .as_array()
                .unwrap()
                .iter()
                .map(|one| one.as_str().unwrap())
                .collect();
            assert_eq!(sensor["status"], "degraded", "there is always noise");
            assert!(sensor["stops"].is_f64() && sensor["clean_hash"] != image["hash"]);
            reasons.extend(told.iter().map(|one| (*one).to_owned()));
            let [due_us, taken_us] =
                ["due_us", "taken_us"].map(|name| sensor[name].as_i64().unwrap());
            let stamp_us = image["shutter_end_us"].as_i64().unwrap();
            assert!(taken_us <= stamp_us && stamp_us <= due_us && due_us <= now_us);
            let is_missing = told.contains(&"dropped") || told.contains(&"late");
            assert_eq!(is_missing, stamp_us < due_us, "{image}");
            assert_eq!(told.contains(&"frozen"), taken_us < stamp_us, "{image}");
            let hash = blake3::hash(bytes(one, image)).to_hex();
            assert_eq!(image["hash"], hash.as_str(), "the hash is of what is sent");
        }
        // A picture that is repeated has the same bytes.
        for image in one.meta["images"].as_array().unwrap() {
            let index = image["index"].as_u64().unwrap() as usize;
            let taken_us = image["sensor"]["taken_us"].as_i64().unwrap();
            let hash = image["hash"].as_str().unwrap().to_owned();
            if let Some((before_us, before)) = &last[index] {
                assert_eq!(*before_us == taken_us, *before == hash, "{image}");
            }
            last[index] = Some((taken_us, hash));
        }
    }
    let expected = ["dirt", "dropped", "exposure", "frozen", "late", "noise"];
    assert_eq!(reasons, expected.map(str::to_owned).into());

    // The picture is of where the ego was then: without effects on pixels it is the painter's.
    let mut plain = server.agent().await;
    open(&mut plain, "plain", "teleport", Value::Null).await;
    let mut truth = vec![plain.look(json!({ "type": "reset", "seed": 9 })).await];
    let delay = json!({ "delay_us": 300_000 });
    let mut delayed = server.agent().await;
    open(&mut delayed, "delayed", "teleport", delay).await;
    truth.extend(drive(&mut plain, "teleport", 0, 200).await);
    let mut waits = vec![delayed.look(json!({ "type": "reset", "seed": 9 })).await];
    waits.extend(drive(&mut delayed, "teleport", 0, 200).await);
    let mut compared = 0;
    for one in &seen {
        for image in images(one).filter(|image| image["index"] == 0) {
            let taken_us = image["sensor"]["taken_us"].as_i64().unwrap();
            if taken_us < 0 {
                continue;
            }
            let then = &waits[(taken_us / 100_000) as usize].meta["images"][0];
            assert_eq!(image["sensor"]["clean_hash"], then["hash"]);
            compared += 1;
        }
    }
    assert!(compared > 500, "{compared}");

    // A pose that was sent is reached three steps later.
    for step in 1..=197 {
        assert_eq!(waits[step + 3].meta["ego"]["pose"], truth[step].meta["ego"]["pose"], "{step}");
    }
    assert_eq!(waits[2].meta["ego"]["pose"], waits[0].meta["ego"]["pose"]);
}

#[tokio::test]
async fn a_seed_decides_everything_and_cameras_are_independent() {
    let server = TestServer::start().await;
    let mut first: Vec<Vec<Seen>> = Vec::new();
    for (name, seed, sensors) in [
        ("a", 1, all()),
        ("b", 1, all()),
        ("c", 2, all()),
        ("d", 1, json!({ "cameras": { "front": all()["cameras"]["front"] }, "delay_us": 300_000 })),
    ] {
        let mut agent = server.agent().await;
        open(&mut agent, name, "teleport", sensors).await;
        let mut seen = vec![agent.look(json!({ "type": "reset", "seed": seed })).await];
        seen.extend(drive(&mut agent, "teleport", 0, 40).await);
        first.push(seen);
    }
    assert_all_same(&first[0], &first[1]);
    let hashes = |seen: &[Seen]| -> Vec<String> {
        seen.iter().map(|one| one.frame_hash().to_owned()).collect()
    };
    let differ = hashes(&first[0]).iter().zip(hashes(&first[2])).filter(|(a, b)| **a != *b).count();
    assert_eq!(differ, 41, "another seed");
    for (one, other) in first[0].iter().zip(&first[3]) {
        assert_eq!(
            one.meta["images"][0], other.meta["images"][0],
            "the front camera has the same effects"
        );
        assert!(other.tensors().tensor("sensor.imu").is_err());
    }
}

#[tokio::test]
async fn what_is_off_leaves_no_trace() {
    let server = TestServer::start().await;
    let mut sessions = Vec::new();
    for (name, sensors) in [
        ("none", Value::Null),
        ("empty", json!({ "cameras": { "front": {} } })),
        ("zero", json!({ "delay_us": 0 })),
    ] {
        let mut agent = server.agent().await;
        let mut fields = json!({ "session": name, "outputs": outputs() });
        if !sensors.is_null() {
            fields["sensors"] = sensors;
        }
        let opened = agent.open(fields).await;
        assert!(opened.get("sensors").is_none(), "{opened}");
        let mut seen = vec![agent.look(json!({ "type": "reset" })).await];
        seen.extend(drive(&mut agent, "teleport", 0, 5).await);
        assert!(seen.iter().flat_map(images).all(|image| image.get("sensor").is_none()));
        agent.ask(json!({ "type": "close" })).await;
        let record =
            std::fs::read_to_string(server.episodes.path().join(format!("{name}-1.jsonl")))
                .unwrap();
        assert!(!record.contains("sensor") && !record.contains("due_us"));
        sessions.push((seen, record.replace(&format!("\"{name}\""), "\"x\"")));
    }
    for (seen, record) in &sessions[1..] {
        assert_all_same(seen, &sessions[0].0);
        assert_eq!(*record, sessions[0].1);
    }
}

#[tokio::test]
async fn observe_shows_the_scene_without_effects() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    open(&mut agent, "sensed", "teleport", all()).await;
    agent.look(json!({ "type": "reset" })).await;
    let observe = json!({ "type": "observe", "poses": [pose(1.0), pose(2.0)] });
    let sensed = agent.look(observe.clone()).await;
    let mut plain = server.agent().await;
    open(&mut plain, "plain", "teleport", Value::Null).await;
    plain.look(json!({ "type": "reset" })).await;
    let clean = plain.look(observe).await;
    assert_eq!(sensed.meta["images"], clean.meta["images"]);
    assert!(sensed.tensors().tensor("sensor.imu").is_err());
}

#[tokio::test]
async fn motion_has_a_sample_for_each_step() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let imu = json!({ "imu": { "gyroscope": { "noise": 0.001 } }, "wheel_speed": {} });
    open(&mut agent, "imu", "kinematic", imu).await;
    let floats = |seen: &Seen, name: &str| -> (Vec<usize>, Vec<f32>) {
        let tensors = seen.tensors();
        let tensor = tensors.tensor(name).unwrap();
        let values =
            tensor.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()));
        (tensor.shape().to_vec(), values.collect())
    };
    let start = agent.look(json!({ "type": "reset" })).await;
    let (shape, at_rest) = floats(&start, "sensor.imu");
    assert_eq!(shape, [1, 6]);
    for (measured, expected) in at_rest.iter().zip([0.0, 0.0, 9.80665_f32]) {
        assert!((measured - expected).abs() < 1e-5, "{at_rest:?}");
    }
    let action = json!({ "acceleration": 1.0, "curvature": 0.02 });
    let plan = agent.look(json!({ "type": "step", "action": action, "until_us": 400_000 })).await;
    let (shape, imu) = floats(&plan, "sensor.imu");
    assert_eq!(shape, [4, 6]);
    let (shape, speeds) = floats(&plan, "sensor.wheel_speed");
    assert_eq!(shape, [4]);
    for (step, speed) in speeds.iter().enumerate() {
        // 9 m/s and 1 m/s².
        assert!((speed - (9.1 + 0.1 * step as f32)).abs() < 1e-4, "{speeds:?}");
        let [forward, left, up, _, _, turning] = imu[6 * step..6 * step + 6] else { panic!() };
        assert!((forward - 1.0).abs() < 0.02 && (up - 9.80665).abs() < 1e-4, "{imu:?}");
        let mean_speed = speed - 0.05;
        assert!((left - 0.02 * mean_speed * mean_speed).abs() < 0.05, "{imu:?}");
        assert!((turning - 0.02 * mean_speed).abs() < 0.006, "{imu:?}");
    }
}

#[tokio::test]
async fn a_delayed_plan_must_be_long_enough() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    open(&mut agent, "late", "kinematic", json!({ "delay_us": 200_000 })).await;
    agent.look(json!({ "type": "reset" })).await;
    let ahead = |time_us: u64| json!({ "time_us": time_us, "pose": pose(9e-6 * time_us as f64) });
    let short = json!({ "type": "step", "trajectory": [ahead(299_999)] });
    let answer = agent.ask(short).await;
    refused(&answer, "out_of_range");
    assert_eq!(answer["field"], "trajectory");
    let seen = agent.look(json!({ "type": "step", "trajectory": [ahead(300_000)] })).await;
    assert_eq!(seen.meta["step"], 1);
    let wrong = agent.ask(json!({ "type": "step", "pose": pose(1.0) })).await;
    assert_eq!(
        (&wrong["code"], &wrong["field"]),
        (&json!("session_state"), &json!("pose")),
        "refused now, not later"
    );
    // Actions take effect after two steps: until then the car keeps its speed.
    let mut agent = server.agent().await;
    open(&mut agent, "acting", "kinematic", json!({ "delay_us": 200_000 })).await;
    agent.look(json!({ "type": "reset" })).await;
    let brake = json!({ "type": "step", "action": { "acceleration": -5.0, "curvature": 0.0 } });
    let mut speeds = Vec::new();
    for _ in 0..4 {
        let seen = agent.look(brake.clone()).await;
        speeds.push(seen.meta["ego"]["velocity"][0].as_f64().unwrap());
    }
    for (speed, expected) in speeds.iter().zip([9.0, 9.0, 8.5, 8.0]) {
        assert!((speed - expected).abs() < 1e-6, "{speeds:?}");
    }
}

/// A replay detects a record whose image was not taken at the time that the settings give.
#[tokio::test]
async fn a_replay_decides_again() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    open(&mut agent, "told", "teleport", all()).await;
    agent.look(json!({ "type": "reset", "seed": 9 })).await;
    drive(&mut agent, "teleport", 0, 30).await;
    agent.ask(json!({ "type": "close" })).await;
    let path = server.episodes.path().join("told-1.jsonl");
    let whole = std::fs::read_to_string(&path).unwrap();
    let report = replay(&server, &path, &Painter::default()).unwrap();
    assert_eq!((report.difference, report.wrong_value), (None, None));

    // Other settings: other pictures, or other pixels.
    let without = whole.replacen("\"drop\":0.15", "\"drop\":0.0", 1);
    assert_ne!(whole, without);
    std::fs::write(&path, without).unwrap();
    let report = replay(&server, &path, &Painter::default()).unwrap();
    assert_eq!(report.wrong_value.map(|wrong| wrong.field), Some("sensors"));
    let quiet = whole.replacen("\"read\":10.0", "\"read\":11.0", 1);
    assert_ne!(whole, quiet);
    std::fs::write(&path, quiet).unwrap();
    let report = replay(&server, &path, &Painter::default()).unwrap();
    assert!(report.difference.is_some() && report.wrong_value.is_none());
}

/// Room for the header is reserved before the header is known, also for the sensor effects of every
/// image.
#[tokio::test]
async fn the_longest_header_of_sensors_fits() {
    let server = TestServer::start().await;
    let cameras = crate::observation::cameras_of_long_headers();
    let effects = json!({
        "drop": 0.3, "freeze": { "chance": 0.5, "for_us": 300_000 },
        "noise": { "full_well": 500, "read": 10 }, "exposure": { "stops": 0.5, "period_us": 700_000 },
        "dirt": { "spots": 3, "radius": 0.1, "opacity": 0.75 },
    });
    let of = |camera: &Value| (camera["name"].as_str().unwrap().to_owned(), effects.clone());
    let by_name: serde_json::Map<String, Value> = cameras.iter().map(of).collect();
    let open = |frames: u64| {
        json!({
            "session": "s".repeat(64), "seed": u64::MAX, "warm_up_us": 0,
            "rig": { "name": "r", "cameras": cameras }, "sensors": { "cameras": by_name },
            "outputs": { "encoding": "raw", "depth": true, "opacity": true, "frames": frames, "trust": true },
        })
    };
    let mut agent = server.agent().await;
    let refusal = agent.try_open(open(16)).await;
    refused(&refusal, "out_of_range");
    assert_eq!(refusal["field"], "sensors", "{refusal}");
    agent.open(open(15)).await;
    let mut most = 0;
    for step in 0..20 {
        let seen = agent.step(0.1 + f64::from(step) / 3.0).await;
        most = most.max(images(&seen).filter(|image| image["sensor"].is_object()).count());
    }
    assert_eq!(most, 240);
}
