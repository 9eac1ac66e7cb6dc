//! Poses of recorded drives, over HTTP and in `opened`.

use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use wildcity_client::{ConnectOptions, DriveSection, HttpClient};

use crate::support::{TestServer, pose, refused};

/// The status and the body of a `GET`.
async fn get(server: &TestServer, path: &str) -> (u16, Value) {
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    let status = answer.split(' ').nth(1).expect("a status").parse().unwrap();
    let body = answer.split("\r\n\r\n").nth(1).expect("a body");
    (status, serde_json::from_str(body).unwrap_or_else(|_| panic!("{answer}")))
}

/// The drive of the twin `test` has a keyframe every metre and every 0.1 s, to 9 m.
fn at(station_m: f64) -> Value {
    let time_us = (station_m * 100_000.0) as i64;
    json!({ "station_m": station_m, "time_us": time_us, "pose": pose(station_m) })
}

#[tokio::test]
async fn a_drive_has_its_keyframes_or_poses_at_a_distance() {
    let server = TestServer::start().await;
    let (status, drive) = get(&server, "/v1/twins/test/trajectories/log").await;
    assert_eq!((status, &drive["length_m"], &drive["version"]), (200, &json!(9.0), &json!(1)));
    let keyframes: Vec<Value> = (0..10).map(|k| at(f64::from(k))).collect();
    assert_eq!(drive["poses"], json!(keyframes));

    let path = "/v1/twins/test/trajectories/log?version=1&from_m=1.5&to_m=2.5&every_m=0.5";
    let (_, part) = get(&server, path).await;
    assert_eq!(part["poses"], json!([at(1.5), at(2.0), at(2.5)]));

    let client =
        HttpClient::new(&format!("http://{}", server.address()), &ConnectOptions::default())
            .unwrap();
    let section =
        DriveSection { name: "log".into(), from_m: Some(1.5), to_m: Some(2.5), every_m: Some(0.5) };
    let by_client = client.trajectory("test", Some(1), &section).await.unwrap();
    assert_eq!(serde_json::to_value(by_client).unwrap(), part);

    let mut agent = server.agent().await;
    let section = json!({ "name": "log", "from_m": 1.5, "to_m": 2.5, "every_m": 0.5 });
    let opened = agent.open(json!({ "trajectory": section })).await;
    assert_eq!(opened["trajectory"], part);
    agent.ask(json!({ "type": "close" })).await;
    assert_eq!(agent.open(json!({})).await.get("trajectory"), None, "only on request");
}

#[tokio::test]
async fn what_is_no_part_of_a_drive_is_refused() {
    let server = TestServer::start().await;
    for (path, status, code, field) in [
        ("test/trajectories/nope", 404, "unknown_trajectory", "name"),
        ("nope/trajectories/log", 404, "unknown_twin", "twin"),
        ("test/trajectories/log?version=7", 404, "unknown_version", "version"),
        ("test/trajectories/log?version=x", 400, "invalid_request", "version"),
        ("test/trajectories/log?from_m=9.5", 400, "out_of_range", "from_m"),
        ("test/trajectories/log?from_m=NaN", 400, "out_of_range", "from_m"),
        ("test/trajectories/log?from_m=5&to_m=4", 400, "out_of_range", "to_m"),
        ("test/trajectories/log?every_m=0.0001", 400, "out_of_range", "every_m"),
        ("test/trajectories/log?every_m=1&every_m=1", 400, "invalid_request", "every_m"),
        ("test/trajectories/log?step_m=1", 400, "invalid_request", "step_m"),
    ] {
        let (found, body) = get(&server, &format!("/v1/twins/{path}")).await;
        assert_eq!((found, &body["code"], &body["field"]), (status, &json!(code), &json!(field)));
    }
    let mut agent = server.agent().await;
    for (section, code, field) in [
        (json!({ "name": "nope" }), "unknown_trajectory", "trajectory.name"),
        (json!({ "name": "log", "from_m": -1.0 }), "out_of_range", "trajectory.from_m"),
    ] {
        let answer = agent.try_open(json!({ "trajectory": section })).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{answer}");
        agent.seq -= 1;
    }
    assert_eq!(server.running.sessions(), 0);
}
