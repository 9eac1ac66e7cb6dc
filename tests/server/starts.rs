//! Starts that are sampled with a seed, and episodes with their own dynamics.

use serde_json::{Value, json};

use crate::replay::replay;
use crate::support::{Agent, Painter, TestServer, refused};

async fn open(server: &TestServer, fields: Value) -> Agent {
    let mut agent = server.agent().await;
    agent.open(fields).await;
    agent
}

/// The ego's place on the drive along x, its distance to the left of it, and its heading.
fn place(ego: &Value) -> [f64; 3] {
    let number = |value: &Value| value.as_f64().expect("a number");
    let q = &ego["pose"]["q"];
    let heading_rad = 2.0 * number(&q[3]).atan2(number(&q[0]));
    [number(&ego["pose"]["xyz"][0]), number(&ego["pose"]["xyz"][1]), heading_rad]
}

#[tokio::test]
async fn a_random_start_is_drawn_with_the_seed_of_the_episode() {
    let server = TestServer::start().await;
    let random = json!({ "from_m": 2.0, "to_m": 7.0, "lateral_m": 0.5, "heading_rad": 0.25 });
    let fields = json!({ "session": "a", "seed": 4, "start": { "random": random } });
    let mut agent = server.agent().await;
    let opened = agent.open(fields.clone()).await;
    let mut places = Vec::new();
    for seed in 0..40 {
        let seen = agent.look(json!({ "type": "reset", "seed": seed })).await;
        let [along_m, left_m, heading_rad] = place(&seen.meta["ego"]);
        assert!((2.0..=7.0).contains(&along_m), "{along_m}");
        assert!(left_m.abs() <= 0.5 && heading_rad.abs() <= 0.25, "{left_m}, {heading_rad}");
        if seed == 4 {
            assert_eq!(seen.meta["ego"]["pose"], opened["start"], "that of the first episode");
        }
        places.push([along_m, left_m, heading_rad]);
    }
    // Each sampled value uses its whole range, and is independent of the others.
    let spread = |axis: usize| {
        let values = || places.iter().map(|place| place[axis]);
        values().fold(f64::MIN, f64::max) - values().fold(f64::MAX, f64::min)
    };
    assert!(spread(0) > 4.0 && spread(1) > 0.8 && spread(2) > 0.4, "{places:?}");
    let same = open(&server, json!({ "start": { "random": random } })).await;
    let mut same = same;
    for seed in [39, 0] {
        let seen = same.look(json!({ "type": "reset", "seed": seed })).await;
        assert_eq!(place(&seen.meta["ego"]), places[seed]);
    }
    // The lateral draw does not depend on the range of stations.
    let moved = json!({ "random": { "from_m": 3.0, "lateral_m": 0.5 } });
    let seen = same.look(json!({ "type": "reset", "seed": 5, "start": moved })).await;
    assert_eq!(place(&seen.meta["ego"])[1], places[5][1]);
}

#[tokio::test]
async fn a_warm_up_moves_with_its_random_start() {
    let server = TestServer::start().await;
    let random = json!({ "random": { "lateral_m": 1.0, "heading_rad": 0.5 } });
    let fields = json!({ "session": "a", "warm_up_us": 300_000, "start": random,
                         "outputs": { "encoding": "raw", "frames": 3 } });
    let mut agent = open(&server, fields).await;
    for seed in 0..10 {
        let seen = agent.look(json!({ "type": "reset", "seed": seed })).await;
        let [along_m, ..] = place(&seen.meta["ego"]);
        assert!(along_m >= 2.0, "it starts where the warm-up ends, at 3 m, less the jitter");
        // The drive before the start is straight behind the rig, a metre every 0.1 s.
        let tensors = seen.tensors();
        let history = tensors.tensor("ego.history_xyz").unwrap();
        let xyz: Vec<f32> =
            history.data().chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        for (back, at) in xyz.chunks(3).rev().take(4).enumerate() {
            assert!((at[0] + back as f32).abs() < 1e-5 && at[1].abs() < 1e-5, "{back}: {at:?}");
        }
    }
    agent.ask(json!({ "type": "close" })).await;
    for path in server.recorded() {
        let report = replay(&server, &path, &Painter::default()).unwrap();
        assert_eq!((report.diverged, report.difference), (None, None));
    }
}

