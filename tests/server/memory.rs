//! Observations in memory that the server shares with a client on its machine.
#![cfg(target_os = "linux")]

use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use wildcity_client::{Client, ClientError, ConnectOptions, Movement, Open, Pose};
use wildcity_protocol::error::Code;
use wildcity_protocol::message::Outputs;
use wildcity_session::limits::ANSWERS_BYTES;

use crate::support::{Agent, Reply, Seen, TEST_TIMEOUT, TestServer, client_limits, pose, refused};

const SLOT_BYTES: u64 = 3 << 29;

/// The memory of a connection, opened as a client opens it.
struct Memory {
    file: File,
    target: String,
}

/// A message in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Place {
    slot: u64,
    offset: u64,
    bytes: u64,
}

impl Memory {
    fn open(offer: &Value) -> (Self, String) {
        assert_eq!(offer["type"], "shared_memory", "{offer}");
        let path = offer["path"].as_str().unwrap();
        let target = offer["target"].as_str().unwrap().to_owned();
        assert_eq!(std::fs::read_link(path).unwrap(), Path::new(&target));
        let file = File::open(path).unwrap();
        let mut proof = vec![0; offer["proof_bytes"].as_u64().unwrap() as usize];
        file.read_exact_at(&mut proof, 0).unwrap();
        (Self { file, target }, String::from_utf8(proof).unwrap())
    }

    fn read(&self, place: Place) -> Vec<u8> {
        let mut message = vec![0; place.bytes as usize];
        self.file.read_exact_at(&mut message, place.offset).unwrap();
        message
    }

    /// Whether this process, which is server and client, has the memory open.
    fn is_open(target: &str) -> bool {
        let files = std::fs::read_dir("/proc/self/fd").unwrap();
        let mut links = files.filter_map(|file| std::fs::read_link(file.unwrap().path()).ok());
        links.any(|link| link == Path::new(target))
    }

    async fn is_given_back(target: &str) {
        let closed = async {
            while Self::is_open(target) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(TEST_TIMEOUT, closed).await.expect("the memory is closed");
    }
}

impl Agent {
    async fn share_memory(&mut self) -> Memory {
        let offer = self.ask(json!({ "type": "share_memory" })).await;
        assert_eq!((&offer["slots"], &offer["slot_bytes"]), (&json!(3), &json!(SLOT_BYTES)));
        let (memory, proof) = Memory::open(&offer);
        let done = self.ask(json!({ "type": "share_memory", "proof": proof })).await;
        assert_eq!(done["type"], "ok", "{done}");
        memory
    }

