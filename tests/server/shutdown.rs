//! Stopping: running steps are finished, every client is notified, every episode has an end.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::json;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use wildcity_server::Limits;

use crate::support::{Agent, Reply, TEST_TIMEOUT, TestServer, pose, refused};

async fn is_notified(agent: &mut Agent) {
    let Reply::Text(answer) = agent.receive().await else { panic!("no notification") };
    refused(&answer, "shutting_down");
    assert_eq!(answer["fatal"], true);
    agent.closed().await;
}

#[tokio::test]
async fn running_steps_are_answered_and_waiting_clients_notified() {
    // The server would wait for a client for longer than the test does.
    let limits = Limits { drain: 3 * TEST_TIMEOUT, ..Limits::default() };
    let server = TestServer::with(limits).await;
    let mut waiting = server.driver("waiting").await;
    waiting.step(1.0).await;
    let mut running = server.driver("running").await;
    let mut parked = server.driver("parked").await;
    parked.step(1.0).await;
    drop(parked);
    server.painter.held.store(true, Ordering::SeqCst);
    let begun = server.painter.begun.load(Ordering::SeqCst);
    running.send(json!({ "type": "step", "pose": pose(1.0) })).await;
    server.painter.begins(begun + 1).await;

    let TestServer { running: server, painter, episodes, .. } = server;
    let stopping = tokio::spawn(server.stop());
    is_notified(&mut waiting).await;
    painter.held.store(false, Ordering::SeqCst);
    assert_eq!(running.seen().await.meta["step"], 1);
    is_notified(&mut running).await;
    tokio::time::timeout(TEST_TIMEOUT, stopping).await.expect("stopped").unwrap();
    for name in ["waiting", "running", "parked"] {
        let text =
            std::fs::read_to_string(episodes.path().join(format!("{name}-1.jsonl"))).unwrap();
        assert!(text.lines().last().unwrap().contains("server_error"), "{name}: {text}");
    }
}

/// Sessions go on, and can be resumed, until the last one has ended; no other begins.
#[tokio::test]
async fn a_server_that_will_stop_waits_for_its_sessions() {
    let limits = Limits { sessions_end: 3 * TEST_TIMEOUT, ..Limits::default() };
    let server = TestServer::with(limits).await;
    assert_eq!(ready(&server).await, 200);
    let mut driving = server.driver("driving").await;
    let mut idle = server.agent().await;
    let TestServer { running, .. } = &server;
    let ending = running.end_sessions();
    let driven = async {
        // The first poll of `ending` has set the mark.
        while ready(&server).await == 200 {}
        assert_eq!(ready(&server).await, 503);
        let answer = idle.ask(json!({ "type": "open", "session": "late", "twin": "test" })).await;
        refused(&answer, "shutting_down");
        assert_eq!(answer["fatal"], false);
        driving.step(1.0).await;
        driving.look(json!({ "type": "reset", "seed": 2 })).await;
        driving.step(1.0).await;
        assert_eq!(running.sessions(), 1);
        driving.ask(json!({ "type": "close" })).await;
    };
    tokio::time::timeout(TEST_TIMEOUT, async { tokio::join!(ending, driven) })
        .await
        .expect("it waits no longer than the last session");
    server.running.stop().await;
}

#[tokio::test]
async fn sessions_that_do_not_end_are_waited_for_as_long_as_said() {
    for longest_ms in [0, 300] {
        let sessions_end = Duration::from_millis(longest_ms);
        let server = TestServer::with(Limits { sessions_end, ..Limits::default() }).await;
        let mut agent = server.driver("stays").await;
        agent.step(1.0).await;
        let begun = std::time::Instant::now();
        server.running.end_sessions().await;
        let waited = begun.elapsed();
        assert!(waited >= sessions_end && waited < sessions_end + TEST_TIMEOUT / 2, "{waited:?}");
        assert_eq!(server.running.sessions(), 1);
    }
}

/// The status of `GET /readyz`.
async fn ready(server: &TestServer) -> u16 {
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    stream
        .write_all(b"GET /readyz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        .await
        .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    answer.split(' ').nth(1).unwrap().parse().unwrap()
}

/// A GPU's driver crashes if the process ends while another thread drops the device.
#[test]
fn the_backend_is_dropped_before_the_program_ends() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let (painter, ending) = runtime.block_on(async {
        let server = TestServer::start().await;
        let mut agent = server.agent().await;
        agent.open(json!({ "deadline_ms": 100, "outputs": { "encoding": "raw" } })).await;
        server.painter.held.store(true, Ordering::SeqCst);
        let late = agent.ask(json!({ "type": "step", "pose": pose(1.0) })).await;
        refused(&late, "deadline_exceeded");
        drop(agent);
        // The frame ends while the program does.
        let painter = server.painter.clone();
        let ending = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(500));
            painter.held.store(false, Ordering::SeqCst);
        });
        server.running.stop().await;
        (server.painter, ending)
    });
    runtime.shutdown_timeout(TEST_TIMEOUT);
    ending.join().unwrap();
    assert_eq!(Arc::strong_count(&painter), 1);
}
