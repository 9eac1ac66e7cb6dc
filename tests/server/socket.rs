//! WebSocket itself (RFC 6455): pings and Close frames at any time.

use std::sync::atomic::Ordering;
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use serde_json::json;
use tokio::io::AsyncWriteExt;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use wildcity_server::Limits;

use crate::support::{Agent, Reply, TEST_TIMEOUT, TestServer, WATCH, connect, pose, refused};

/// The next frame, whatever it is.
async fn frame(agent: &mut Agent) -> Option<Message> {
    let next = tokio::time::timeout(TEST_TIMEOUT, agent.socket.next()).await;
    next.expect("a frame in time").and_then(Result::ok)
}

/// The code of the Close frame that comes next.
async fn close_code(agent: &mut Agent) -> u16 {
    match frame(agent).await {
        Some(Message::Close(Some(CloseFrame { code, .. }))) => code.into(),
        other => panic!("no Close frame with a code: {other:?}"),
    }
}

/// The driver of session "a", whose first step is drawn until the painter is no longer held.
async fn held_step(server: &TestServer) -> Agent {
    let mut agent = server.driver("a").await;
    let begun = server.painter.begun.load(Ordering::SeqCst);
    server.painter.held.store(true, Ordering::SeqCst);
    agent.send(json!({ "type": "step", "pose": pose(1.0) })).await;
    server.painter.begins(begun + 1).await;
    agent
}

#[tokio::test]
async fn pings_are_answered_while_a_request_runs() {
    let server = TestServer::start().await;
    let mut agent = held_step(&server).await;
    for number in 0..5_u8 {
        agent.socket.send(Message::Ping(vec![number; 3].into())).await.unwrap();
        assert_eq!(frame(&mut agent).await, Some(Message::Pong(vec![number; 3].into())));
    }
    server.painter.held.store(false, Ordering::SeqCst);
    assert_eq!(agent.seen().await.meta["step"], 1);
}

/// Not only during a step: before `hello`, and while frames of other requests are rendered.
#[tokio::test]
async fn pings_are_answered_whatever_runs() {
    let server = TestServer::start().await;
    let mut agent = Agent::connect(server.address()).await;
    let pinged = async |agent: &mut Agent| {
        agent.socket.send(Message::Ping("x".into())).await.unwrap();
        assert_eq!(frame(agent).await, Some(Message::Pong("x".into())));
    };
    pinged(&mut agent).await;
    agent.hello().await;
    pinged(&mut agent).await;
    for name in ["a", "b"] {
        agent.open(json!({ "session": name, "outputs": { "encoding": "raw" } })).await;
    }
    let of = |name: &str| json!({ "session": name, "pose": pose(1.0) });
    agent.ask(json!({ "type": "snapshot", "session": "a", "name": "s" })).await;
    for request in [
        json!({ "type": "step_many", "steps": [of("a"), of("b")] }),
        json!({ "type": "observe", "session": "a", "poses": [pose(1.0)] }),
        json!({ "type": "reset", "session": "a" }),
        json!({ "type": "restore", "session": "a", "name": "s" }),
    ] {
        let begun = server.painter.begun.load(Ordering::SeqCst);
        server.painter.held.store(true, Ordering::SeqCst);
        agent.send(request.clone()).await;
        server.painter.begins(begun + 1).await;
        pinged(&mut agent).await;
        server.painter.held.store(false, Ordering::SeqCst);
        let reply = agent.receive().await;
        assert!(matches!(reply, Reply::Binary(_)), "{request}: {reply:?}");
    }
}

#[tokio::test]
async fn requests_that_come_early_wait_in_order() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    server.painter.slow_ms.store(100, Ordering::SeqCst);
    agent.send(json!({ "type": "step", "pose": pose(1.0) })).await;
    agent.socket.send(Message::binary(vec![0; 8])).await.unwrap();
    agent.send(json!({ "type": "step", "pose": pose(2.0) })).await;
    agent.socket.send(Message::Ping("x".into())).await.unwrap();
    agent.send(json!({ "type": "step", "pose": pose(3.0) })).await;
    assert_eq!(frame(&mut agent).await, Some(Message::Pong("x".into())));
    assert_eq!(agent.seen().await.meta["step"], 1);
    let Reply::Text(answer) = agent.receive().await else { panic!("no text") };
    refused(&answer, "unexpected_binary");
    assert_eq!(agent.seen().await.meta["step"], 2);
    assert_eq!(agent.seen().await.meta["step"], 3);

    // More than the server holds: the rest waits in the socket, and arrives in order as well.
    server.painter.slow_ms.store(300, Ordering::SeqCst);
    agent.send(json!({ "type": "step", "pose": pose(4.0) })).await;
    server.painter.slow_ms.store(0, Ordering::SeqCst);
    for number in 0..200 {
        agent.send(json!({ "type": "step", "pose": pose(f64::from(number)) })).await;
    }
    for step in 4..=204 {
        assert_eq!(agent.seen().await.meta["step"], step);
    }
}

