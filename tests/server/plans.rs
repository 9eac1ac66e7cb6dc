//! Plans that are followed for several steps, and notes for the record.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use serde_json::{Value, json};
use wildcity_render::cpu::{Cpu, Simd};

use crate::episodes::lines;
use crate::replay::replay;
use crate::support::{Agent, Painter, Reply, Seen, TestServer, pose, refused};

/// Poses every 0.1 s: straight on by a metre each.
fn straight(poses: u32) -> Value {
    let timed = |k: u32| json!({ "time_us": 100_000 * k, "pose": pose(f64::from(k)) });
    (1..=poses).map(timed).collect()
}

/// Asserts that two observations are equal except for the fields of their request and session.
fn assert_same(one: &Seen, other: &Seen) {
    for field in ["step", "time_us", "frame_hash", "ego", "images", "history"] {
        assert_eq!(one.meta[field], other.meta[field], "{field}");
    }
    let other = other.tensors();
    for (name, tensor) in one.tensors().tensors() {
        assert_eq!(tensor, other.tensor(&name).unwrap(), "{name}");
    }
}

#[tokio::test]
async fn a_plan_gives_the_observation_of_its_last_step() {
    let server = TestServer::start().await;
    let outputs = json!({ "encoding": "raw", "frames": 4, "period_us": { "rear": 200_000 } });
    let mut single = server.agent().await;
    single.open(json!({ "outputs": outputs })).await;
    let mut planned = server.agent().await;
    planned.open(json!({ "outputs": outputs })).await;
    for agent in [&mut single, &mut planned] {
        agent.look(json!({ "type": "reset" })).await;
    }
    for second in 0..2_u32 {
        let mut last = None;
        for step in 1..=10 {
            last = Some(single.step(f64::from(10 * second + step)).await);
        }
        let begun = server.painter.begun.load(Ordering::SeqCst);
        let plan = json!({ "type": "step", "trajectory": straight(12), "until_us": 1_000_000 });
        let seen = planned.look(plan).await;
        assert_same(&seen, &last.unwrap());
        assert_eq!(seen.meta["step"], 10 * (second + 1));
        // The front at 7, 8, 9, 10 tenths, the rear at 4, 6, 8, 10.
        assert_eq!(server.painter.begun.load(Ordering::SeqCst) - begun, 6, "frames at six times");
    }
    let mut summaries = [
        single.ask(json!({ "type": "close" })).await,
        planned.ask(json!({ "type": "close" })).await,
    ];
    let [of_single, of_planned] = &mut summaries;
    // Each has its own file.
    let files = [of_single, of_planned].map(|closed| closed["summary"]["episode"].take());
    assert_ne!(files[0], files[1]);
    assert_eq!(summaries[0]["summary"], summaries[1]["summary"]);
    for path in server.recorded() {
        let report = replay(&server, &path, &Painter::default()).unwrap();
        assert_eq!((report.diverged, report.difference), (None, None), "{}", path.display());
    }
}

/// A session with rolling shutters and bundles.
async fn car(server: &TestServer, name: &str, model: &str) -> Agent {
    let camera = |name: &str| {
        json!({
            "name": name, "width": 8, "height": 6, "fx": 5.0, "fy": 5.0, "cx": 4.0, "cy": 3.0,
            "shutter": { "direction": "top_to_bottom", "duration_us": 30_000 },
            "camera_to_rig": { "xyz": [0.5, 0.0, 1.5], "q": [0.5, -0.5, 0.5, -0.5] },
        })
    };
    let mut agent = server.agent().await;
    let fields = json!({
        "session": name, "rig": { "name": "one", "cameras": [camera("front")] },
        "outputs": { "encoding": "raw", "frames": 3 }, "warm_up_us": 300_000,
        "dynamics": { "model": model, "speed": 8.0 }, "contact": "off",
    });
    agent.open(fields).await;
    agent
}

#[tokio::test]
async fn an_action_that_is_kept_is_as_many_steps() {
    let backend = Arc::new(Cpu::new(1, Simd::Best).unwrap());
    let server = TestServer::configured(|config| config.backend = backend).await;
    for model in ["kinematic", "dynamic"] {
        let mut single = car(&server, &format!("{model}-single"), model).await;
        let mut planned = car(&server, &format!("{model}-planned"), model).await;
        let mut seconds = Vec::new();
        for second in 0..3 {
            let action = json!({ "acceleration": 1.0, "curvature": 0.05 * f64::from(second - 1) });
            let mut last = None;
            for _ in 0..10 {
                last = Some(single.look(json!({ "type": "step", "action": action })).await);
            }
            let plan = json!({
                "type": "step", "action": action, "until_us": 1_000_000, "notes": { "n": second },
            });
            let seen = planned.look(plan).await;
            assert_same(&seen, &last.unwrap());
            seconds.push(seen);
        }
        planned.ask(json!({ "type": "close" })).await;

        // On record, in a replay, and in a branch.
        let path = server.episodes.path().join(format!("{model}-planned-1.jsonl"));
        let written = lines(&path);
        let frames: Vec<_> = written.iter().filter(|line| line["kind"] == "frame").collect();
        assert_eq!(frames[1]["notes"], json!({ "n": 1 }));
        assert_eq!((&frames[1]["step"], &frames[1]["steps"]), (&json!(20), &json!(10)));
        let report = replay(&server, &path, &Cpu::new(1, Simd::Best).unwrap()).unwrap();
        assert_eq!((report.diverged, report.difference), (None, None), "{model}");
        let mut branch = server.agent().await;
        let from = json!({ "episode": format!("{model}-planned-1"), "step": 20 });
        let opened = branch.ask(json!({ "type": "branch", "from": from })).await;
        assert_eq!(opened["type"], "opened", "{opened}");
        let action = json!({ "acceleration": 1.0, "curvature": 0.05 });
        let plan = json!({ "type": "step", "action": action, "until_us": 1_000_000 });
        assert_same(&branch.look(plan).await, &seconds[2]);
    }
}

