//! Snapshots, and sessions that begin in the middle of another episode: with the same commands,
//! they give the same bytes.

use std::sync::Arc;

use serde_json::{Value, json};
use wildcity_render::cpu::{Cpu, Simd};

use crate::replay::replay;
use crate::support::{Agent, Seen, TestServer, commit_twin_with_opacity, pose, refused};

const STEPS: u64 = 200;

/// Steps before which the session switches to a version.
const SWITCHES: [(u64, u64); 2] = [(50, 2), (90, 1)];

/// A server with two versions of the twin that look different, and a backend that shows that.
async fn server() -> TestServer {
    let backend = Cpu::new(1, Simd::Best).expect("a backend");
    let server = TestServer::configured(|config| config.backend = Arc::new(backend)).await;
    commit_twin_with_opacity(server.twins.path(), -1.0);
    server
}

/// A session with bundles of cameras of two rates, a rolling shutter, a warm-up, and decisions at
/// every third step.
async fn open(agent: &mut Agent, name: &str, model: &str) {
    let camera = |name: &str, shutter_us: i64| {
        json!({
            "name": name, "width": 8, "height": 6, "fx": 5.0, "fy": 5.0, "cx": 4.0, "cy": 3.0,
            "shutter": { "direction": "top_to_bottom", "duration_us": shutter_us },
            "camera_to_rig": { "xyz": [0.5, 0.0, 1.5], "q": [0.5, -0.5, 0.5, -0.5] },
        })
    };
    let speed = if model == "teleport" { 0.0 } else { 9.0 };
    let fields = json!({
        "session": name, "version": 1, "seed": 5,
        "rig": { "name": "pair", "cameras": [camera("front", 30_000), camera("rear", 20_000)] },
        "outputs": { "encoding": "raw", "depth": true, "frames": 4, "trust": true,
                     "period_us": { "rear": 200_000 } },
        "dynamics": { "model": model, "speed": speed }, "decision_us": 300_000, "warm_up_us": 500_000,
        "contact": "report",
    });
    agent.open(fields).await;
}

/// The command of a step: every fourth one is a trajectory.
fn command(model: &str, step: u64) -> Value {
    let phase = step as f64 * 0.1;
    match model {
        _ if step % 4 == 1 => {
            let ahead = |k: u64| json!({ "time_us": 150_000 * k, "pose": pose(0.9 * k as f64) });
            json!({ "type": "step", "trajectory": [ahead(1), ahead(2)] })
        }
        "teleport" => {
            let q = [(0.1 * phase.sin()).cos(), 0.0, 0.0, (0.1 * phase.sin()).sin()];
            json!({ "type": "step", "pose": { "xyz": [5.0 + 0.3 * phase, phase.sin(), 0.1], "q": q } })
        }
        _ => {
            let action = json!({ "acceleration": -phase.sin(), "curvature": 0.1 * phase.cos() });
            json!({ "type": "step", "action": action })
        }
    }
}

/// Drives the steps after `done`, with the switches of version before these steps.
async fn drive(agent: &mut Agent, model: &str, done: u64, until: u64) -> Vec<Seen> {
    let mut seen = Vec::new();
    for step in done + 1..=until {
        for (_, version) in SWITCHES.iter().filter(|(before, _)| *before == step) {
            let switched = agent.ask(json!({ "type": "switch_version", "version": version })).await;
            assert_eq!(switched["version"], *version, "{switched}");
        }
        seen.push(agent.look(command(model, step)).await);
    }
    seen
}

/// Asserts that two observations are equal but for the numbers of their requests, names of
/// sessions, versions that came meanwhile, and times that they took.
fn assert_same(one: &Seen, other: &Seen) {
    let step = &one.meta["step"];
    let meta = |seen: &Seen| {
        let mut meta = seen.meta.clone();
        for field in ["seq", "session", "newer_version", "timings", "residency"] {
            meta.as_object_mut().unwrap().remove(field);
        }
        meta
    };
    assert_eq!(meta(one), meta(other), "step {step}");
    let (one, other) = (one.tensors(), other.tensors());
    assert_eq!(one.len(), other.len(), "step {step}");
    for (name, tensor) in one.tensors() {
        assert_eq!(tensor, other.tensor(&name).unwrap(), "step {step}, {name}");
    }
}

