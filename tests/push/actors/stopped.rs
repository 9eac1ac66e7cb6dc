//! Pushes of assets that end early or wait leave nothing half made.

use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::json;
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;
use wildcity_client::{HttpError, NewActor, Push};
use wildcity_server::Limits;
use wildcity_twin::store::{ActorList, Catalog};

use crate::http::{client, get, in_cell, new_push};
use crate::support::TestServer;

use super::{ball, metrics_have, new_actor, nothing_is_stored, refusal, upload_ply};

/// Sends the request of a push, and keeps the connection open.
async fn begin(server: &TestServer, asked: &NewActor) -> TcpStream {
    let body = serde_json::to_string(asked).unwrap();
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    let head = format!(
        "POST /v1/actors HTTP/1.1\r\nHost: localhost\r\nContent-Length: {}\r\n\r\n",
        body.len()
    );
    stream.write_all(format!("{head}{body}").as_bytes()).await.unwrap();
    stream
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_goes_away_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let audit = dir.path().join("audit.jsonl");
    let server = TestServer::configured(|config| config.audit = Some(audit.clone())).await;
    let client = client(&server);
    // Reading these and making their levels of detail takes seconds.
    let id = upload_ply(&client, "large.ply", &ball(1_000_000, 1)).await;
    let stream = begin(&server, &new_actor("large", &[&id])).await;
    metrics_have(&server, "wildcity_pushes_open 1").await;
    drop(stream);
    metrics_have(&server, "wildcity_pushes_total{outcome=\"failed\"} 1").await;
    metrics_have(&server, "wildcity_pushes_open 0").await;
    nothing_is_stored(&server).await;
    let text = std::fs::read_to_string(&audit).unwrap();
    assert!(text.lines().last().unwrap().contains("the push was cancelled"), "{text}");
    // The repeated push makes the asset; the threads of the first push have ended by then, and have
    // stored nothing.
    let made = client.push_actor(&new_actor("large", &[&id])).await.unwrap();
    let listed = client.actors().await.unwrap().actors;
    assert_eq!((listed.len(), &listed[0].hash), (1, &made.hash));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_stops_leaves_nothing_half_made() {
    let server = TestServer::start().await;
    let client = client(&server);
    let id = upload_ply(&client, "large.ply", &ball(1_000_000, 1)).await;
    let pushing = client.clone();
    let asked = new_actor("large", &[&id]);
    let pushed = tokio::spawn(async move { pushing.push_actor(&asked).await });
    metrics_have(&server, "wildcity_pushes_open 1").await;
    let TestServer { running, twins, .. } = server;
    running.stop().await;
    match pushed.await.unwrap() {
        Err(HttpError::Refused { status, .. }) => assert_eq!(status, 503),
        Err(HttpError::NoAnswer { .. }) => {}
        other => panic!("{other:?}"),
    }
    // The threads run for a moment longer.
    tokio::time::sleep(Duration::from_secs(3)).await;
    let catalog = Catalog::open(twins.path()).unwrap();
    assert_eq!(catalog.actors().unwrap(), ActorList::default());
    assert!(!twins.path().join(".actors/objects").exists());
}

#[tokio::test]
async fn a_push_of_an_asset_has_a_time_limit_and_waits_for_memory() {
    let limits = Limits { push: Duration::from_millis(30), ..Limits::default() };
    let server = TestServer::with(limits).await;
    let slow = client(&server);
    let id = upload_ply(&slow, "large.ply", &ball(500_000, 1)).await;
    let (status, code, message) = refusal(&slow, &new_actor("large", &[&id])).await;
    assert_eq!((status, &*code), (422, "push_refused"), "{message}");
    assert!(message.contains("took longer than"), "{message}");
    tokio::time::sleep(Duration::from_secs(2)).await;
    nothing_is_stored(&server).await;

    // While a push of a twin has all of the memory, one of an asset waits.
    let limits = Limits { push_memory_bytes: Some(1 << 20), ..Limits::default() };
    let server = TestServer::with(limits).await;
    let client = client(&server);
    let twin = upload_ply(&client, "twin.ply", &in_cell([0, 0], 40, 1)).await;
    let small = upload_ply(&client, "small.ply", &ball(40, 2)).await;
    server.painter.slow_ms.store(300, Ordering::SeqCst);
    let begun = client.push("test", &new_push(&[&twin])).await.unwrap();
    let asked = new_actor("small", &[&small]);
    let made = async {
        let made = client.push_actor(&asked).await.unwrap();
        (made.gaussians, get(&server, "/v1/twins/test").await.body["version"].clone())
    };
    let ignored = &mut |_: &Push| {};
    let ended = client.wait_for_push(begun, ignored);
    let ((gaussians, version), ended) = tokio::join!(made, ended);
    assert_eq!((gaussians, version), (40, json!(2)), "{ended:?}");
}

#[tokio::test]
async fn pushes_of_assets_count_among_the_open_ones() {
    let limits = Limits { pushes: 1, ..Limits::default() };
    let server = TestServer::with(limits).await;
    let client = client(&server);
    let twin = upload_ply(&client, "twin.ply", &in_cell([0, 0], 40, 1)).await;
    let small = upload_ply(&client, "small.ply", &ball(40, 2)).await;
    server.painter.slow_ms.store(300, Ordering::SeqCst);
    let begun = client.push("test", &new_push(&[&twin])).await.unwrap();
    let (status, code, message) = refusal(&client, &new_actor("small", &[&small])).await;
    assert_eq!((status, &*code), (503, "busy"), "{message}");
    client.wait_for_push(begun, &mut |_| {}).await.unwrap();
    client.push_actor(&new_actor("small", &[&small])).await.unwrap();
}