    /// Sends a request with the next number; its answer is in memory.
    async fn place(&mut self, request: Value) -> Place {
        let answer = self.ask(request).await;
        assert_eq!(answer["type"], "in_memory", "{answer}");
        assert_eq!(answer["seq"], self.seq - 1);
        let number = |name: &str| answer[name].as_u64().unwrap();
        Place { slot: number("slot"), offset: number("offset"), bytes: number("bytes") }
    }
}

fn step(x_m: f64) -> Value {
    json!({ "type": "step", "pose": pose(x_m) })
}

/// A client that has resumed a session, with or without shared memory.
async fn resumed(server: &TestServer, last_seq: u64, shares: bool) -> (Agent, Option<Memory>) {
    let mut agent = server.agent().await;
    let memory = if shares { Some(agent.share_memory().await) } else { None };
    let resume = json!({ "type": "resume", "session": "a", "last_seq": last_seq });
    assert_eq!(agent.ask(resume).await["type"], "resumed");
    agent.seq = last_seq + 1;
    (agent, memory)
}

/// Each answer is fetched again through the socket, and must have the same bytes.
#[tokio::test]
async fn memory_and_socket_have_the_same_bytes() {
    let server = TestServer::start().await;
    for encoding in ["raw", "png", "jpeg"] {
        let mut agent = server.agent().await;
        let mut memory = agent.share_memory().await;
        let outputs = json!({
            "encoding": encoding, "depth": true, "opacity": true, "normals": true, "instances": true,
            "semantics": true, "frames": 2,
        });
        agent.open(json!({ "session": "a", "outputs": outputs })).await;
        for k in 0..5_u32 {
            let request = match k {
                0 => json!({ "type": "reset" }),
                3 => json!({ "type": "observe", "poses": [pose(1.0), pose(2.0)] }),
                k => step(f64::from(k)),
            };
            let place = agent.place(request.clone()).await;
            let written = memory.read(place);
            let seq = agent.seq - 1;
            drop(agent);
            let (mut plain, _) = resumed(&server, seq - 1, false).await;
            let sent = plain.look(request.clone()).await;
            assert!(sent.bytes == written, "{encoding} {k}: {} bytes", written.len());
            assert!(sent.tensors().names().iter().any(|name| name.ends_with("front/instances")));
            drop(plain);
            // And once more in memory, on a third connection.
            let (again, other) = resumed(&server, seq - 1, true).await;
            (agent, memory) = (again, other.unwrap());
            let place = agent.place(request).await;
            assert_eq!((place.slot, place.offset), (0, 0));
            assert_eq!(memory.read(place), written);
        }
        assert_eq!(agent.ask(json!({ "type": "close" })).await["type"], "closed");
    }
}

/// An observation is unchanged until the third one after it is requested.
#[tokio::test]
async fn slots_are_used_in_turn() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let memory = agent.share_memory().await;
    agent.open(json!({ "session": "a", "outputs": { "encoding": "raw" } })).await;
    let mut last: Vec<(Place, Vec<u8>)> = Vec::new();
    for k in 0..10_u32 {
        let place = agent.place(step(f64::from(k))).await;
        let slot = u64::from(k % 3);
        assert_eq!((place.slot, place.offset), (slot, slot * SLOT_BYTES));
        let message = memory.read(place);
        assert_eq!(Seen::decode(message.clone().into()).meta["step"], k + 1);
        last.push((place, message));
        if last.len() > 3 {
            last.remove(0);
        }
        for (place, message) in &last {
            assert_eq!(memory.read(*place), *message);
        }
        // Answers in text, refusals among them, use up no slot.
        assert_eq!(agent.ask(json!({ "type": "snapshot", "name": "s" })).await["type"], "ok");
        refused(&agent.ask(json!({ "type": "observe", "poses": [] })).await, "out_of_range");
        agent.seq -= 1;
    }
    // A repeated answer does.
    let place = agent.place(step(20.0)).await;
    agent.seq -= 1;
    let again = agent.place(step(20.0)).await;
    assert_eq!((place.slot, again.slot), (1, 2));
    assert_eq!(memory.read(place), memory.read(again));
}

/// The answer to `step_many` is one message in memory, and that of a long message is written as
/// that of a short one.
#[tokio::test]
async fn steps_of_several_sessions_and_large_images() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let memory = agent.share_memory().await;
    let size = json!({ "size": [640, 480] });
    let outputs = json!({ "encoding": "raw", "images": { "front": size } });
    for name in ["a", "b"] {
        agent.open(json!({ "session": name, "outputs": outputs })).await;
    }
    let to = |name: &str, x_m: f64| json!({ "session": name, "pose": pose(x_m) });
    let request = json!({ "type": "step_many", "steps": [to("a", 1.0), to("b", 2.0)] });
    let place = agent.place(request.clone()).await;
    assert!(place.bytes > 2 * 640 * 480 * 3);
    let written = memory.read(place);
    let seq = agent.seq - 1;
    drop(agent);
    let mut plain = server.agent().await;
    let also = json!(["b"]);
    let resume = json!({ "type": "resume", "session": "a", "last_seq": seq - 1, "also": also });
    assert_eq!(plain.ask(resume).await["type"], "resumed");
    plain.seq = seq;
    plain.send(request).await;
    let Reply::Binary(sent) = plain.receive().await else { panic!("not binary") };
    assert!(sent == written, "{} bytes", written.len());
}

