//! Bad input: each kind has its own error, the session is unchanged, and the server serves the next
//! client.

use std::sync::atomic::Ordering;
use std::time::Duration;

use futures_util::SinkExt;
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt;
use tokio_tungstenite::tungstenite::Message;
use wildcity_server::Limits;

use crate::support::{self, Agent, Reply, TEST_TIMEOUT, TestServer, pose, refused};

async fn answer(agent: &mut Agent) -> Value {
    match agent.receive().await {
        Reply::Text(value) => value,
        other => panic!("not text: {other:?}"),
    }
}

#[tokio::test]
async fn what_is_not_a_request() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    for (text, code) in [
        ("", "malformed_json"),
        ("{", "malformed_json"),
        ("hello", "malformed_json"),
        ("{\"type\":\"close\",\"seq\":2}}", "malformed_json"),
        ("[]", "invalid_request"),
        ("{}", "invalid_request"),
        ("{\"type\":\"fly\",\"seq\":2}", "invalid_request"),
        ("{\"type\":\"close\"}", "invalid_request"),
        ("{\"type\":\"close\",\"seq\":-1}", "out_of_range"),
        ("{\"type\":\"close\",\"seq\":2,\"now\":true}", "invalid_request"),
        (
            "{\"type\":\"step\",\"seq\":2,\"pose\":{\"xyz\":[0,0],\"q\":[1,0,0,0]}}",
            "invalid_request",
        ),
        ("{\"type\":\"observe\",\"seq\":2,\"poses\":7}", "invalid_request"),
    ] {
        agent.send_text(text).await;
        let answer = answer(&mut agent).await;
        refused(&answer, code);
        assert_eq!(answer["fatal"], false, "{text}");
    }
    agent.send_text(&"[".repeat(200_000)).await;
    refused(&answer(&mut agent).await, "malformed_json");
    agent.socket.send(Message::binary(vec![0; 100])).await.unwrap();
    refused(&answer(&mut agent).await, "unexpected_binary");
    assert_eq!(agent.step(1.0).await.meta["step"], 1, "the session went on");
    server.still_serves().await;
}

