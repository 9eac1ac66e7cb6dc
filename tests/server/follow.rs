//! Newer versions of a twin: observations name them, and a session may follow them.

use serde_json::json;
use tokio::time::timeout;

use crate::episodes::lines;
use crate::replay::replay;
use crate::support::{
    Agent, Painter, Seen, TEST_TIMEOUT, TestServer, commit_twin_with_opacity, refused,
};

/// Steps until an observation is as wanted.
async fn steps_until(agent: &mut Agent, is_it: impl Fn(&Seen) -> bool) -> Seen {
    let mut x_m = 0.0;
    let found = async {
        loop {
            x_m += 0.1;
            let seen = agent.step(x_m).await;
            if is_it(&seen) {
                return seen;
            }
        }
    };
    timeout(TEST_TIMEOUT, found).await.expect("an observation in time")
}

#[tokio::test]
async fn an_observation_names_a_newer_version() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    agent.open(json!({})).await;
    let first = agent.look(json!({ "type": "reset", "seed": 1 })).await;
    assert_eq!(first.meta.get("newer_version"), None);
    commit_twin_with_opacity(server.twins.path(), -1.0);
    let seen = steps_until(&mut agent, |seen| seen.meta.get("newer_version").is_some()).await;
    assert_eq!((&seen.meta["version"], &seen.meta["newer_version"]), (&json!(1), &json!(2)));
    // It is shown when the agent asks for it, and is the newest then.
    agent.ask(json!({ "type": "switch_version" })).await;
    let seen = agent.step(50.0).await;
    assert_eq!((&seen.meta["version"], seen.meta.get("newer_version")), (&json!(2), None));
}

#[tokio::test]
async fn a_session_follows_the_latest_version() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    agent.open(json!({ "session": "a", "follow": "latest" })).await;
    let first = agent.look(json!({ "type": "reset", "seed": 1 })).await;
    assert_eq!(first.meta["version"], 1);
    commit_twin_with_opacity(server.twins.path(), -1.0);
    let seen = steps_until(&mut agent, |seen| seen.meta["version"] == 2).await;
    assert_eq!(seen.meta.get("newer_version"), None);
    // So does the next episode.
    commit_twin_with_opacity(server.twins.path(), -2.0);
    let reset = async {
        loop {
            let seen = agent.look(json!({ "type": "reset", "seed": 2 })).await;
            if seen.meta["version"] == 3 {
                return;
            }
        }
    };
    timeout(TEST_TIMEOUT, reset).await.expect("a reset in time");
    agent.ask(json!({ "type": "close" })).await;
    // The switch is on record, and a replay makes it at the same step.
    let record = server.episodes.path().join("a-1.jsonl");
    let versions = lines(&record).into_iter().filter(|line| line["kind"] == "version").count();
    assert_eq!(versions, 1);
    let report = replay(&server, &record, &Painter::default()).unwrap();
    assert!(
        report.images > 0 && report.difference.is_none() && report.diverged.is_none(),
        "{report:?}"
    );
}

#[tokio::test]
async fn a_version_and_the_latest_are_not_asked_for_together() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let answer = agent.try_open(json!({ "version": 1, "follow": "latest" })).await;
    refused(&answer, "out_of_range");
    assert_eq!(answer["field"], "follow");
    let answer = agent.try_open(json!({ "follow": "newest" })).await;
    refused(&answer, "invalid_request");
}