#[tokio::test]
async fn what_cannot_share_memory() {
    let server = TestServer::configured(|config| config.shared_memory = false).await;
    let mut agent = server.agent().await;
    let ask = || json!({ "type": "share_memory" });
    let answer = agent.ask(ask()).await;
    refused(&answer, "shared_memory_unavailable");
    assert!(answer["message"].as_str().unwrap().contains("--no-shared-memory"), "{answer}");
    assert_eq!(answer["field"], "type");

    let server = TestServer::start().await;
    for header in ["Forwarded", "X-Forwarded-For", "X-Real-IP", "Via"] {
        let url = format!("ws://{}/v1/session", server.address());
        let mut request = url.into_client_request().unwrap();
        request.headers_mut().insert("Sec-WebSocket-Protocol", "wildcity.v1".parse().unwrap());
        let name: tokio_tungstenite::tungstenite::http::HeaderName = header.parse().unwrap();
        request.headers_mut().insert(name, "10.0.0.7".parse().unwrap());
        let connecting =
            tokio_tungstenite::connect_async_with_config(request, client_limits(), true);
        let mut agent = Agent { socket: connecting.await.unwrap().0, seq: 0 };
        agent.hello().await;
        let answer = agent.ask(ask()).await;
        refused(&answer, "shared_memory_unavailable");
        assert!(answer["message"].as_str().unwrap().contains("proxy"), "{answer}");
    }

    let mut agent = server.agent().await;
    let prove = |proof: &str| json!({ "type": "share_memory", "proof": proof });
    refused(&agent.ask(prove("x")).await, "session_state");
    let (memory, proof) = Memory::open(&agent.ask(ask()).await);
    for wrong in ["", "x", &proof[1..], &proof.to_uppercase()[..31]] {
        let answer = agent.ask(prove(wrong)).await;
        refused(&answer, "shared_memory_unavailable");
        assert_eq!(answer["field"], "proof", "{answer}");
    }
    // Asking again gives new memory, and frees the old.
    let (newer, new_proof) = Memory::open(&agent.ask(ask()).await);
    assert!(newer.target != memory.target && new_proof != proof);
    let target = memory.target.clone();
    drop(memory);
    Memory::is_given_back(&target).await;
    // Without a proof, observations come through the socket, and no other memory is offered any
    // more.
    agent.open(json!({ "session": "a" })).await;
    agent.step(1.0).await;
    refused(&agent.ask(ask()).await, "session_state");
    refused(&agent.ask(prove(&proof)).await, "shared_memory_unavailable");
    assert_eq!(agent.ask(prove(&new_proof)).await["type"], "ok");
    refused(&agent.ask(ask()).await, "session_state");
    refused(&agent.ask(prove(&new_proof)).await, "session_state");
    assert_eq!(agent.place(step(2.0)).await.slot, 0);
}

/// Whichever way a connection ends, the memory is closed and its budget is free.
#[tokio::test]
async fn memory_is_given_back() {
    let server = TestServer::start().await;
    let mut targets = Vec::new();
    for end in ["close", "drop", "kill", "offered"] {
        let mut agent = server.agent().await;
        if end == "offered" {
            // The client disconnects between the two requests.
            let (memory, _) = Memory::open(&agent.ask(json!({ "type": "share_memory" })).await);
            targets.push(memory.target.clone());
            continue;
        }
        let memory = agent.share_memory().await;
        agent.open(json!({ "session": end, "outputs": { "encoding": "raw" } })).await;
        for k in 0..4 {
            agent.place(step(f64::from(k))).await;
        }
        targets.push(memory.target.clone());
        match end {
            "close" => {
                assert_eq!(agent.ask(json!({ "type": "close" })).await["type"], "closed");
            }
            "kill" => {
                // Reset the connection, as the kernel does for a killed process that left bytes
                // unread.
                agent.send(step(9.0)).await;
                let socket = socket2::SockRef::from(&*agent.tcp()).set_linger(Some(Duration::ZERO));
                socket.unwrap();
            }
            _ => {}
        }
        drop(agent);
    }
    for target in &targets {
        Memory::is_given_back(target).await;
    }
    // A session without its connection keeps an answer, but no memory that is shared.
    assert_eq!(server.running.sessions(), 2);
    let engine = server.running.engine().clone();
    for name in ["drop", "kill"] {
        let mut agent = server.agent().await;
        let resume = json!({ "type": "resume", "session": name, "last_seq": 1 });
        let resumed = agent.ask(resume).await;
        agent.seq = resumed["last_seq"].as_u64().unwrap() + 1;
        assert_eq!(agent.ask(json!({ "type": "close" })).await["type"], "closed");
    }
    let mut agent = server.agent().await;
    let memory = agent.share_memory().await;
    agent.open(json!({ "session": "last" })).await;
    agent.place(step(1.0)).await;
    let target = memory.target.clone();
    // The observation itself is gone with the next answer. After that, only the shared memory
    // counts.
    let prefetch = json!({ "type": "prefetch", "poses": [pose(1.0)] });
    assert_eq!(agent.ask(prefetch).await["type"], "ok");
    assert!(engine.reserve_answer_bytes(ANSWERS_BYTES).is_err(), "the memory is counted");
    // The server stops: the client keeps what it has opened, and the server nothing.
    server.running.stop().await;
    drop(agent);
    let freed = async {
        while engine.reserve_answer_bytes(ANSWERS_BYTES).is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, freed).await.expect("the budget is free");
    drop(memory);
    Memory::is_given_back(&target).await;
}

