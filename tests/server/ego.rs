//! Egos that are driven: by action and by trajectory, on the wire, on record, and again.

use serde_json::{Value, json};

use crate::episodes::lines;
use crate::replay::replay;
use crate::support::{Agent, Painter, Seen, TestServer, pose, refused};

/// A session of a car of a model that begins at 5 m/s.
async fn car(server: &TestServer, name: &str, model: &str) -> Agent {
    let mut agent = server.agent().await;
    let dynamics = json!({ "model": model, "speed": 5.0 });
    let opened = agent
        .open(json!({
            "session": name, "dynamics": dynamics, "outputs": { "encoding": "raw" }, "contact": "report",
        }))
        .await;
    let resolved = json!({ "model": model, "speed": 5.0, "reverse": false });
    assert_eq!(opened["dynamics"], resolved);
    agent
}

async fn act(agent: &mut Agent, acceleration: f64, curvature: f64) -> Seen {
    let action = json!({ "acceleration": acceleration, "curvature": curvature });
    agent.look(json!({ "type": "step", "action": action })).await
}

/// The rest of a circle of 25 m radius that is driven at 5 m/s, after `driven_s`, in the frame of a
/// rig near it: 2 s of poses.
fn rest_of_circle(ego: &Value, driven_s: f64) -> Value {
    let xyz = numbers(&ego["pose"]["xyz"]);
    let q = numbers(&ego["pose"]["q"]);
    let yaw = 2.0 * q[3].atan2(q[0]);
    let timed = |k: usize| {
        let angle = 0.2 * (driven_s + 0.1 * (k + 1) as f64);
        let x = 25.0 * angle.sin() - xyz[0];
        let y = 25.0 * (1.0 - angle.cos()) - xyz[1];
        let xyz = [x * yaw.cos() + y * yaw.sin(), y * yaw.cos() - x * yaw.sin(), 0.0];
        let half = 0.5 * (angle - yaw);
        let pose = json!({ "xyz": xyz, "q": [half.cos(), 0.0, 0.0, half.sin()] });
        json!({ "time_us": 100_000 * (k + 1), "pose": pose })
    };
    (0..20).map(timed).collect()
}

/// Poses along a circle of the rig's frame, 0.1 s apart.
fn circle(speed_m_s: f64, curvature: f64, poses: usize) -> Value {
    let timed = |k: usize| {
        let seconds = 0.1 * (k + 1) as f64;
        let angle = speed_m_s * seconds * curvature;
        let xyz = [angle.sin() / curvature, (1.0 - angle.cos()) / curvature, 0.0];
        let q = [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()];
        json!({ "time_us": 100_000 * (k + 1), "pose": { "xyz": xyz, "q": q } })
    };
    (0..poses).map(timed).collect()
}

fn numbers(value: &Value) -> Vec<f64> {
    let items = value.as_array().expect("an array");
    items.iter().map(|item| item.as_f64().expect("a number")).collect()
}

#[tokio::test]
async fn a_kinematic_car_drives_the_arc_that_it_is_told() {
    let server = TestServer::start().await;
    let mut agent = car(&server, "a", "kinematic").await;
    let start = agent.look(json!({ "type": "reset" })).await;
    assert_eq!(start.meta["ego"]["velocity"], json!([5.0, 0.0, 0.0]));
    // 5 * 0.1 + 2 * 0.1² / 2 = 0.51 m on a radius of 10 m.
    let seen = act(&mut agent, 2.0, 0.1).await;
    let ego = &seen.meta["ego"];
    let angle = 0.051f64;
    let xyz = numbers(&ego["pose"]["xyz"]);
    assert!((xyz[0] - 10.0 * angle.sin()).abs() < 1e-12, "{ego}");
    assert!((xyz[1] - 10.0 * (1.0 - angle.cos())).abs() < 1e-12, "{ego}");
    assert!((ego["yaw_rate"].as_f64().unwrap() - 0.52).abs() < 1e-12, "{ego}");
    assert!((ego["steering"].as_f64().unwrap() - 0.285f64.atan()).abs() < 1e-12, "{ego}");
    let velocity = numbers(&ego["velocity"]);
    assert!((velocity[0] - 5.2 * angle.cos()).abs() < 1e-12, "{ego}");
    // Towards the centre v² / r, along it 2 m/s²: over the step, so in its middle.
    let acceleration = numbers(&ego["acceleration"]);
    assert!((acceleration[1] - 2.65).abs() < 0.01, "{ego}");
    assert!((acceleration[0] - 1.93).abs() < 0.01, "{ego}");
}

