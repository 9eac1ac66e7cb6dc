//! Contents of the records of episodes.

use std::time::{Duration, SystemTime};

use serde_json::json;
use wildcity_episode::Keep;

use crate::episodes::lines;
use crate::support::{Agent, TEST_TIMEOUT, TestServer, pose};

async fn close(mut agent: Agent) {
    let closed = agent.ask(json!({ "type": "close" })).await;
    assert_eq!(closed["type"], "closed", "{closed}");
}

#[tokio::test]
async fn every_frame_is_on_record_before_it_is_answered() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let opened = agent
        .open(json!({ "session": "a", "seed": 3, "outputs": { "encoding": "png", "depth": true } }))
        .await;
    let reset = agent.look(json!({ "type": "reset", "seed": 4 })).await;
    let step = agent.step(1.5).await;
    let observe = agent.look(json!({ "type": "observe", "poses": [pose(4.0), pose(5.0)] })).await;

    let path = server.episodes.path().join("a-1.jsonl");
    let written = lines(&path);
    assert_eq!(written.len(), 4);
    let header = &written[0];
    assert_eq!((&header["kind"], &header["format"]), (&json!("episode"), &json!(0)));
    assert_eq!((&header["session"], &header["seed"]), (&json!("a"), &json!(4)));
    assert_eq!((&header["twin"], &header["version"]), (&json!("test"), &json!(1)));
    assert_eq!(header["version_hash"], opened["version_hash"]);
    assert_eq!(header["profile_hash"], opened["profile_hash"]);
    assert_eq!(header["rig"]["cameras"][1]["name"], "rear");
    let outputs = json!({ "encoding": "png", "depth": true, "opacity": false, "normals": false });
    assert_eq!(header["outputs"], outputs);
    assert_eq!(header["dt_us"], 100_000);
    for (line, seen, request) in
        [(1, &reset, "reset"), (2, &step, "step"), (3, &observe, "observe")]
    {
        let line = &written[line];
        assert_eq!((&line["kind"], &line["request"]), (&json!("frame"), &json!(request)));
        assert_eq!(line["step"], seen.meta["step"]);
        assert_eq!(line["time_us"], seen.meta["time_us"]);
        assert_eq!(line["frame_hash"], seen.frame_hash());
        let images = seen.meta["images"].as_array().unwrap();
        let hashes: Vec<_> = images.iter().map(|image| image["hash"].clone()).collect();
        assert_eq!(line["images"], json!(hashes));
    }
    assert_eq!(written[3]["poses"], json!([pose(4.0), pose(5.0)]));
    close(agent).await;
    let end = &lines(&path)[4];
    let expected = json!({
        "kind": "end", "outcome": "completed", "steps": 1, "time_us": 100_000, "distance_m": 1.5,
    });
    assert_eq!(*end, expected);
}

#[tokio::test]
async fn a_session_without_records_leaves_no_file() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    agent.open(json!({ "session": "a", "record": false })).await;
    for seed in [1, 2] {
        agent.look(json!({ "type": "reset", "seed": seed })).await;
        agent.step(1.0).await;
    }
    // What it can return to is in memory.
    agent.ask(json!({ "type": "snapshot", "name": "here" })).await;
    agent.step(2.0).await;
    assert_eq!(agent.look(json!({ "type": "restore", "name": "here" })).await.meta["step"], 1);
    let closed = agent.ask(json!({ "type": "close" })).await;
    assert_eq!((closed["summary"].get("episode"), &closed["summary"]["steps"]), (None, &json!(1)));
    assert!(server.recorded().is_empty());
    // With one, `record` is what it is without the field.
    let mut agent = server.agent().await;
    agent.open(json!({ "session": "b", "record": true })).await;
    agent.look(json!({ "type": "reset", "seed": 1 })).await;
    assert_eq!(server.recorded().len(), 1);
}

#[tokio::test]
async fn old_records_are_removed_while_the_server_runs() {
    let server = TestServer::configured(|config| {
        config.limits.keep_records = Keep { records: Some(1), ..Keep::default() };
        let hour_ago = SystemTime::now() - Duration::from_secs(3600);
        for name in ["old-1", "old-2"] {
            let path = config.directories.episodes.join(format!("{name}.jsonl"));
            std::fs::write(&path, "{\"kind\":\"end\"}\n").unwrap();
            let file = std::fs::OpenOptions::new().append(true).open(path).unwrap();
            file.set_modified(hour_ago).unwrap();
        }
    })
    .await;
    let pruned = async {
        while server.recorded().len() > 1 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, pruned).await.expect("a record is removed");
    server.still_serves().await;
}

#[tokio::test]
async fn a_reset_begins_a_file_and_a_name_in_use_is_left_alone() {
    let server = TestServer::start().await;
    for first in [1, 3] {
        let mut agent = server.driver("a").await;
        agent.step(1.0).await;
        agent.look(json!({ "type": "reset", "seed": 1 })).await;
        close(agent).await;
        let path = |n: u64| server.episodes.path().join(format!("a-{n}.jsonl"));
        assert_eq!(lines(&path(first)).len(), 3, "{first}");
        assert_eq!(lines(&path(first + 1)).len(), 3, "{first}");
    }
    assert_eq!(server.recorded().len(), 4);
    // Nothing was rendered, so there is nothing to record.
    close(server.driver("b").await).await;
    assert_eq!(server.recorded().len(), 4);
}

#[tokio::test]
async fn refused_steps_are_not_on_record() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    agent.ask(json!({ "type": "observe", "poses": [] })).await;
    let bad = json!({ "xyz": [0, 0, 0], "q": [3, 0, 0, 0] });
    agent.ask(json!({ "type": "step", "pose": bad })).await;
    close(agent).await;
    assert_eq!(lines(&server.recorded()[0]).len(), 3);
}
