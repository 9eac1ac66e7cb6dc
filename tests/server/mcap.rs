//! MCAP files of episodes that end: written next to the records, delivered, and refused with the
//! reason.

use std::io::Write as _;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, SystemTime};

use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::timeout;
use wildcity_episode::export_file;
use wildcity_server::Config;

use crate::support::{TEST_TIMEOUT, TestServer};

/// The status, the head and the body of an answer.
async fn get(server: &TestServer, path: &str) -> (u16, String, Vec<u8>) {
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.unwrap();
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").unwrap();
    let head = String::from_utf8(answer[..end].to_vec()).unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    (status, head, answer[end + 4..].to_vec())
}

/// An episode of two steps, which is over.
async fn drive(server: &TestServer, name: &str) {
    let mut agent = server.driver(name).await;
    agent.step(1.0).await;
    agent.step(2.0).await;
    let closed = agent.ask(json!({ "type": "close" })).await;
    assert_eq!(closed["summary"]["episode"], format!("{name}-1"));
}

async fn listed(server: &TestServer, name: &str) -> Value {
    let (_, _, body) = get(server, "/v1/episodes").await;
    let all: Value = serde_json::from_slice(&body).unwrap();
    let episodes = all["episodes"].as_array().unwrap();
    episodes.iter().find(|episode| episode["episode"] == name).unwrap().clone()
}

/// The reason of a refusal.
async fn refused(server: &TestServer, path: &str) -> String {
    let (status, _, body) = get(server, path).await;
    let refusal: Value = serde_json::from_slice(&body).unwrap();
    assert_eq!((status, &refusal["code"]), (404, &"unknown_state".into()), "{refusal}");
    refusal["message"].as_str().unwrap().to_owned()
}

/// Topic, time and content of all messages.
fn messages(bytes: &[u8]) -> Vec<(String, u64, Vec<u8>)> {
    let all = mcap::MessageStream::new(bytes).unwrap().map(|message| message.unwrap());
    all.map(|m| (m.channel.topic.clone(), m.log_time, m.data.into_owned())).collect()
}