/// The field with a mistake is named, however deep it is.
#[tokio::test]
async fn mistakes_are_named_by_their_path() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let camera = |more: &str| {
        format!(
            r#"{{"name":"c","width":8,"height":8,"fx":8,"cx":4,"cy":4,"camera_to_rig":{{"xyz":[0,0,0],"q":[1,0,0,0]}}{more}}}"#
        )
    };
    let good = camera(r#","fy":8"#);
    let rig = |camera: String| format!(r#""rig":{{"name":"r","cameras":[{good},{camera}]}}"#);
    for (fields, field, reason) in [
        (rig(good.replace("\"cx\":4,", "")), "rig.cameras[1].cx", "missing"),
        (
            rig(camera(r#","fy":8,"lens":{"model":"ftheta"}"#)),
            "rig.cameras[1].lens.reference",
            "missing",
        ),
        (rig(good.replace("\"width\":8", "\"width\":8.5")), "rig.cameras[1].width", "an integer"),
        (
            rig(camera(r#","fy":8,"fov":90"#)),
            "rig.cameras[1].fov",
            "no such field; there is camera_to_rig, cx",
        ),
        (r#""rig":7"#.to_owned(), "rig", "a string or an object, found a number"),
        (
            r#""start":{"pose":{"xyz":[0,0],"q":[1,0,0,0]}}"#.to_owned(),
            "start.pose.xyz",
            "3 values, found 2",
        ),
        (r#""start":{"trajectory":3}"#.to_owned(), "start.trajectory", "a string, found a number"),
        (r#""start":{}"#.to_owned(), "start", "exactly one of pose, trajectory"),
        (r#""outputs":{"deep":true}"#.to_owned(), "outputs.deep", "no such field"),
        (r#""dt_us":"x""#.to_owned(), "dt_us", "an integer, found a string"),
    ] {
        agent.send_text(&format!(r#"{{"type":"open","seq":1,"twin":"test",{fields}}}"#)).await;
        let answer = answer(&mut agent).await;
        refused(&answer, "invalid_request");
        assert_eq!((&answer["field"], &answer["seq"]), (&json!(field), &json!(1)), "{answer}");
        assert!(answer["message"].as_str().unwrap().contains(reason), "{answer}");
    }
    server.still_serves().await;
}

#[tokio::test]
async fn invalid_poses_are_refused() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let step = |pose: &str| format!(r#"{{"type":"step","seq":2,"pose":{pose}}}"#);
    for (pose, code, field) in [
        (r#"{"xyz":[NaN,0,0],"q":[1,0,0,0]}"#, "pose_not_finite", "pose.xyz[0]"),
        (r#"{"xyz":[0,0,0],"q":[1,0,-Infinity,0]}"#, "pose_not_finite", "pose.q[2]"),
        (r#"{"xyz":[0,null,0],"q":[1,0,0,0]}"#, "pose_not_finite", "pose.xyz[1]"),
        (r#"{"xyz":[0,0,1e999],"q":[1,0,0,0]}"#, "pose_not_finite", "pose.xyz[2]"),
        (r#"{"xyz":[0,0,0],"q":[0,0,0,0]}"#, "pose_invalid", "pose.q"),
        (r#"{"xyz":[0,0,0],"q":[2,0,0,0]}"#, "pose_invalid", "pose.q"),
        (r#"{"xyz":[1e12,0,0],"q":[1,0,0,0]}"#, "pose_invalid", "pose.xyz[0]"),
    ] {
        agent.send_text(&step(pose)).await;
        let answer = answer(&mut agent).await;
        refused(&answer, code);
        assert_eq!((&answer["field"], &answer["seq"]), (&json!(field), &json!(2)), "{answer}");
    }
    // A refused step changes nothing and can be sent again, or be followed by the next number.
    agent.send_text(&step(r#"{"xyz":[1,0,0],"q":[1,0,0,0]}"#)).await;
    assert_eq!(agent.seen().await.meta["step"], 1);
    agent.seq = 3;
    let poses = json!([pose(0.0), { "xyz": [0, 0, 0], "q": [1, 1, 0, 0] }]);
    let answer = agent.ask(json!({ "type": "observe", "poses": poses })).await;
    refused(&answer, "pose_invalid");
    assert_eq!(answer["field"], "poses[1].q");
    assert_eq!(agent.step(2.0).await.meta["step"], 2);
}

#[tokio::test]
async fn requests_in_the_wrong_order() {
    let server = TestServer::start().await;
    let mut agent = Agent::connect(server.address()).await;
    refused(&agent.try_open(json!({})).await, "wrong_order");
    let answer = agent
        .ask(json!({
            "type": "hello",
            "client": { "name": "x", "version": "1" },
            "protocols": ["wildcity.v9"],
        }))
        .await;
    refused(&answer, "unsupported_protocol");
    agent.hello().await;
    refused(&agent.hello().await, "wrong_order");
    let step = || json!({ "type": "step", "pose": pose(0.0) });
    refused(&agent.ask(step()).await, "session_state");
    refused(&agent.ask(json!({ "type": "close" })).await, "session_state");
    agent.open(json!({ "session": "a" })).await;
    refused(&agent.try_open(json!({})).await, "session_state");
    agent.seq += 1;
    let answer = agent.ask(step()).await;
    refused(&answer, "seq_out_of_order");
    assert_eq!(answer["field"], "seq");
    agent.seq -= 2;
    agent.step(1.0).await;
    refused(&server.agent().await.try_open(json!({ "session": "a" })).await, "session_exists");
    server.still_serves().await;
}

#[tokio::test]
async fn sessions_that_cannot_be_opened() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let camera = |more: Value| {
        let mut camera = json!({
            "name": "c", "width": 8, "height": 8, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 4.0,
            "camera_to_rig": pose(0.0),
        });
        camera.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        camera
    };
    let rig = |cameras: Vec<Value>| json!({ "rig": { "name": "r", "cameras": cameras } });
    let one = |more: Value| rig(vec![camera(json!({ "name": "other" })), camera(more)]);
    let large = json!({ "width": 16_384, "height": 16_384 });
    for (open, code, field) in [
        (json!({ "twin": "nope" }), "unknown_twin", "twin"),
        (json!({ "twin": "../etc" }), "invalid_name", "twin"),
        (json!({ "version": 99 }), "unknown_version", "version"),
        (json!({ "session": "A b" }), "invalid_name", "session"),
        (json!({ "dt_us": 0 }), "out_of_range", "dt_us"),
        (json!({ "dt_us": 1_000_000_000 }), "out_of_range", "dt_us"),
        (json!({ "deadline_ms": 0 }), "out_of_range", "deadline_ms"),
        (json!({ "deadline_ms": 1_000_000_000 }), "out_of_range", "deadline_ms"),
        (json!({ "rig": "vehicle7" }), "unknown_rig", "rig"),
        (
            json!({ "outputs": { "cameras": ["front", "top"] } }),
            "unknown_camera",
            "outputs.cameras[1]",
        ),
        (
            json!({ "outputs": { "cameras": ["rear", "rear"] } }),
            "invalid_name",
            "outputs.cameras[1]",
        ),
        (json!({ "outputs": { "cameras": [] } }), "out_of_range", "outputs.cameras"),
        (json!({ "outputs": { "quality": 0 } }), "out_of_range", "outputs.quality"),
        (json!({ "start": { "trajectory": "x" } }), "unknown_trajectory", "start.trajectory"),
        (
            json!({ "start": { "trajectory": "log", "station_m": 9.1 } }),
            "out_of_range",
            "start.station_m",
        ),
        (
            json!({ "start": { "pose": { "xyz": [0, 0, 0], "q": [0, 0, 0, 0] } } }),
            "pose_invalid",
            "start.pose.q",
        ),
        (one(json!({ "width": 0 })), "camera_invalid", "rig.cameras[1].width"),
        (one(json!({ "height": 1_000_000_000 })), "camera_invalid", "rig.cameras[1].height"),
        (one(json!({ "fx": -1.0 })), "camera_invalid", "rig.cameras[1].fx"),
        (one(json!({ "fy": null })), "out_of_range", "rig.cameras[1].fy"),
        (
            one(json!({ "lens": { "model": "fisheye", "k": [-1e9, 0, 0, 0] } })),
            "camera_invalid",
            "rig.cameras[1].lens",
        ),
        (
            one(
                json!({ "shutter": { "direction": "top_to_bottom", "duration_us": 1_000_000_000 } }),
            ),
            "camera_invalid",
            "rig.cameras[1].shutter.duration_us",
        ),
        (one(json!({ "name": "other" })), "invalid_name", "rig.cameras[1].name"),
        (rig(vec![]), "out_of_range", "rig.cameras"),
        (rig(vec![camera(json!({})); 17]), "out_of_range", "rig.cameras"),
    ] {
        let answer = agent.try_open(open).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{answer}");
    }
    refused(&agent.try_open(one(large)).await, "answer_too_large");
    assert_eq!(server.running.sessions(), 0);
    agent.open(json!({})).await;
    for poses in [vec![], vec![pose(0.0); 17], vec![pose(0.0); 10_000]] {
        let answer = agent.ask(json!({ "type": "observe", "poses": poses })).await;
        refused(&answer, "out_of_range");
    }
    server.still_serves().await;
}

#[tokio::test]
async fn a_message_of_100_mib_is_refused_unread() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    // A masked text frame that announces 100 MiB (RFC 6455, section 5.2), and its first bytes.
    let mut header = vec![0x81, 0x80 | 127];
    header.extend((100_u64 << 20).to_be_bytes());
    header.extend([0; 4]);
    agent.tcp().write_all(&header).await.unwrap();
    let answer = answer(&mut agent).await;
    refused(&answer, "message_too_large");
    assert_eq!(answer["fatal"], true);
    server.still_serves().await;
    // Sent whole, by a client that only reads when it has sent everything.
    let mut agent = server.driver("b").await;
    agent.tcp().write_all(&header).await.unwrap();
    let block = vec![b' '; 1 << 20];
    for _ in 0..100 {
        agent.tcp().write_all(&block).await.unwrap();
    }
    refused(&self::answer(&mut agent).await, "message_too_large");
    agent.closed().await;
    // In pieces that are each small enough.
    let mut agent = server.driver("c").await;
    let piece = vec![b' '; 1 << 19];
    for opcode in [0x01, 0x00, 0x00] {
        let mut header = vec![opcode, 0x80 | 127];
        header.extend((piece.len() as u64).to_be_bytes());
        header.extend([0; 4]);
        agent.tcp().write_all(&header).await.unwrap();
        agent.tcp().write_all(&piece).await.unwrap();
    }
    refused(&self::answer(&mut agent).await, "message_too_large");
    server.still_serves().await;
}

#[tokio::test]
async fn bytes_that_are_not_websocket() {
    let server = TestServer::start().await;
    for bytes in [
        // Unmasked, a reserved opcode, text that is not UTF-8, a control frame of 126 bytes.
        vec![0x81, 0x01, b'x'],
        vec![0x83, 0x80, 0, 0, 0, 0],
        vec![0x81, 0x82, 0, 0, 0, 0, 0xC3, 0x28],
        [&[0x89, 0x80 | 126, 0, 126, 0, 0, 0, 0][..], &[0; 126]].concat(),
    ] {
        let mut agent = server.agent().await;
        agent.tcp().write_all(&bytes).await.unwrap();
        let answer = answer(&mut agent).await;
        refused(&answer, "malformed_json");
        assert_eq!(answer["fatal"], true);
        agent.closed().await;
    }
    server.still_serves().await;
}

#[tokio::test]
async fn silence_ends_a_connection() {
    let resume_grace = Duration::from_millis(100);
    let hello = Duration::from_secs(1);
    let server = TestServer::with(Limits { hello, ..Limits::default() }).await;
    // Never says hello.
    let mut silent = Agent::connect(server.address()).await;
    refused(&answer(&mut silent).await, "timed_out");
    silent.closed().await;
    // Opens a TCP connection and speaks no HTTP at all.
    let mut half_open = tokio::net::TcpStream::connect(server.address()).await.unwrap();
    let mut rest = Vec::new();
    let reading = tokio::io::AsyncReadExt::read_to_end(&mut half_open, &mut rest);
    tokio::time::timeout(TEST_TIMEOUT, reading).await.expect("closed").unwrap();
    server.still_serves().await;

    // Never says anything but hello; goes silent within a session. The driver must be this fast,
    // also on a busy machine.
    let idle = Duration::from_secs(2);
    let server = TestServer::with(Limits { idle, resume_grace, ..Limits::default() }).await;
    let mut greeter = server.agent().await;
    refused(&answer(&mut greeter).await, "timed_out");
    let mut driver = server.driver("a").await;
    driver.step(1.0).await;
    refused(&answer(&mut driver).await, "timed_out");
    server.sessions_become(0).await;
    server.record_ends_with("agent_timeout").await;
    server.still_serves().await;
}

/// Invalid messages are answered, but do not extend the deadline of `hello`.
#[tokio::test]
async fn hello_must_come_in_time_whatever_else_comes() {
    let hello = Duration::from_secs(1);
    let server = TestServer::with(Limits { hello, ..Limits::default() }).await;
    let mut agent = Agent::connect(server.address()).await;
    for _ in 0..40 {
        tokio::time::sleep(hello / 8).await;
        // The connection may have ended just now.
        let _ = agent.socket.send(Message::text("rubbish")).await;
        match agent.receive().await {
            Reply::Text(answer) if answer["code"] == "timed_out" => return,
            Reply::Text(answer) => refused(&answer, "malformed_json"),
            other => panic!("{other:?}"),
        }
    }
    panic!("still welcome after {:?}", 5 * hello);
}

#[tokio::test]
async fn a_frame_with_too_much_to_draw_is_refused() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    server.painter.too_many.store(true, Ordering::SeqCst);
    let answer = agent.ask(json!({ "type": "step", "pose": pose(1.0) })).await;
    refused(&answer, "answer_too_large");
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
}

#[tokio::test]
async fn pings_are_answered_and_count_as_life() {
    // A busy machine may delay a ping by seconds.
    let idle = Duration::from_secs(5);
    let server = TestServer::with(Limits { idle, ..Limits::default() }).await;
    let mut agent = server.driver("a").await;
    for _ in 0..30 {
        tokio::time::sleep(idle / 20).await;
        agent.socket.send(Message::Ping("x".into())).await.unwrap();
        let pong = futures_util::StreamExt::next(&mut agent.socket).await;
        assert!(matches!(pong, Some(Ok(Message::Pong(_)))), "{pong:?}");
    }
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
}

/// Pongs that the client does not read must neither accumulate in the server nor keep the
/// connection open.
#[tokio::test]
async fn pings_of_a_client_that_does_not_read_are_no_life() {
    let send = Duration::from_millis(300);
    let server = TestServer::with(Limits { send, ..Limits::default() }).await;
    let mut agent = server.agent().await;
    // A masked ping of 125 zeros, 500 at a time (RFC 6455, section 5.2).
    let ping = [&[0x89, 0x80 | 125][..], &[0; 4 + 125]].concat();
    let block = ping.repeat(500);
    let mut written_bytes = 0;
    let flood = async {
        while agent.tcp().write_all(&block).await.is_ok() {
            written_bytes += block.len();
        }
    };
    let ended = tokio::time::timeout(support::TEST_TIMEOUT / 2, flood).await;
    assert!(ended.is_ok(), "still connected after {written_bytes} bytes of pings");
    // Only the bytes that fit into the kernel's buffers.
    assert!(written_bytes < 64 << 20, "{written_bytes} bytes of pings were read");
    server.still_serves().await;
}

#[tokio::test]
async fn a_deadline_that_passes_changes_nothing() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    // The last step must be this fast, also on a busy machine.
    agent.open(json!({ "deadline_ms": 1_000, "outputs": { "encoding": "raw" } })).await;
    server.painter.held.store(true, Ordering::SeqCst);
    let step = json!({ "type": "step", "pose": pose(1.0) });
    refused(&agent.ask(step.clone()).await, "deadline_exceeded");
    // Queued behind the late frame, it is never drawn.
    refused(&agent.ask(step.clone()).await, "deadline_exceeded");
    server.painter.held.store(false, Ordering::SeqCst);
    assert_eq!(agent.look(step).await.meta["step"], 1);
    assert_eq!(server.painter.begun.load(Ordering::SeqCst), 2);
}

#[tokio::test]
async fn a_crash_of_the_renderer_is_one_refused_step() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    server.painter.crash.store(true, Ordering::SeqCst);
    refused(&agent.ask(json!({ "type": "step", "pose": pose(1.0) })).await, "internal");
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
    server.still_serves().await;
}

#[tokio::test]
async fn what_cannot_be_recorded_is_not_answered() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let episodes = server.episodes.path();
    std::fs::remove_dir(episodes).unwrap();
    std::fs::write(episodes, "in the way").unwrap();
    let answer = agent.ask(json!({ "type": "step", "pose": pose(1.0) })).await;
    refused(&answer, "internal");
    assert!(answer["message"].as_str().unwrap().contains("record"), "{answer}");
    std::fs::remove_file(episodes).unwrap();
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
}

#[tokio::test]
async fn a_damaged_twin_is_refused_and_hides_no_other() {
    let server = TestServer::start().await;
    let chunks = server.twins.path().join("test/objects");
    let mut damaged = 0;
    for dir in std::fs::read_dir(chunks).unwrap() {
        for object in std::fs::read_dir(dir.unwrap().path()).unwrap() {
            let path = object.unwrap().path();
            let mut bytes = std::fs::read(&path).unwrap();
            // Manifests are JSON; chunks are not.
            if bytes[0] != b'{' {
                *bytes.last_mut().unwrap() ^= 1;
                let mut permissions = std::fs::metadata(&path).unwrap().permissions();
                std::os::unix::fs::PermissionsExt::set_mode(&mut permissions, 0o644);
                std::fs::set_permissions(&path, permissions).unwrap();
                std::fs::write(&path, bytes).unwrap();
                damaged += 1;
            }
        }
    }
    assert!(damaged > 0);
    let mut agent = server.agent().await;
    let answer = agent.try_open(json!({})).await;
    refused(&answer, "twin_damaged");
    assert_eq!((&answer["field"], server.running.sessions()), (&json!("twin"), 0));
}