#[tokio::test]
async fn an_episode_has_dynamics_of_its_own() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let action = json!({ "type": "step", "action": { "acceleration": 0.0, "curvature": 0.0 } });
    refused(&agent.ask(action.clone()).await, "session_state");
    agent.seq -= 1;
    let dynamics = json!({ "model": "kinematic", "speed": 3.0 });
    let seen = agent.look(json!({ "type": "reset", "dynamics": dynamics })).await;
    assert_eq!(seen.meta["ego"]["velocity"], json!([3.0, 0.0, 0.0]));
    let reset = json!({ "type": "reset", "dynamics": "kinematic", "speed": 5.0 });
    assert_eq!(agent.look(reset).await.meta["ego"]["velocity"], json!([5.0, 0.0, 0.0]));
    let [along_m, ..] = place(&agent.look(action).await.meta["ego"]);
    assert!((along_m - 0.5).abs() < 1e-12, "{along_m}");
    // The session's own dynamics are back in the next episode.
    agent.look(json!({ "type": "reset" })).await;
    agent.step(1.0).await;
    agent.ask(json!({ "type": "close" })).await;
    for path in server.recorded() {
        let report = replay(&server, &path, &Painter::default()).unwrap();
        assert_eq!((report.diverged, report.difference), (None, None), "{}", path.display());
    }
}

#[tokio::test]
async fn what_is_no_start_is_refused() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let random = |fields: Value| json!({ "start": { "random": fields } });
    for (fields, code, field) in [
        (random(json!({ "from_m": -1.0 })), "out_of_range", "start.random.from_m"),
        (random(json!({ "from_m": 9.5 })), "out_of_range", "start.random.from_m"),
        (random(json!({ "from_m": 5.0, "to_m": 4.0 })), "out_of_range", "start.random.to_m"),
        (random(json!({ "to_m": 9.5 })), "out_of_range", "start.random.to_m"),
        (random(json!({ "lateral_m": 21.0 })), "out_of_range", "start.random.lateral_m"),
        (random(json!({ "heading_rad": -0.1 })), "out_of_range", "start.random.heading_rad"),
        (random(json!({ "trajectory": "x" })), "unknown_trajectory", "start.random.trajectory"),
        (json!({ "speed": 3.0 }), "out_of_range", "speed"),
        (json!({ "dynamics": "dynamic", "speed": 61.0 }), "out_of_range", "speed"),
    ] {
        let mut request = fields;
        request["type"] = "reset".into();
        let answer = agent.ask(request).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{answer}");
        agent.seq -= 1;
    }
}

/// After a switch of version and a reset, `resumed` has the present settings.
#[tokio::test]
async fn resumed_tells_the_settings_of_now() {
    let server = TestServer::start().await;
    crate::support::commit_twin_with_opacity(server.twins.path(), -1.0);
    let mut agent = server.agent().await;
    let outputs = json!({ "encoding": "png", "trust": true, "period_us": { "rear": 200_000 } });
    let opened = agent
        .open(json!({
            "session": "a", "version": 1, "seed": 5, "warm_up_us": 200_000, "outputs": outputs,
            "dynamics": { "model": "dynamic", "speed": 4.0 }, "sensors": { "imu": {} },
        }))
        .await;
    agent.look(json!({ "type": "reset", "seed": 8 })).await;
    let switched = agent.ask(json!({ "type": "switch_version", "version": 2 })).await;
    drop(agent);
    let mut again = server.agent().await;
    let resumed = again.ask(json!({ "type": "resume", "session": "a", "last_seq": 3 })).await;
    let mut now = resumed["opened"].clone();
    for (field, value) in [
        ("version", json!(2)),
        ("version_hash", switched["version_hash"].clone()),
        ("seed", json!(8)),
    ] {
        assert_ne!(opened[field], value);
        assert_eq!(now[field], value, "{now}");
        now[field] = opened[field].clone();
    }
    now["type"] = "opened".into();
    now["reserved_bytes"] = opened["reserved_bytes"].clone();
    assert_eq!(now, opened);
}

#[tokio::test]
async fn resumed_repeats_what_opened_said() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let opened = agent.open(json!({ "session": "a", "outputs": { "frames": 2 } })).await;
    drop(agent);
    let mut again = server.agent().await;
    let resumed = again.ask(json!({ "type": "resume", "session": "a", "last_seq": 1 })).await;
    let mut repeated = resumed["opened"].clone();
    repeated["type"] = "opened".into();
    assert_eq!(repeated, opened);
}