fn names(dir: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(dir).unwrap();
    let mut names: Vec<_> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[tokio::test]
async fn an_episode_that_ended_is_delivered_as_mcap() {
    let server = TestServer::start().await;
    drive(&server, "a").await;
    // The request waits for the export, which may be under way.
    let (status, head, body) = get(&server, "/v1/episodes/a-1/mcap").await;
    assert_eq!(status, 200, "{head}");
    assert!(head.contains("content-type: application/vnd.mcap"), "{head}");
    let topics = mcap::MessageStream::new(&body).unwrap();
    let topics: Vec<String> = topics.map(|m| m.unwrap().channel.topic.clone()).collect();
    assert_eq!(topics.iter().filter(|topic| *topic == "/wildcity/step").count(), 2, "{topics:?}");
    // It equals the file that the command makes from the record.
    let by_hand = server.twins.path().join("by-hand.mcap");
    export_file(&server.recorded()[0], &by_hand).unwrap();
    // The order of the index differs from file to file.
    assert_eq!(messages(&std::fs::read(by_hand).unwrap()), messages(&body));
    let entry = listed(&server, "a-1").await;
    assert_eq!(entry["mcap_bytes"], body.len());
    assert_eq!(entry.get("mcap_error"), None);
    assert_eq!(names(server.episodes.path()), ["a-1.jsonl", "a-1.mcap"]);
    assert!(refused(&server, "/v1/episodes/a-2/mcap").await.contains("no recorded episode"));
}

#[tokio::test]
async fn an_export_that_fails_is_told_and_fails_nothing_else() {
    let server = TestServer::start().await;
    std::fs::create_dir(server.episodes.path().join("a-1.mcap")).unwrap();
    drive(&server, "a").await;
    let reason = refused(&server, "/v1/episodes/a-1/mcap").await;
    assert!(reason.contains("cannot write") && reason.contains("a-1.mcap"), "{reason}");
    let entry = listed(&server, "a-1").await;
    assert!(entry["mcap_error"].as_str().unwrap().contains("cannot write"), "{entry}");
    assert_eq!((&entry["outcome"], entry.get("mcap_bytes")), (&"completed".into(), None));
    assert_eq!(names(server.episodes.path()), ["a-1.jsonl", "a-1.mcap"], "no temporary file");
    server.still_serves().await;
}

#[tokio::test]
async fn what_was_cut_has_no_mcap_file_until_it_is_exported_by_hand() {
    let server = TestServer::start().await;
    drive(&server, "a").await;
    let (_, _, whole) = get(&server, "/v1/episodes/a-1/mcap").await;
    let record = std::fs::read(server.episodes.path().join("a-1.jsonl")).unwrap();
    // In the middle of the end: the two frames are whole.
    let cut = server.episodes.path().join("b-1.jsonl");
    std::fs::write(&cut, &record[..record.len() - 20]).unwrap();
    let reason = refused(&server, "/v1/episodes/b-1/mcap").await;
    assert!(reason.contains("wildcity episode export b-1"), "{reason}");
    let exported = export_file(&cut, &cut.with_extension("mcap")).unwrap();
    let (status, _, body) = get(&server, "/v1/episodes/b-1/mcap").await;
    assert_eq!(status, 200);
    let [cut, whole] = [&body, &whole].map(|bytes| messages(bytes).len() as u64);
    assert_eq!((cut, cut), (exported.messages, whole));
}

/// The export of `a-1` takes long, since its record has 40,000 frames more than were driven.
#[tokio::test]
async fn no_request_waits_for_an_export() {
    let server = TestServer::start().await;
    let mut first = server.driver("a").await;
    first.step(1.0).await;
    let record = server.episodes.path().join("a-1.jsonl");
    let text = std::fs::read_to_string(&record).unwrap();
    let frame = format!("{}\n", text.lines().last().unwrap());
    // The server appends to the same file.
    let mut file = std::fs::OpenOptions::new().append(true).open(&record).unwrap();
    file.write_all(frame.repeat(40_000).as_bytes()).unwrap();
    let driven = async {
        first.step(2.0).await;
        // Its answer has the result of the whole record.
        first.ask(json!({ "type": "close" })).await;
        let mut agent = server.driver("b").await;
        agent.step(1.0).await;
        agent.look(json!({ "type": "reset", "seed": 2 })).await;
        agent.step(1.0).await;
        agent.ask(json!({ "type": "close" })).await;
    };
    timeout(TEST_TIMEOUT, driven).await.expect("requests are answered");
    let exported = |name: &String| name.ends_with(".mcap");
    let found = names(server.episodes.path());
    assert!(!found.iter().any(exported), "the requests waited: {found:?}");
    let text = std::fs::read_to_string(server.episodes.path().join("b-2.jsonl")).unwrap();
    assert!(text.lines().last().unwrap().contains("\"outcome\":\"completed\""), "{text}");
    // The others follow.
    let (status, _, _) = get(&server, "/v1/episodes/b-2/mcap").await;
    assert_eq!(status, 200);
    let entry = listed(&server, "a-1").await;
    assert_eq!((&entry["outcome"], &entry["steps"]), (&"completed".into(), &2.into()), "{entry}");
}

/// A pipe in place of a record is no record: its export fails at once, and the others follow.
#[tokio::test]
async fn a_pipe_in_place_of_a_record_stops_no_export() {
    let server = TestServer::start().await;
    let mut first = server.driver("a").await;
    first.step(1.0).await;
    let pipe = server.episodes.path().join("a-1.jsonl");
    std::fs::remove_file(&pipe).unwrap();
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    first.ask(json!({ "type": "close" })).await;
    drive(&server, "b").await;
    let (status, _, _) = get(&server, "/v1/episodes/b-1/mcap").await;
    assert_eq!(status, 200);
}

#[tokio::test]
async fn a_server_removes_what_killed_exports_left() {
    let server = TestServer::start().await;
    let config = server.config();
    let TestServer { running, painter, twins, episodes } = server;
    running.stop().await;
    for (name, age_s) in [("a-1.mcap.Xy12Zw.tmp", 7200), ("b-1.mcap.Xy12Zw.tmp", 0)] {
        let file = std::fs::File::create(episodes.path().join(name)).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(age_s)).unwrap();
    }
    let running = wildcity_server::start(config).await.unwrap();
    let server = TestServer { running, painter, twins, episodes };
    drive(&server, "c").await;
    let (status, _, _) = get(&server, "/v1/episodes/c-1/mcap").await;
    assert_eq!(status, 200);
    // The directory was swept before the first export.
    let left = names(server.episodes.path());
    assert_eq!(left, ["b-1.mcap.Xy12Zw.tmp", "c-1.jsonl", "c-1.mcap"]);
}

#[tokio::test]
async fn a_server_that_stops_finishes_its_exports() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    let TestServer { running, episodes, .. } = server;
    timeout(TEST_TIMEOUT, running.stop()).await.unwrap();
    assert_eq!(names(episodes.path()), ["a-1.jsonl", "a-1.mcap"]);
}

#[tokio::test]
async fn a_server_may_write_no_mcap_files() {
    let server = TestServer::configured(|config: &mut Config| config.mcap = false).await;
    drive(&server, "a").await;
    assert!(refused(&server, "/v1/episodes/a-1/mcap").await.contains("--mcap"));
    assert_eq!(names(server.episodes.path()), ["a-1.jsonl"]);
    assert_eq!(listed(&server, "a-1").await.get("mcap_error"), None);
}