pub(crate) fn assert_all_same(some: &[Seen], others: &[Seen]) {
    assert_eq!(some.len(), others.len());
    some.iter().zip(others).for_each(|(one, other)| assert_same(one, other));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_branch_that_is_driven_alike_gives_the_same_bytes() {
    let server = server().await;
    for model in ["teleport", "kinematic", "dynamic"] {
        let mut agent = server.agent().await;
        open(&mut agent, model, model).await;
        let snapshot = |name: &str| json!({ "type": "snapshot", "name": name });
        let mut original = vec![agent.look(json!({ "type": "reset", "seed": 9 })).await];
        assert_eq!(agent.ask(snapshot("at-0")).await["type"], "ok");
        for done in [37, 49, 51, 100, 150, STEPS] {
            let from = original.len() as u64 - 1;
            original.extend(drive(&mut agent, model, from, done).await);
            if done == 49 {
                // A snapshot after a switch whose version no frame shows yet.
                agent.ask(json!({ "type": "switch_version", "version": 2 })).await;
            }
            agent.ask(snapshot(&format!("at-{done}"))).await;
        }
        let decided = original.iter().filter(|seen| seen.meta["images"] != json!([]));
        assert_eq!(decided.count(), 1 + STEPS as usize / 3);

        // The session itself, back and forth between versions.
        for done in [100, 37, 0, 49, 51, 150] {
            let restore = json!({ "type": "restore", "name": format!("at-{done}") });
            let restored = agent.look(restore).await;
            if done != 49 {
                assert_same(&restored, &original[done as usize]);
            }
            assert_eq!(restored.meta["step"], done);
            let again = drive(&mut agent, model, done, STEPS).await;
            assert_all_same(&again, &original[done as usize + 1..]);
        }

        // Another session of another connection, while this one exists.
        for done in [0, 49, 51, 100] {
            let mut other = server.agent().await;
            let from = json!({ "session": model, "snapshot": format!("at-{done}") });
            let opened = other.ask(json!({ "type": "branch", "from": from })).await;
            assert_eq!((&opened["type"], &opened["dt_us"]), (&json!("opened"), &json!(100_000)));
            assert_eq!(opened["outputs"]["frames"], 4, "{opened}");
            assert_eq!(opened["dynamics"]["model"], model);
            other.look(json!({ "type": "restore", "name": "start" })).await;
            let again = drive(&mut other, model, done, STEPS).await;
            assert_all_same(&again, &original[done as usize + 1..]);
        }
        agent.ask(json!({ "type": "close" })).await;

        // The record, when the session is gone.
        // With frames of both versions in a bundle, too.
        for done in [0, 37, 49, 51, 70, 89, 91, 100, 101, 102, STEPS - 1] {
            let mut other = server.agent().await;
            let from = json!({ "episode": format!("{model}-1"), "step": done });
            let opened = other.ask(json!({ "type": "branch", "from": from })).await;
            assert_eq!(opened["type"], "opened", "{opened}");
            let again = drive(&mut other, model, done, STEPS).await;
            assert_all_same(&again, &original[done as usize + 1..]);
            let reset = other.look(json!({ "type": "reset", "seed": 9 })).await;
            let first = &original[0];
            assert_eq!(
                reset.meta["ego"], first.meta["ego"],
                "a reset begins where the record began"
            );
        }
    }
    for path in server.recorded() {
        let report = replay(&server, &path, &Cpu::new(1, Simd::Best).unwrap()).unwrap();
        assert_eq!((report.diverged, report.difference), (None, None), "{}", path.display());
    }
}

#[tokio::test]
async fn what_is_no_state_is_refused_and_changes_nothing() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    for name in (0..64).map(|k| format!("s{k}")) {
        assert_eq!(agent.ask(json!({ "type": "snapshot", "name": name })).await["type"], "ok");
    }
    let again = agent.ask(json!({ "type": "snapshot", "name": "s0" })).await;
    assert_eq!(again["type"], "ok", "a name can be used again");
    for (request, code, field) in [
        (json!({ "type": "snapshot", "name": "one-more" }), "out_of_range", "name"),
        (json!({ "type": "snapshot", "name": "A" }), "invalid_name", "name"),
        (json!({ "type": "restore", "name": "nope" }), "unknown_state", "name"),
        (
            json!({ "type": "branch", "from": { "session": "a", "snapshot": "s0" } }),
            "session_state",
            "type",
        ),
    ] {
        let answer = agent.ask(request).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{answer}");
        agent.seq -= 1;
    }
    assert_eq!(agent.step(2.0).await.meta["step"], 2);

    let mut other = server.agent().await;
    for (from, code, field) in [
        (json!({ "session": "a", "snapshot": "nope" }), "unknown_state", "from.snapshot"),
        (json!({ "session": "b", "snapshot": "s0" }), "unknown_session", "from.session"),
        (json!({ "episode": "a-7", "step": 0 }), "unknown_state", "from.episode"),
        (json!({ "episode": "a-1", "step": 3 }), "out_of_range", "from.step"),
        (json!({ "episode": "../a-1", "step": 0 }), "invalid_name", "from.episode"),
        (json!({ "episode": "a", "step": 0 }), "invalid_name", "from.episode"),
    ] {
        let answer = other.ask(json!({ "type": "branch", "from": from })).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{answer}");
        other.seq -= 1;
    }
    assert_eq!(server.running.sessions(), 1);
    let from = json!({ "episode": "a-1", "step": 1 });
    let opened = other.ask(json!({ "type": "branch", "session": "c", "from": from })).await;
    assert_eq!((&opened["session"], &opened["start"]), (&json!("c"), &pose(0.0)), "{opened}");
}

#[tokio::test]
async fn an_episode_of_another_twin_is_not_continued() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    agent.ask(json!({ "type": "close" })).await;
    let path = &server.recorded()[0];
    let text = std::fs::read_to_string(path).unwrap();
    let mut lines: Vec<Value> =
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let mut other = server.agent().await;
    let mut branch = async |lines: &[Value]| {
        let text: String = lines.iter().map(|line| format!("{line}\n")).collect();
        std::fs::write(path, text).unwrap();
        let from = json!({ "episode": "a-1", "step": 1 });
        let answer = other.ask(json!({ "type": "branch", "from": from })).await;
        other.seq -= 1;
        answer
    };
    let hash = lines[0]["version_hash"].take();
    lines[0]["version_hash"] = "00".into();
    let answer = branch(&lines).await;
    refused(&answer, "unknown_state");
    assert!(answer["message"].as_str().unwrap().contains("version 1"), "{answer}");
    lines[0]["version_hash"] = hash;
    let action = json!({ "action": { "acceleration_m_s2": 1.0, "curvature_1_m": 0.0 } });
    lines[1]["command"] = action;
    refused(&branch(&lines).await, "session_state");
}
