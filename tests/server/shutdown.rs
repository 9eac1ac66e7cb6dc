//! Stopping: running steps are finished, every client is notified, every episode has an end.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::json;

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