#[tokio::test]
async fn a_close_frame_is_answered_with_its_code() {
    let server = TestServer::start().await;
    for (code, answered) in
        [(Some(1000_u16), Some(1000_u16)), (Some(4321), Some(4321)), (None, None)]
    {
        let mut agent = server.agent().await;
        let frame = code.map(|code| CloseFrame { code: code.into(), reason: "done".into() });
        agent.socket.send(Message::Close(frame)).await.unwrap();
        let Some(Message::Close(found)) = self::frame(&mut agent).await else { panic!("no Close") };
        assert_eq!(found.map(|frame| u16::from(frame.code)), answered);
        assert_eq!(self::frame(&mut agent).await, None);
    }
}

/// A client that leaves during a step gets its Close frame at once, and the step is there when it
/// comes back.
#[tokio::test]
async fn a_close_frame_is_answered_while_a_request_runs() {
    let server = TestServer::start().await;
    let mut agent = held_step(&server).await;
    agent.socket.send(Message::Close(None)).await.unwrap();
    assert_eq!(frame(&mut agent).await, Some(Message::Close(None)));
    server.painter.held.store(false, Ordering::SeqCst);
    let mut agent = server.agent().await;
    let resume = json!({ "type": "resume", "session": "a", "last_seq": 1 });
    let resumed = agent.ask(resume).await;
    assert_eq!((&resumed["last_seq"], &resumed["step"]), (&json!(2), &json!(1)));
}

/// A browser closes with 1001 when its page is left. Such sessions do not wait to be resumed,
/// not even if a step was running.
#[tokio::test]
async fn a_client_that_goes_away_leaves_no_session() {
    let server = TestServer::start().await;
    for in_mid_step in [false, true] {
        let mut agent = server.driver("a").await;
        let begun = server.painter.begun.load(Ordering::SeqCst);
        server.painter.held.store(in_mid_step, Ordering::SeqCst);
        agent.send(json!({ "type": "step", "pose": pose(1.0) })).await;
        server.painter.begins(begun + 1).await;
        if !in_mid_step {
            agent.seen().await;
        }
        let away = CloseFrame { code: 1001.into(), reason: "".into() };
        agent.socket.send(Message::Close(Some(away.clone()))).await.unwrap();
        assert_eq!(frame(&mut agent).await, Some(Message::Close(Some(away))));
        server.painter.held.store(false, Ordering::SeqCst);
        let ended = async {
            while server.running.sessions() > 0 {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(20), ended).await.expect("the session ends");
    }
}

/// A page that is left closes with 1001 and reads nothing more, while an answer is being sent to it.
#[tokio::test]
async fn a_client_that_goes_away_during_an_answer_leaves_no_session() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    // More than the sockets hold, so that sending waits for the client.
    let camera = json!({ "name": "a", "width": 4096, "height": 2048, "fx": 900, "fy": 900,
                         "cx": 2048, "cy": 1024, "camera_to_rig": pose(0.0) });
    let rig = json!({ "name": "large", "cameras": [camera] });
    agent.open(json!({ "rig": rig, "outputs": { "encoding": "raw" } })).await;
    agent.send(json!({ "type": "step", "pose": pose(1.0) })).await;
    // The answer has begun.
    let mut first = [0; 100];
    agent.tcp().peek(&mut first).await.unwrap();
    let away = CloseFrame { code: 1001.into(), reason: "".into() };
    agent.socket.send(Message::Close(Some(away))).await.unwrap();
    drop(agent);
    server.sessions_become(0).await;
}

