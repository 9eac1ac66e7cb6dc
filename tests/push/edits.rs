//! Edits: level ground, metres, a drive and a rig, all in one version.

use serde_json::{Value, json};

use crate::http::{get, post};
use crate::support::TestServer;

async fn edit(server: &TestServer, body: Value) -> Value {
    let reply = post(server, "/v1/twins/test/edits", &body).await;
    assert_eq!(reply.status, 200, "{reply:?}");
    reply.body
}

fn drive() -> Value {
    json!({"name": "path", "points": [[0, 0, 2], [5, 0, 2], [5, 5, 2]], "speed": 2.0})
}

#[tokio::test]
async fn an_edit_is_one_version_with_a_drive_on_its_ground() {
    let server = TestServer::start().await;
    let before = get(&server, "/v1/twins/test").await.body;
    let ground = json!({"points": [[0, 0, 2], [1, 0, 2], [0, 1, 2]], "above": [0, 0, 9]});
    let scale = json!({"points": [[0, 0, 0], [0, 1, 0]], "distance_m": 2});
    let whole =
        json!({"base": 1, "ground": ground, "scale": scale, "drive": drive(), "rig": "surround6"});
    let made = edit(&server, whole.clone()).await;
    assert_eq!(made["version"], 2);
    let after = get(&server, "/v1/twins/test").await.body;
    assert_eq!(after["version_hash"], made["version_hash"]);
    assert_eq!(after["gaussians"], before["gaussians"]);
    let path = get(&server, "/v1/twins/test/trajectories/path").await.body;
    let poses = path["poses"].as_array().unwrap();
    let z_m = poses.iter().map(|pose| pose["pose"]["xyz"][2].as_f64().unwrap().abs());
    assert!(z_m.fold(0.0, f64::max) < 1e-9, "{path}");
    let length_m = path["length_m"].as_f64().unwrap();
    assert!((20.0..22.0).contains(&length_m), "{length_m}");

    // A session drives it with the new rig.
    let mut agent = server.agent().await;
    let opened = agent
        .open(json!({"twin": "test", "start": {"trajectory": "path", "station_m": 3.0}}))
        .await;
    assert_eq!(opened["cameras"].as_array().unwrap().len(), 6);
    assert_eq!(opened["version"], 2);

    // A client that lost the answer edits version 1 again: it gets the version that it made.
    // Another edit of version 1 is a conflict, and changes nothing.
    assert_eq!(edit(&server, whole.clone()).await, made);
    let mut other = whole;
    other["scale"]["distance_m"] = json!(3);
    post(&server, "/v1/twins/test/edits", &other).await.refused(409, "conflict");
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 2);
}

#[tokio::test]
async fn what_cannot_be_edited_is_named_and_changes_nothing() {
    let server = TestServer::start().await;
    let line = json!({"points": [[0, 0, 0], [1, 0, 0], [2, 0, 0]], "above": [0, 0, 9]});
    let one = json!({"name": "path", "points": [[0, 0, 0], [0, 0, 0]]});
    for (body, status, code, field) in [
        (json!({}), 400, "invalid_request", "ground"),
        (json!({"ground": line}), 400, "invalid_request", "ground.points"),
        (json!({"drive": one}), 400, "invalid_request", "drive.points"),
        (json!({"rig": "nothing"}), 404, "unknown_rig", "rig"),
        (json!({"base": 9, "rig": "vehicle6"}), 404, "unknown_version", "version"),
        (
            json!({"scale": {"points": [[0, 0, 0], [0, 0, 0]], "distance_m": 1}}),
            400,
            "invalid_request",
            "scale",
        ),
    ] {
        let reply = post(&server, "/v1/twins/test/edits", &body).await;
        reply.refused(status, code);
        assert_eq!(reply.body["field"], field, "{reply:?}");
    }
    let reply = post(&server, "/v1/twins/other/edits", &json!({"rig": "vehicle6"})).await;
    reply.refused(404, "unknown_twin");
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 1);
}

#[tokio::test]
async fn the_ground_of_a_twin_is_proposed() {
    let server = TestServer::start().await;
    let survey = get(&server, "/v1/twins/test/ground").await;
    assert_eq!((survey.status, &survey.body["version"]), (200, &json!(1)), "{survey:?}");
    assert_eq!(survey.body["middle"].as_array().unwrap().len(), 3);
    let unknown = get(&server, "/v1/twins/other/ground").await;
    unknown.refused(404, "unknown_twin");
}