#[tokio::test]
async fn a_car_that_brakes_stands() {
    let server = TestServer::start().await;
    for model in ["kinematic", "dynamic"] {
        let mut agent = car(&server, model, model).await;
        let mut last = Value::Null;
        for _ in 0..12 {
            last = act(&mut agent, -9.8, 0.05).await.meta["ego"].clone();
        }
        let standing = act(&mut agent, -9.8, -0.05).await;
        assert_eq!(standing.meta["ego"]["pose"], last["pose"], "{model}");
        assert_eq!(numbers(&standing.meta["ego"]["velocity"]), [0.0; 3], "{model}");
    }
}

#[tokio::test]
async fn a_trajectory_is_followed() {
    let server = TestServer::start().await;
    // A dynamic car begins straight ahead, and its steering lags: it comes back to the circle.
    for (model, begun_m, most_m) in [("kinematic", 0.001, 0.001), ("dynamic", 0.05, 0.005)] {
        let mut agent = car(&server, model, model).await;
        let mut ego = agent.look(json!({ "type": "reset" })).await.meta["ego"].clone();
        for step in 0..60 {
            let path = rest_of_circle(&ego, 0.1 * f64::from(step));
            ego =
                agent.look(json!({ "type": "step", "trajectory": path })).await.meta["ego"].clone();
            let xyz = numbers(&ego["pose"]["xyz"]);
            let angle = 0.02 * f64::from(step + 1);
            let wanted = [25.0 * angle.sin(), 25.0 * (1.0 - angle.cos())];
            let off_m = (xyz[0] - wanted[0]).hypot(xyz[1] - wanted[1]);
            let allowed_m = if step < 40 { begun_m } else { most_m };
            assert!(off_m < allowed_m, "{model}, step {step}: {off_m} m off, {ego}");
        }
    }
    // A teleport is where the trajectory is at the step's end, exactly.
    let mut agent = server.driver("teleport").await;
    let path =
        json!([{ "time_us": 200_000, "pose": { "xyz": [4.0, 1.0, 0.0], "q": [1, 0, 0, 0] } }]);
    let seen = agent.look(json!({ "type": "step", "trajectory": path })).await;
    assert_eq!(seen.meta["ego"]["pose"]["xyz"], json!([2.0, 0.5, 0.0]));
    assert!(seen.meta["ego"].get("steering").is_none(), "a teleport has no wheels");
}