#[tokio::test]
async fn a_car_follows_a_trajectory_for_several_steps() {
    let server = TestServer::start().await;
    for model in ["kinematic", "dynamic"] {
        let mut agent = server.agent().await;
        agent.open(json!({ "dynamics": { "model": model, "speed": 5.0 } })).await;
        // A circle of 25 m radius at 5 m/s.
        let timed = |k: usize| {
            let angle = 0.02 * k as f64;
            let xyz = [25.0 * angle.sin(), 25.0 * (1.0 - angle.cos()), 0.0];
            let q = [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()];
            json!({ "time_us": 100_000 * k, "pose": { "xyz": xyz, "q": q } })
        };
        let circle: Value = (1..=30).map(timed).collect();
        let plan = json!({ "type": "step", "trajectory": circle, "until_us": 3_000_000 });
        let ego = agent.look(plan).await.meta["ego"].clone();
        let wanted = [25.0 * 0.6f64.sin(), 25.0 * (1.0 - 0.6f64.cos())];
        let at = |axis: usize| ego["pose"]["xyz"][axis].as_f64().unwrap();
        let off_m = (at(0) - wanted[0]).hypot(at(1) - wanted[1]);
        assert!(off_m < 0.05, "{model}: {off_m} m off, {ego}");
    }
}

/// Every JSON value but `null` is in the record as it was sent, and has no other effect.
#[tokio::test]
async fn notes_go_into_the_record_untouched() {
    let server = TestServer::start().await;
    let mut agent = server.driver("noted").await;
    agent.open(json!({ "session": "beside" })).await;
    let all = [
        json!("a line\nand \"another\" \u{2028} \u{0} Größe 路"),
        json!(""),
        json!(true),
        json!([[], {}, [[0, -1]]]),
        json!({
            "": {}, "z": 1, "a": { "kind": "frame", "pose": [1, 2] }, "most": u64::MAX, "least": i64::MIN,
            "small": 5e-324, "third": 1.0 / 3.0, "large": 1e300, "whole": 2.0,
        }),
        json!("x".repeat(65_534)),
    ];
    let mut bare = Vec::new();
    for (step, notes) in all.iter().enumerate() {
        let x_m = step as f64;
        if step % 2 == 0 {
            let request =
                json!({ "type": "step", "session": "noted", "pose": pose(x_m), "notes": notes });
            bare.push(agent.look(request).await);
        } else {
            let step = json!({ "session": "noted", "pose": pose(x_m), "notes": notes });
            agent.send(json!({ "type": "step_many", "steps": [step] })).await;
            assert!(matches!(agent.receive().await, Reply::Binary(_)));
        }
        // A request that is repeated is on record once, and one that is refused is not.
        agent.seq -= 1;
        agent.send(json!({ "type": "close", "session": "noted" })).await;
        assert!(matches!(agent.receive().await, Reply::Binary(_)));
        let far = json!({ "type": "step", "session": "noted", "pose": pose(1e9), "notes": notes });
        refused(&agent.ask(far).await, "pose_invalid");
    }
    // Observations do not depend on them.
    let mut other = server.driver("bare").await;
    for step in 0..all.len() {
        let seen = other.step(step as f64).await;
        if step % 2 == 0 {
            assert_same(&seen, &bare[step / 2]);
        }
    }
    agent.ask(json!({ "type": "close", "session": "noted" })).await;
    let path = server.episodes.path().join("noted-1.jsonl");
    let written: Vec<Value> = lines(&path)
        .iter()
        .filter(|line| line["kind"] == "frame")
        .map(|line| line["notes"].clone())
        .collect();
    assert_eq!(written, all);
    let report = replay(&server, &path, &Painter::default()).unwrap();
    assert_eq!((report.diverged, report.difference), (None, None));
}

#[tokio::test]
async fn what_is_no_plan_is_refused() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    for (step, field) in [
        (json!({ "trajectory": straight(12), "until_us": 150_000 }), "until_us"),
        (json!({ "trajectory": straight(12), "until_us": 0 }), "until_us"),
        (json!({ "trajectory": straight(12), "until_us": 60_100_000 }), "until_us"),
        (json!({ "trajectory": straight(12), "until_us": 1_300_000 }), "trajectory"),
        (json!({ "pose": pose(1.0), "until_us": 200_000 }), "until_us"),
        (json!({ "pose": pose(1.0), "notes": "x".repeat(65_535) }), "notes"),
    ] {
        let mut request = step;
        request["type"] = "step".into();
        let answer = agent.ask(request).await;
        refused(&answer, "out_of_range");
        assert_eq!(answer["field"], field, "{answer}");
        agent.seq -= 1;
    }
    let noted = json!({
        "type": "step", "pose": pose(1.0), "until_us": 100_000, "notes": "x".repeat(65_534),
    });
    assert_eq!(agent.look(noted).await.meta["step"], 1);
    assert!(server.recorded().len() == 1 && lines(&server.recorded()[0]).len() == 2);
}
