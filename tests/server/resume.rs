//! Sessions outlive lost connections.

use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::json;
use wildcity_server::Limits;

use crate::support::{Agent, Reply, TestServer, pose, refused};

/// Resumes a session on a new connection. The numbers of requests continue after `last_seq`.
async fn resume(server: &TestServer, name: &str, last_seq: u64) -> (Agent, serde_json::Value) {
    let mut agent = server.agent().await;
    let request = json!({ "type": "resume", "session": name, "last_seq": last_seq });
    let answer = agent.ask(request).await;
    if let Some(last) = answer["last_seq"].as_u64() {
        agent.seq = last + 1;
    }
    (agent, answer)
}

#[tokio::test]
async fn a_repeated_number_brings_the_same_bytes() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let first = agent.step(1.0).await;
    let begun = server.painter.begun.load(Ordering::SeqCst);
    for _ in 0..3 {
        agent.seq -= 1;
        assert_eq!(agent.step(1.0).await.bytes, first.bytes);
    }
    assert_eq!(server.painter.begun.load(Ordering::SeqCst), begun, "nothing was drawn again");
    assert_eq!(agent.step(2.0).await.meta["step"], 2);
    let close = json!({ "type": "close" });
    let closed = agent.ask(close.clone()).await;
    agent.seq -= 1;
    assert_eq!(agent.ask(close).await, closed);
}

#[tokio::test]
async fn a_session_outlives_its_connection() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    let last = agent.step(2.0).await;
    let last_seq = agent.seq - 1;
    drop(agent);
    let (mut agent, mut resumed) = resume(&server, "a", last_seq).await;
    let settings = resumed.as_object_mut().expect("an object").remove("opened");
    assert_eq!(settings.expect("the settings")["session"], "a");
    let expected = json!({
        "type": "resumed", "seq": 1, "session": "a",
        "last_seq": last_seq, "step": 2, "time_us": 200_000,
    });
    assert_eq!(resumed, expected);
    agent.seq = last_seq;
    assert_eq!(agent.step(2.0).await.bytes, last.bytes);
    assert_eq!(agent.step(3.0).await.meta["step"], 3);
    assert_eq!(server.running.sessions(), 1);
}

#[tokio::test]
async fn an_agent_killed_in_mid_step_finds_its_answer() {
    let server = TestServer::start().await;
    for reset in [false, true] {
        let name = if reset { "reset" } else { "gone" };
        let mut agent = server.driver(name).await;
        agent.step(1.0).await;
        server.painter.slow_ms.store(300, Ordering::SeqCst);
        let begun = server.painter.begun.load(Ordering::SeqCst);
        agent.send(json!({ "type": "step", "pose": pose(2.0) })).await;
        server.painter.begins(begun + 1).await;
        let last_seq = agent.seq - 2;
        if reset {
            // Reset the connection, as the kernel does for a killed process that left bytes unread.
            let socket = socket2::SockRef::from(&*agent.tcp()).set_linger(Some(Duration::ZERO));
            socket.unwrap();
        }
        drop(agent);
        // Resumed while the step still runs: the step is finished first.
        let (mut agent, resumed) = resume(&server, name, last_seq).await;
        assert_eq!((&resumed["last_seq"], &resumed["step"]), (&json!(last_seq + 1), &json!(2)));
        let begun = server.painter.begun.load(Ordering::SeqCst);
        agent.seq = last_seq + 1;
        assert_eq!(agent.step(2.0).await.meta["step"], 2);
        assert_eq!(server.painter.begun.load(Ordering::SeqCst), begun);
        server.painter.slow_ms.store(0, Ordering::SeqCst);
        assert_eq!(agent.step(3.0).await.meta["step"], 3);
    }
    server.still_serves().await;
}

/// A refused request has used its number, on this connection and on the next.
#[tokio::test]
async fn numbers_go_on_after_a_refused_request() {
    let server = TestServer::start().await;
    for repeated in [4, 5] {
        let mut agent = server.driver(&format!("n{repeated}")).await;
        agent.step(1.0).await;
        assert_eq!(agent.step(2.0).await.meta["seq"], 3);
        refused(&agent.ask(json!({ "type": "observe", "poses": [] })).await, "out_of_range");
        assert_eq!(agent.seq, 5);
        drop(agent);
        let (mut agent, resumed) = resume(&server, &format!("n{repeated}"), 4).await;
        assert_eq!(resumed["last_seq"], 3, "{resumed}");
        agent.seq = repeated;
        assert_eq!(agent.step(3.0).await.meta["step"], 3);
    }
}