#[tokio::test]
async fn what_does_not_move_this_ego_is_refused() {
    let server = TestServer::start().await;
    let mut teleport = server.driver("a").await;
    let mut driven = car(&server, "b", "dynamic").await;
    let action = json!({ "type": "step", "action": { "acceleration": 1.0, "curvature": 0.0 } });
    let answer = teleport.ask(action).await;
    refused(&answer, "session_state");
    assert_eq!(answer["field"], "action");
    refused(&driven.ask(json!({ "type": "step", "pose": pose(1.0) })).await, "session_state");
    for (step, code, field) in [
        (
            json!({ "action": { "acceleration": 9.81, "curvature": 0.0 } }),
            "out_of_range",
            "action.acceleration",
        ),
        (
            json!({ "action": { "acceleration": 0.0, "curvature": -0.21 } }),
            "out_of_range",
            "action.curvature",
        ),
        (
            json!({ "action": { "acceleration": null, "curvature": 0.0 } }),
            "out_of_range",
            "action.acceleration",
        ),
        (
            json!({ "action": { "acceleration": 0.0, "curvature": 0.0, "jerk": 1.0 } }),
            "invalid_request",
            "action",
        ),
        (json!({ "trajectory": [] }), "out_of_range", "trajectory"),
        (json!({ "trajectory": circle(5.0, 0.1, 65) }), "out_of_range", "trajectory"),
        (
            json!({ "trajectory": [{ "time_us": 0, "pose": pose(0.0) }] }),
            "out_of_range",
            "trajectory[0].time_us",
        ),
        (
            json!({ "trajectory": [{ "time_us": 99_999, "pose": pose(1.0) }] }),
            "out_of_range",
            "trajectory",
        ),
        (
            json!({ "trajectory": [{ "time_us": 100_000, "pose": { "xyz": [0, null, 0], "q": [1, 0, 0, 0] } }] }),
            "pose_not_finite",
            "trajectory[0].pose.xyz[1]",
        ),
        (json!({}), "invalid_request", "pose"),
        (
            json!({ "pose": pose(1.0), "trajectory": circle(5.0, 0.1, 2) }),
            "invalid_request",
            "trajectory",
        ),
    ] {
        let mut request = json!({ "type": "step" });
        request.as_object_mut().unwrap().extend(step.as_object().unwrap().clone());
        let answer = driven.ask(request).await;
        refused(&answer, code);
        let named = answer["field"].as_str().unwrap_or_default();
        assert!(named.starts_with(field), "{answer}");
    }
    assert_eq!(act(&mut driven, 0.0, 0.0).await.meta["step"], 1, "nothing had changed");

    let mut agent = server.agent().await;
    for (dynamics, code, field) in [
        (json!({ "model": "dynamic", "speed": 61.0 }), "out_of_range", "dynamics.speed"),
        (json!({ "model": "dynamic", "speed": -1.0 }), "out_of_range", "dynamics.speed"),
        (json!({ "model": "teleport", "speed": 1.0 }), "out_of_range", "dynamics.speed"),
        (json!("hover"), "invalid_request", "dynamics"),
        (json!({ "model": "dynamic", "mass": 1.0 }), "invalid_request", "dynamics"),
    ] {
        let answer = agent.try_open(json!({ "dynamics": dynamics })).await;
        refused(&answer, code);
        assert!(answer["field"].as_str().unwrap().starts_with(field), "{answer}");
    }
    let back = json!({ "model": "dynamic", "speed": -1.0, "reverse": true });
    agent.open(json!({ "dynamics": back })).await;
}

/// Two laps of the same commands are the same bytes, and a recording drives them again.
#[tokio::test]
async fn a_lap_driven_twice_is_the_same_and_is_on_record() {
    let server = TestServer::start().await;
    let mut laps = Vec::new();
    let mut agent = car(&server, "a", "dynamic").await;
    for _ in 0..2 {
        let mut hashes = vec![agent.look(json!({ "type": "reset" })).await.frame_hash().to_owned()];
        for step in 0..40 {
            let seen = match step % 8 {
                7 => {
                    let path = circle(6.0, 0.02, 20);
                    agent.look(json!({ "type": "step", "trajectory": path })).await
                }
                k => act(&mut agent, 1.5 - 0.5 * f64::from(k), 0.03 * f64::from(k - 3)).await,
            };
            hashes.push(seen.frame_hash().to_owned());
        }
        laps.push(hashes);
    }
    assert_eq!(laps[0], laps[1]);
    assert!(laps[0][5] != laps[0][6], "it moves");
    agent.ask(json!({ "type": "close" })).await;

    let path = server.episodes.path().join("a-1.jsonl");
    let written = lines(&path);
    assert_eq!(written[0]["dynamics"]["model"], "dynamic");
    let action = json!({ "acceleration_m_s2": 1.5, "curvature_1_m": -0.09 });
    assert_eq!(written[2]["command"], json!({ "action": action }));
    let report = replay(&server, &path, &Painter::default()).unwrap();
    assert_eq!((report.images, report.diverged, report.difference), (82, None, None));

    // An error of 0.01 m/s² changes the poses, and the report names the step.
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replacen(":1.5,", ":1.49,", 1)).unwrap();
    let diverged = replay(&server, &path, &Painter::default()).unwrap().diverged.unwrap();
    assert_eq!((diverged.line, diverged.step), (3, 1));
}