/// A page that is left closes with 1001; but another connection already waits for its session.
#[tokio::test]
async fn a_session_that_another_connection_waits_for_goes_on() {
    let server = TestServer::start().await;
    let mut agent = held_step(&server).await;
    let mut other = server.agent().await;
    other.send(json!({ "type": "resume", "session": "a", "last_seq": 1 })).await;
    // Its request arrives: a ping that follows it is answered while it waits.
    other.socket.send(Message::Ping("x".into())).await.unwrap();
    assert_eq!(frame(&mut other).await, Some(Message::Pong("x".into())));
    let away = CloseFrame { code: 1001.into(), reason: "".into() };
    agent.socket.send(Message::Close(Some(away))).await.unwrap();
    server.painter.held.store(false, Ordering::SeqCst);
    let Reply::Text(resumed) = other.receive().await else { panic!("no text") };
    assert_eq!((&resumed["type"], &resumed["step"]), (&json!("resumed"), &json!(1)), "{resumed}");
    other.seq = 3;
    assert_eq!(other.step(2.0).await.meta["step"], 2);
}

#[tokio::test]
async fn the_servers_own_close_frame_says_why() {
    // A silent client.
    let idle = Duration::from_millis(600);
    let server = TestServer::with(Limits { idle, ..Limits::default() }).await;
    let mut agent = server.agent().await;
    let Reply::Text(answer) = agent.receive().await else { panic!("no text") };
    refused(&answer, "timed_out");
    assert_eq!(close_code(&mut agent).await, 1008);

    // Frames that are not WebSocket, text that is not UTF-8, a message that is too large.
    let server = TestServer::start().await;
    let mut too_large = vec![0x81, 0x80 | 127];
    too_large.extend((2_u64 << 20).to_be_bytes());
    too_large.extend([0; 4]);
    for (bytes, code, close) in [
        (vec![0x81, 0x01, b'x'], "malformed_json", 1002),
        (vec![0x83, 0x80, 0, 0, 0, 0], "malformed_json", 1002),
        (vec![0xC1, 0x80, 0, 0, 0, 0], "malformed_json", 1002),
        (vec![0x80, 0x80, 0, 0, 0, 0], "malformed_json", 1002),
        (vec![0x09, 0x80, 0, 0, 0, 0], "malformed_json", 1002),
        (vec![0x81, 0x82, 0, 0, 0, 0, 0xC3, 0x28], "malformed_json", 1007),
        (too_large, "message_too_large", 1009),
    ] {
        let mut agent = server.agent().await;
        agent.tcp().write_all(&bytes).await.unwrap();
        let Reply::Text(answer) = agent.receive().await else { panic!("no text") };
        refused(&answer, code);
        assert_eq!(close_code(&mut agent).await, close, "{bytes:x?}");
    }

    // A session that was resumed elsewhere; a server that stops.
    let mut old = server.driver("a").await;
    let mut new = server.agent().await;
    let resume = json!({ "type": "resume", "session": "a", "last_seq": 1 });
    assert_eq!(new.ask(resume).await["type"], "resumed");
    let Reply::Text(answer) = old.receive().await else { panic!("no text") };
    refused(&answer, "session_state");
    assert_eq!(close_code(&mut old).await, 1008);
    let TestServer { running, .. } = server;
    let stopping = tokio::spawn(running.stop());
    let Reply::Text(answer) = new.receive().await else { panic!("no text") };
    refused(&answer, "shutting_down");
    let message = answer["message"].as_str().unwrap();
    assert!(!message.contains("resume") && message.contains("open"), "{message}");
    assert_eq!(close_code(&mut new).await, 1001);
    drop(new);
    stopping.await.unwrap();
}

/// A watcher gets pongs, and a Close frame with the reason of the end.
#[tokio::test]
async fn watchers_are_told_why_they_end() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let watcher = async || {
        let watcher = connect(server.address(), "/v1/sessions/a/watch", WATCH, None).await;
        watcher.expect("a watcher")
    };
    let mut talker = watcher().await;
    talker.send_text("{}").await;
    assert_eq!(close_code(&mut talker).await, 1008);
    let mut until_the_end = watcher().await;
    until_the_end.socket.send(Message::Ping("x".into())).await.unwrap();
    assert_eq!(frame(&mut until_the_end).await, Some(Message::Pong("x".into())));
    assert_eq!(agent.ask(json!({ "type": "close" })).await["type"], "closed");
    assert_eq!(close_code(&mut until_the_end).await, 1000);
    agent.open(json!({ "session": "a" })).await;
    let mut until_the_stop = watcher().await;
    let TestServer { running, .. } = server;
    let stopping = tokio::spawn(running.stop());
    assert_eq!(close_code(&mut until_the_stop).await, 1001);
    drop(agent);
    stopping.await.unwrap();
}
