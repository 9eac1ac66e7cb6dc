//! Profiles that a server or a session wants otherwise.

use serde_json::{Value, json};

use crate::support::{TestServer, refused};

fn changes(json: Value) -> wildcity::scene::ProfileChanges {
    serde_json::from_value(json).unwrap()
}

#[tokio::test]
async fn a_session_gets_its_own_profile_before_the_servers_and_the_twins() {
    let plain = TestServer::start().await;
    let mut agent = plain.agent().await;
    let twins = agent.open(json!({})).await;
    assert_eq!(twins["profile"]["tau_px"], 1.0, "{twins}");

    let told = TestServer::configured(|config| {
        config.profile = changes(json!({ "tau_px": 2.0, "stop": 0.004 }));
    });
    let told = told.await;
    let servers = told.agent().await.open(json!({ "session": "a" })).await;
    assert_eq!(
        [&servers["profile"]["tau_px"], &servers["profile"]["stop"], &servers["profile"]["blur"]],
        [&json!(2.0), &json!(0.004), &twins["profile"]["blur"]]
    );
    let mut agent = told.agent().await;
    let own = agent.open(json!({ "session": "b", "profile": { "tau_px": 0.0 } })).await;
    assert_eq!([&own["profile"]["tau_px"], &own["profile"]["stop"]], [&json!(0.0), &json!(0.004)]);
    let hashes = [&twins, &servers, &own].map(|opened| opened["profile_hash"].as_str().unwrap());
    assert!(
        hashes[0] != hashes[1] && hashes[1] != hashes[2] && hashes[0] != hashes[2],
        "{hashes:?}"
    );
    let seen = agent.step(1.0).await;
    assert_eq!(seen.meta["profile_hash"], hashes[2], "an observation names what it was made with");
}

#[tokio::test]
async fn a_profile_that_cannot_be_had_is_refused_by_its_field() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    for profile in [
        json!({ "tau_px": -1.0 }),
        json!({ "fov": 90 }),
        json!({ "antialiased": "yes" }),
        json!({ "near": 2.0, "far": 1.0 }),
    ] {
        let answer = agent.try_open(json!({ "profile": profile.clone() })).await;
        refused(&answer, "out_of_range");
        assert_eq!(answer["field"], "profile", "{profile}: {answer}");
    }
    refused(&agent.try_open(json!({ "profile": 7 })).await, "invalid_request");
    agent.open(json!({})).await;
}