/// Two refused requests, a lost connection: the number after `last_seq` is valid, and so are those
/// that the refused requests had, and the next one.
#[tokio::test]
async fn last_seq_is_the_number_that_the_server_counts_by() {
    let server = TestServer::start().await;
    for next in [4, 5, 6] {
        let name = format!("n{next}");
        let mut agent = server.driver(&name).await;
        agent.step(1.0).await;
        assert_eq!(agent.step(2.0).await.meta["seq"], 3);
        for seq in [4, 5] {
            assert_eq!(agent.seq, seq);
            refused(&agent.ask(json!({ "type": "observe", "poses": [] })).await, "out_of_range");
        }
        drop(agent);
        let (mut agent, resumed) = resume(&server, &name, 5).await;
        assert_eq!(resumed["last_seq"], 3, "{resumed}");
        for wrong in [2, 7] {
            agent.seq = wrong;
            refused(
                &agent.ask(json!({ "type": "step", "pose": pose(3.0) })).await,
                "seq_out_of_order",
            );
        }
        agent.seq = next;
        let seen = agent.step(3.0).await;
        assert_eq!((&seen.meta["step"], &seen.meta["seq"]), (&json!(3), &json!(next)));
        assert_eq!(agent.step(4.0).await.meta["step"], 4);
    }
}

/// A client that did not get the answer to `close` resumes and repeats it, as with any other
/// request.
#[tokio::test]
async fn a_lost_answer_to_close_can_be_repeated() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    let closed = agent.ask(json!({ "type": "close" })).await;
    let seq = agent.seq - 1;
    drop(agent);
    assert_eq!(server.running.sessions(), 0);
    for _ in 0..2 {
        let (mut agent, resumed) = resume(&server, "a", seq - 1).await;
        let found = [&resumed["type"], &resumed["last_seq"], &resumed["step"], &resumed["time_us"]];
        assert_eq!(found, [&json!("resumed"), &json!(seq), &json!(1), &json!(100_000)]);
        agent.seq = seq;
        assert_eq!(agent.ask(json!({ "type": "close" })).await, closed);
        // The connection continues with the next number.
        refused(&agent.ask(json!({ "type": "close" })).await, "session_state");
        agent.open(json!({ "session": "b" })).await;
        agent.ask(json!({ "type": "close" })).await;
    }
    // Not after the name is used again.
    let mut again = server.driver("a").await;
    refused(&resume(&server, "a", 9).await.1, "seq_out_of_order");
    let Reply::Text(told) = again.receive().await else { panic!("no notification") };
    refused(&told, "session_state");

    // Not for ever.
    let resume_grace = Duration::from_millis(200);
    let server = TestServer::with(Limits { resume_grace, ..Limits::default() }).await;
    let mut agent = server.driver("a").await;
    agent.ask(json!({ "type": "close" })).await;
    tokio::time::sleep(2 * resume_grace).await;
    refused(&resume(&server, "a", 1).await.1, "unknown_session");
}

/// After a network failure the client reconnects before the server notices the failure.
#[tokio::test]
async fn resuming_takes_over_from_a_dead_connection() {
    let server = TestServer::start().await;
    let mut old = server.driver("a").await;
    old.step(1.0).await;
    let (mut new, resumed) = resume(&server, "a", old.seq - 1).await;
    assert_eq!(resumed["type"], "resumed", "{resumed}");
    let Reply::Text(told) = old.receive().await else { panic!("no notification") };
    refused(&told, "session_state");
    old.closed().await;
    assert_eq!(new.step(2.0).await.meta["step"], 2);
    drop(old);
    assert_eq!(new.step(3.0).await.meta["step"], 3);
}

#[tokio::test]
async fn what_cannot_be_resumed() {
    let server = TestServer::start().await;
    let (_, unknown) = resume(&server, "no-such", 0).await;
    refused(&unknown, "unknown_session");
    let said = unknown["message"].as_str().unwrap();
    assert!(said.contains("restarted") && said.contains(r#""episode": "no-such-1""#), "{said}");
    refused(&resume(&server, "../x", 0).await.1, "invalid_name");
    let agent = server.driver("a").await;
    let answer = resume(&server, "a", agent.seq + 5).await.1;
    refused(&answer, "seq_out_of_order");
    assert_eq!(answer["field"], "last_seq");
    agent.closed_after_takeover().await;
    let (mut agent, _) = resume(&server, "a", 1).await;
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
    server.still_serves().await;
}

#[tokio::test]
async fn a_session_that_is_not_resumed_ends() {
    let resume_grace = Duration::from_millis(200);
    let server = TestServer::with(Limits { resume_grace, ..Limits::default() }).await;
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    drop(agent);
    server.sessions_become(0).await;
    refused(&resume(&server, "a", 2).await.1, "unknown_session");
    server.record_ends_with("agent_lost").await;
}

impl Agent {
    async fn closed_after_takeover(mut self) {
        let Reply::Text(told) = self.receive().await else { panic!("no notification") };
        refused(&told, "session_state");
    }
}
