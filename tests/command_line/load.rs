//! Many clients, slow clients, and the memory of the server after them.

use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::json;
use tokio::net::TcpSocket;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use wildcity_server::Limits;

use crate::served::Served;
use crate::support::{self, Agent, Reply, TestServer, pose, refused};

#[tokio::test]
async fn hundreds_of_sessions_leave_nothing_behind() {
    const SESSIONS: u64 = 400;
    let served = Served::start();
    for _ in 0..100 {
        served.whole_session(2).await;
    }
    let before = served.rss();
    for _ in 0..SESSIONS {
        served.whole_session(2).await;
    }
    let after = served.rss();
    eprintln!("{SESSIONS} sessions: {before} bytes grew to {after}");
    // A leaked session would keep its JPEGs, its history and its cameras: 10 kB at least.
    assert!(after < before + SESSIONS * 4_000, "{before} bytes grew to {after}");
    assert_eq!(served.signal_and_wait(), Some(0));
}

#[tokio::test]
async fn memory_is_flat_over_thousands_of_steps() {
    const STEPS: u32 = 3_500;
    let served = Served::start();
    let mut agent = Agent::connect(served.address).await;
    agent.hello().await;
    agent.open(json!({})).await;
    for step in 0..500 {
        agent.step(f64::from(step)).await;
    }
    let before = served.rss();
    for step in 500..500 + STEPS {
        agent.step(f64::from(step)).await;
    }
    let after = served.rss();
    eprintln!("{STEPS} steps: {before} bytes grew to {after}");
    // A leak of 460 B per step would be detected.
    assert!(after < before + u64::from(STEPS) * 460, "{before} bytes grew to {after}");
}

/// Drives a car the same way twice, in one session: as many bytes in memory after the second lap as
/// in the first, the same bytes seen, and a clock that is exact.
async fn two_laps(steps: u64) {
    // The export of a record takes memory of its own, which this test does not measure.
    let served = Served::with(&["--mcap", "false"]);
    let mut agent = Agent::connect(served.address).await;
    agent.hello().await;
    let dynamics = json!({ "model": "dynamic", "speed": 5.0 });
    agent
        .open(
            json!({ "dynamics": dynamics, "outputs": { "encoding": "raw" }, "contact": "report" }),
        )
        .await;
    let (mut laps, mut early_bytes) = (Vec::new(), None);
    for _ in 0..2 {
        agent.look(json!({ "type": "reset" })).await;
        let mut lap = blake3::Hasher::new();
        for step in 1..=steps {
            let phase = step as f64;
            let (acceleration, curvature) =
                (2.0 * (phase / 7.0).sin(), 0.03 * (phase / 11.0).sin());
            let action = json!({ "acceleration": acceleration, "curvature": curvature });
            let seen = agent.look(json!({ "type": "step", "action": action })).await;
            assert_eq!(seen.meta["time_us"], 100_000 * step);
            lap.update(seen.frame_hash().as_bytes());
            lap.update(seen.meta["ego"].to_string().as_bytes());
            if step == steps / 2 {
                early_bytes.get_or_insert_with(|| served.rss());
            }
        }
        laps.push(lap.finalize());
    }
    assert_eq!(laps[0], laps[1], "what is driven twice is the same");
    let (early, late) = (early_bytes.unwrap(), served.rss());
    eprintln!("2 x {steps} steps: {early} bytes in the middle of the first lap, {late} at the end");
    // One and a half laps lie between. A leak of 70 B per step would be detected, in long laps a
    // smaller one.
    let accepted = (70 * steps * 3 / 2).min(1 << 20);
    assert!(late < early + accepted, "{early} bytes grew to {late}");
}

#[tokio::test]
async fn two_identical_laps_take_the_same_memory() {
    two_laps(5_000).await;
}

#[tokio::test]
#[ignore = "takes minutes"]
async fn two_identical_laps_of_50_000_steps_take_the_same_memory() {
    two_laps(50_000).await;
}

#[tokio::test]
async fn a_thousand_connections_at_once() {
    let served = Served::start();
    let mut agents = Vec::new();
    for _ in 0..1000 {
        let mut agent = Agent::connect(served.address).await;
        assert_eq!(agent.hello().await["type"], "welcome");
        agents.push(agent);
    }
    // All of them are served; as many as allowed get a session.
    let mut opened = 0;
    for agent in &mut agents[..300] {
        let answer = agent.try_open(json!({})).await;
        if answer["type"] == "opened" {
            opened += 1;
        } else {
            refused(&answer, "busy");
        }
    }
    assert_eq!(opened, wildcity_session::limits::SESSIONS);
    assert_eq!(agents[0].step(1.0).await.meta["step"], 1);
    let rss = served.rss();
    assert!(rss < 300 << 20, "{rss} bytes for 1,000 connections");
}