/// Without memory for a slot, an answer goes through the socket, and the next one tries the same
/// slot again.
#[tokio::test]
async fn a_full_budget_sends_through_the_socket() {
    let server = TestServer::start().await;
    let engine = server.running.engine().clone();
    let mut agent = server.agent().await;
    let memory = agent.share_memory().await;
    let size = json!({ "size": [64, 48] });
    let outputs = json!({ "encoding": "raw", "cameras": ["front"], "images": { "front": size } });
    agent.open(json!({ "session": "a", "outputs": outputs })).await;
    assert_eq!(agent.place(step(1.0)).await.slot, 0);

    // Reserve all of the budget except the bytes of the next observation. It is larger than the
    // previous one, whose memory is free by the time that the next one is delivered.
    let places: Vec<Value> = (0..8).map(|k| pose(f64::from(k))).collect();
    let mut all = 0;
    for power in (10..34).rev() {
        let more = 1 << power;
        if engine.reserve_answer_bytes(all + more).is_ok() {
            all += more;
        }
    }
    let mut left = 0;
    let sent = loop {
        left += 1024;
        let held = engine.reserve_answer_bytes(all - left).unwrap();
        agent.send(json!({ "type": "observe", "poses": places })).await;
        let reply = agent.receive().await;
        drop(held);
        match reply {
            Reply::Binary(bytes) => break Seen::decode(bytes),
            Reply::Text(answer) => refused(&answer, "busy"),
            Reply::Closed => panic!("the server has closed the connection"),
        }
        agent.seq -= 1;
    };
    assert_eq!(sent.meta["images"].as_array().unwrap().len(), 8);
    let place = agent.place(step(3.0)).await;
    assert_eq!(place.slot, 1);
    assert_eq!(Seen::decode(memory.read(place).into()).meta["step"], 2);
}

/// The memory's size is sealed, so that no client is killed by SIGBUS.
#[tokio::test]
async fn the_size_cannot_be_changed() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let offer = agent.ask(json!({ "type": "share_memory" })).await;
    let path = offer["path"].as_str().unwrap();
    let file = File::options().write(true).open(path).unwrap();
    for bytes in [0, 3 * SLOT_BYTES + 4096] {
        let refused = file.set_len(bytes).unwrap_err();
        assert_eq!(refused.kind(), std::io::ErrorKind::PermissionDenied, "{refused}");
    }
    assert_eq!(file.metadata().unwrap().len(), 3 * SLOT_BYTES);
    // Only the proof takes memory.
    assert!(std::os::unix::fs::MetadataExt::blocks(&file.metadata().unwrap()) <= 8);
}

fn to(x_m: f64) -> Pose {
    Pose { xyz: [x_m, 0.0, 0.0], q: [1.0, 0.0, 0.0, 0.0] }
}

/// The Rust client, with one session, several, and after a lost connection.
#[tokio::test]
async fn the_rust_client_shares_memory() {
    let server = TestServer::start().await;
    let options = ConnectOptions { shared_memory: true, ..ConnectOptions::default() };
    let mut client = Client::connect_with(&server.running.url(), "test", &options).await.unwrap();
    let open = |name: &str| Open {
        session: Some(name.to_owned()),
        outputs: Outputs {
            encoding: wildcity_protocol::message::Encoding::Raw,
            ..Outputs::default()
        },
        ..Open::twin("test")
    };
    assert_eq!(client.next_seq(), 3);
    client.open(open("a")).await.unwrap();
    for k in 1..=4_u32 {
        let seen = client.step(to(f64::from(k))).await.unwrap();
        seen.verify().unwrap();
        assert_eq!(seen.metadata().step, u64::from(k));
    }
    client.open(open("b")).await.unwrap();
    let steps = ["a", "b"].map(|name| Movement::Pose(to(9.0)).for_session(name)).to_vec();
    let stepped = client.step_many(steps).await.unwrap();
    assert_eq!(stepped[0].result.as_ref().unwrap().metadata().step, 5);
    assert_eq!(stepped[1].result.as_ref().unwrap().metadata().step, 1);
    client.select("a");
    let resumed = client.reconnect().await.unwrap().unwrap();
    assert_eq!(resumed.step, 5);
    client.step(to(10.0)).await.unwrap().verify().unwrap();
    client.close().await.unwrap();
    client.close().await.unwrap();

    let refusing = TestServer::configured(|config| config.shared_memory = false).await;
    let refused = Client::connect_with(&refusing.running.url(), "test", &options).await;
    let code = Code::SharedMemoryUnavailable;
    assert!(matches!(refused, Err(ClientError::Refused { code: found, .. }) if found == code));
}
