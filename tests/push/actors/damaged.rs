//! A damaged asset among good ones: the good ones are listed, pushed and used in sessions; the
//! damaged one is listed with the reason. Messages to clients contain no path of the server.

use std::process::Command;

use serde_json::{Value, json};
use wildcity_client::HttpClient;

use crate::http::{Reply, client, get};
use crate::support::{Agent, TestServer, refused};

use super::{ball, new_actor, upload_ply};

/// Pushes a ball. Returns the hash of the asset.
async fn pushed(client: &HttpClient, name: &str, seed: u64) -> String {
    let id = upload_ply(client, &format!("{name}.ply"), &ball(300, seed)).await;
    client.push_actor(&new_actor(name, &[&id])).await.unwrap().hash
}

/// A scenario with one actor of this asset.
fn scenario(asset: &str) -> Value {
    json!({ "format": "wildcity.scenario/1", "name": "one", "twin": { "name": "test" },
            "actors": [{ "name": "ahead", "asset": asset, "stand": { "xyz": [6, 0, 0] } }] })
}

/// Opens a session among an asset, and steps.
async fn drives(agent: &mut Agent, asset: &str) {
    agent.open(json!({ "scenario": scenario(asset) })).await;
    agent.look(json!({ "type": "reset" })).await;
    assert_eq!(agent.step(0.5).await.meta["step"], 1);
    agent.ask(json!({ "type": "close" })).await;
}

fn message(reply: &Reply) -> &str {
    reply.body["message"].as_str().unwrap()
}

#[tokio::test]
async fn the_others_are_listed_pushed_and_driven_among() {
    let server = TestServer::start().await;
    let client = client(&server);
    let good = pushed(&client, "good", 1).await;
    let bad = pushed(&client, "bad", 2).await;
    let objects = server.twins.path().join(".actors/objects");
    let path = objects.join(&bad[..2]).join(&bad);
    let whole = std::fs::read(&path).unwrap();
    let flipped = || {
        let mut bytes = whole.clone();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&path, bytes).unwrap();
    };
    let linked = || std::os::unix::fs::symlink(&path, &path).unwrap();
    let piped = || assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
    let emptied = || std::fs::write(&path, "").unwrap();
    let cases: [(&dyn Fn(), &str, bool); 4] = [
        (&flipped, "its bytes hash to", true),
        (&linked, "it is a symbolic link", false),
        (&piped, "it is not a regular file", false),
        (&emptied, "it is shorter than its start", false),
    ];
    for (round, (damage, why, is_name_known)) in cases.into_iter().enumerate() {
        std::fs::remove_file(&path).unwrap();
        damage();
        let listed = get(&server, "/v1/actors").await;
        assert_eq!(listed.status, 200);
        let names = names(&listed.body["actors"]);
        assert!(names.contains(&"good") && !names.contains(&"bad"), "{names:?}");
        let damaged = listed.body["damaged"].as_array().unwrap();
        assert_eq!((damaged.len(), &damaged[0]["hash"]), (1, &json!(bad)), "{listed:?}");
        assert!(damaged[0]["reason"].as_str().unwrap().contains(why), "{listed:?}");
        assert_eq!(damaged[0].get("name"), is_name_known.then_some(&json!("bad")));
        let seen_by_client = client.actors().await.unwrap();
        assert_eq!(json!(seen_by_client.damaged), listed.body["damaged"]);
        assert_eq!(seen_by_client.actors.len(), names.len());
        assert_eq!(get(&server, "/v1/actors/good").await.body["hash"], good);

        // By its hash, its digits, and its name where that can be read.
        let mut texts = vec![&*bad, &bad[..8]];
        texts.extend(is_name_known.then_some("bad"));
        let mut agent = server.agent().await;
        for text in texts {
            let reply = get(&server, &format!("/v1/actors/{text}")).await;
            reply.refused(500, "twin_damaged");
            assert_eq!(reply.body["field"], "actor");
            assert!(message(&reply).contains(why) && !message(&reply).contains('/'), "{reply:?}");
            let refusal = agent.try_open(json!({ "scenario": scenario(text) })).await;
            refused(&refusal, "scenario_invalid");
            assert_eq!(refusal["field"], "scenario.actors[0].asset");
            let said = refusal["message"].as_str().unwrap();
            assert!(said.contains(why) && !said.contains('/'), "{refusal}");
        }
        let other = pushed(&client, &format!("other{round}"), 10 + round as u64).await;
        for asset in ["good", &good, &other] {
            drives(&mut agent, asset).await;
        }
    }
    // An asset folder that cannot be listed, and the first digits of the hashes in it.
    let folder = path.parent().unwrap();
    std::fs::remove_dir_all(folder).unwrap();
    std::os::unix::fs::symlink(folder, folder).unwrap();
    let listed = client.actors().await.unwrap();
    assert!(listed.actors.iter().any(|actor| actor.hash == good));
    assert_eq!((listed.damaged.len(), &*listed.damaged[0].hash), (1, &bad[..2]), "{listed:?}");
    assert!(listed.damaged[0].reason.contains("it is not a directory"), "{listed:?}");
    assert!(!listed.damaged[0].reason.contains('/'), "{listed:?}");
    get(&server, &format!("/v1/actors/{bad}")).await.refused(500, "twin_damaged");
    for asset in ["good", &good] {
        drives(&mut server.agent().await, asset).await;
    }
    std::fs::remove_file(folder).unwrap();
    std::fs::create_dir(folder).unwrap();
    std::fs::write(&path, "damaged").unwrap();
    // A name that a damaged asset states is free; the same push again repairs it.
    assert_eq!(pushed(&client, "bad", 2).await, bad);
    assert_eq!(std::fs::read(&path).unwrap(), whole);
    assert!(get(&server, "/v1/actors").await.body.get("damaged").is_none());
    drives(&mut server.agent().await, "bad").await;
}

fn names(actors: &Value) -> Vec<&str> {
    actors.as_array().unwrap().iter().map(|actor| actor["name"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn a_lost_or_unknown_asset_is_refused_without_a_path() {
    let server = TestServer::start().await;
    let client = client(&server);
    let none = get(&server, "/v1/actors/bus").await;
    none.refused(404, "unknown_actor");
    assert!(message(&none).contains("wildcity actor import"), "{none:?}");
    let good = pushed(&client, "good", 1).await;
    let lost = pushed(&client, "lost", 2).await;
    let dir = server.twins.path();
    std::fs::remove_file(dir.join(".actors/objects").join(&lost[..2]).join(&lost)).unwrap();
    let mut agent = server.agent().await;
    for text in ["lost", &lost, "bus"] {
        let reply = get(&server, &format!("/v1/actors/{text}")).await;
        reply.refused(404, "unknown_actor");
        let refusal = agent.try_open(json!({ "scenario": scenario(text) })).await;
        refused(&refusal, "scenario_invalid");
        for said in [message(&reply), refusal["message"].as_str().unwrap()] {
            let names_all =
                said.contains(text) && said.contains(&format!("good ({})", &good[..12]));
            assert!(names_all && said.contains("wildcity actor list"), "{said}");
            assert!(!said.contains('/'), "{said}");
        }
    }
    drives(&mut agent, &good).await;
}