#[tokio::test]
async fn connections_above_the_limit_are_refused() {
    let server = TestServer::with(Limits { connections: 2, ..Limits::default() }).await;
    let first = server.agent().await;
    let mut second = server.agent().await;
    let request = format!("ws://{}/v1/session", server.address());
    let mut request = request.into_client_request().unwrap();
    request.headers_mut().insert("Sec-WebSocket-Protocol", "wildcity.v1".parse().unwrap());
    match tokio_tungstenite::connect_async(request).await {
        Err(tokio_tungstenite::tungstenite::Error::Http(answer)) => {
            assert_eq!(answer.status(), 503);
            let body = String::from_utf8(answer.into_body().unwrap()).unwrap();
            assert!(body.contains("\"busy\""), "{body}");
        }
        other => panic!("{other:?}"),
    }
    drop(first);
    let seated = async {
        while server.running.connections() == 2 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(support::TEST_TIMEOUT, seated).await.expect("a free place");
    server.still_serves().await;
    second.open(json!({})).await;
}

/// A client with a small receive buffer that never reads an image of this size: its megabytes do
/// not fit anywhere. Linux keeps 4 MB of a connection.
async fn client_that_never_reads(server: &TestServer, name: &str, size_px: [u32; 2]) -> Agent {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(4096).unwrap();
    let stream = socket.connect(server.address()).await.unwrap();
    let mut request =
        format!("ws://{}/v1/session", server.address()).into_client_request().unwrap();
    request.headers_mut().insert("Sec-WebSocket-Protocol", "wildcity.v1".parse().unwrap());
    let stream = tokio_tungstenite::MaybeTlsStream::Plain(stream);
    let limits = support::client_limits();
    let connected = tokio_tungstenite::client_async_with_config(request, stream, limits).await;
    let (socket, _) = connected.unwrap();
    let mut agent = Agent { socket, seq: 0 };
    agent.hello().await;
    let camera = json!({
        "name": "c", "width": size_px[0], "height": size_px[1],
        "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 4.0, "camera_to_rig": pose(0.0),
    });
    let rig = json!({ "name": "r", "cameras": [camera] });
    agent.open(json!({ "session": name, "rig": rig, "outputs": { "encoding": "raw" } })).await;
    agent.send(json!({ "type": "step", "pose": pose(1.0) })).await;
    agent
}

#[tokio::test]
async fn a_client_that_does_not_read_does_not_affect_others() {
    let (send, resume_grace) = (Duration::from_millis(500), Duration::from_millis(200));
    let server = TestServer::with(Limits { send, resume_grace, ..Limits::default() }).await;
    let stuck = client_that_never_reads(&server, "stuck", [4000, 3000]).await;
    let mut other = server.driver("other").await;
    for step in 0..50 {
        other.step(f64::from(step)).await;
    }
    // It loses its connection, and, because it does not reconnect, its session.
    server.sessions_become(1).await;
    drop(stuck);
    assert_eq!(other.step(50.0).await.meta["step"], 51);
}

#[tokio::test]
async fn many_sessions_take_turns() {
    let server = TestServer::start().await;
    server.painter.slow_ms.store(20, Ordering::SeqCst);
    let mut agents = Vec::new();
    for k in 0..5 {
        agents.push(server.driver(&format!("a{k}")).await);
    }
    let server = &server;
    let drive = |mut agent: Agent| async move {
        for step in 0..10 {
            agent.step(f64::from(step)).await;
        }
        server.painter.begun.load(Ordering::SeqCst)
    };
    let frames_at_end = futures_util::future::join_all(agents.into_iter().map(drive)).await;
    // In turns, all are in their last rounds when the first is done: 46 of 50 frames are drawn.
    // Served one session after the other, it would be done after 10.
    let first = frames_at_end.iter().min().unwrap();
    assert!(*first >= 40, "the first was done after {first} of 50 frames");
}

#[tokio::test]
async fn a_half_read_answer_does_not_affect_others() {
    let server = TestServer::start().await;
    let mut agents = Vec::new();
    for k in 0..8 {
        agents.push(client_that_never_reads(&server, &format!("slow{k}"), [2400, 1800]).await);
    }
    server.still_serves().await;
    // These clients are only slow: once they read, they get everything.
    for agent in &mut agents {
        let Reply::Binary(bytes) = agent.receive().await else { panic!("no observation") };
        assert!(bytes.len() > 3 * 2400 * 1800);
    }
}
