//! What each role may do.

use serde_json::json;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use wildcity_client::{Client, ConnectOptions, HttpClient};
use wildcity_server::Tokens;

use crate::http::{Reply, push_of, send};
use crate::support::TestServer;

const DRIVER: &str = "driver-driver-driver";
const PUSHER: &str = "pusher-pusher-pusher";
const ADMIN: &str = "admin-admin-admin-admin";
const ELSEWHERE: &str = "elsewhere-elsewhere";

fn with_token(token: &str) -> ConnectOptions {
    ConnectOptions::with_token(Some(token.to_owned()))
}

async fn guarded() -> TestServer {
    let hash = blake3::hash(PUSHER.as_bytes());
    let text = json!({ "tokens": [
        { "name": "driver", "role": "drive", "token": DRIVER },
        { "name": "pusher", "role": "push", "hash": format!("blake3:{hash}") },
        { "name": "admin", "role": "admin", "token": ADMIN },
        { "name": "elsewhere", "role": "admin", "token": ELSEWHERE, "twins": ["other"] },
    ]});
    let tokens = Tokens::parse(text.to_string().as_bytes()).unwrap();
    // A public address: with tokens it is allowed.
    TestServer::configured(|config| {
        config.tokens = Some(tokens);
        config.listen = "0.0.0.0:0".parse().unwrap();
    })
    .await
}

async fn ask(server: &TestServer, request: &str, token: Option<&str>, body: &str) -> Reply {
    let bearer = token.map_or(String::new(), |token| format!("\r\nAuthorization: Bearer {token}"));
    let length = body.len();
    let head = format!("{request} HTTP/1.1\r\nContent-Length: {length}{bearer}");
    send(server.address(), &head, body.as_bytes()).await
}

#[tokio::test]
async fn every_route_needs_its_role() {
    let server = guarded().await;
    let upload = json!({ "name": "x", "size": 1, "digest": format!("blake3:{:064}", 0) });
    let upload = upload.to_string();
    let push = r#"{"files": [{"upload": "x"}]}"#;
    for (request, body, roles) in [
        ("GET /v1/twins", "", [DRIVER, PUSHER, ADMIN].as_slice()),
        ("GET /v1/twins/test", "", &[DRIVER, PUSHER, ADMIN]),
        ("GET /v1/twins/test/versions", "", &[DRIVER, PUSHER, ADMIN]),
        ("POST /v1/uploads", &upload, &[PUSHER, ADMIN]),
        ("GET /v1/uploads/x", "", &[PUSHER, ADMIN]),
        ("PATCH /v1/uploads/x", "", &[PUSHER, ADMIN]),
        ("DELETE /v1/uploads/x", "", &[PUSHER, ADMIN]),
        ("POST /v1/twins/test/pushes", push, &[PUSHER, ADMIN]),
        ("GET /v1/twins/test/pushes/x", "", &[PUSHER, ADMIN]),
        ("POST /v1/twins/test/rollback", r#"{"version": 9}"#, &[ADMIN]),
        ("GET /v1/sessions", "", &[ADMIN]),
        ("GET /metrics", "", &[ADMIN]),
    ] {
        for unknown in [None, Some("driver-driver-drive"), Some("")] {
            let refused = ask(&server, request, unknown, body).await;
            refused.refused(401, "unauthorized");
            assert!(refused.header("www-authenticate").is_some(), "{refused:?}");
        }
        for token in [DRIVER, PUSHER, ADMIN] {
            let status = ask(&server, request, Some(token), body).await.status;
            let refused = status == 401 || status == 403;
            assert_eq!(refused, !roles.contains(&token), "{request} of {token}: {status}");
        }
    }
    for open in ["GET /healthz", "GET /readyz"] {
        assert_eq!(ask(&server, open, None, "").await.status, 200, "{open}");
    }
}

#[tokio::test]
async fn a_token_may_only_use_its_twins() {
    let server = guarded().await;
    let listed = ask(&server, "GET /v1/twins", Some(ELSEWHERE), "").await;
    assert_eq!(listed.body, json!({ "twins": [] }));
    for (request, body) in [
        ("GET /v1/twins/test", ""),
        ("GET /v1/twins/test/versions", ""),
        ("POST /v1/twins/test/rollback", r#"{"version": 1}"#),
        ("POST /v1/twins/test/pushes", r#"{"files": [{"upload": "x"}]}"#),
        ("GET /v1/twins/test/pushes/x", ""),
    ] {
        let refused = ask(&server, request, Some(ELSEWHERE), body).await;
        refused.refused(403, "forbidden");
        assert_eq!(refused.body["field"], "twin");
    }
}

async fn upgrade(server: &TestServer, token: Option<&str>) -> Result<crate::support::Agent, u16> {
    let url = format!("ws://127.0.0.1:{}/v1/session", server.address().port());
    let mut request = url.into_client_request().unwrap();
    let headers = request.headers_mut();
    headers.insert("Sec-WebSocket-Protocol", "wildcity.v1".parse().unwrap());
    if let Some(token) = token {
        headers.insert("Authorization", format!("Bearer {token}").parse().unwrap());
    }
    match tokio_tungstenite::connect_async(request).await {
        Ok((socket, _)) => Ok(crate::support::Agent { socket, seq: 0 }),
        Err(tokio_tungstenite::tungstenite::Error::Http(answer)) => Err(answer.status().as_u16()),
        Err(other) => panic!("{other}"),
    }
}

#[tokio::test]
async fn sessions_need_the_role_drive_and_belong_to_their_token() {
    let server = guarded().await;
    assert_eq!(upgrade(&server, None).await.err(), Some(401));
    assert_eq!(upgrade(&server, Some("rubbish")).await.err(), Some(401));
    assert_eq!(upgrade(&server, Some(PUSHER)).await.err(), Some(403));
    let mut driver = upgrade(&server, Some(DRIVER)).await.ok().unwrap();
    assert_eq!(driver.hello().await["twins"][0]["name"], "test");
    driver.open(json!({ "session": "mine" })).await;
    driver.step(1.0).await;

    let mut elsewhere = upgrade(&server, Some(ELSEWHERE)).await.ok().unwrap();
    assert_eq!(elsewhere.hello().await["twins"], json!([]));
    let refused = elsewhere.try_open(json!({})).await;
    crate::support::refused(&refused, "forbidden");
    assert_eq!((&refused["field"], &refused["fatal"]), (&json!("twin"), &json!(false)));
    let resume = json!({ "type": "resume", "session": "mine", "last_seq": 2 });
    crate::support::refused(&elsewhere.ask(resume).await, "unknown_session");
    driver.step(2.0).await;
    let sessions = ask(&server, "GET /v1/sessions", Some(ADMIN), "").await.body;
    assert_eq!(sessions["sessions"][0]["session"], "mine");
}

#[tokio::test]
async fn the_client_sends_its_token() {
    let server = guarded().await;
    let url = format!("http://127.0.0.1:{}", server.address().port());
    let dir = tempfile::tempdir().unwrap();
    let path = crate::http::write(dir.path(), "a.ply", &crate::http::in_cell([0, 0], 40, 1));
    let stranger = HttpClient::new(&url, &ConnectOptions::default()).unwrap();
    let refused = stranger.upload(&path, &mut |_, _| {}).await.unwrap_err();
    assert!(refused.to_string().contains("refused, 401"), "{refused}");
    let pusher = HttpClient::new(&url, &with_token(PUSHER)).unwrap();
    assert!(!format!("{pusher:?}").contains(PUSHER));
    let upload = pusher.upload(&path, &mut |_, _| {}).await.unwrap();
    let begun = pusher.push("test", &push_of(&[&upload.id])).await.unwrap();
    assert_eq!(pusher.wait_for_push(begun, &mut |_| {}).await.unwrap().version, Some(2));
    assert!(pusher.rollback("test", 1).await.unwrap_err().to_string().contains("403"));
    let admin = HttpClient::new(&url, &with_token(ADMIN)).unwrap();
    assert_eq!(admin.rollback("test", 1).await.unwrap(), 3);

    let url = format!("ws://127.0.0.1:{}/v1/session", server.address().port());
    let refused = Client::connect(&url, "stranger").await.unwrap_err();
    assert!(refused.to_string().contains("401"), "{refused}");
    let mut driver = Client::connect_with(&url, "driver", &with_token(DRIVER)).await.unwrap();
    assert!(!format!("{driver:?}").contains(DRIVER));
    driver.open(wildcity_client::Open::twin("test")).await.unwrap();
    assert_eq!(driver.switch_version(Some(2)).await.unwrap().version, 2);
    assert_eq!(driver.reset(0, None).await.unwrap().metadata().version, 2);
}

#[tokio::test]
async fn web_pages_from_elsewhere_may_not_push() {
    let server = TestServer::start().await;
    let body = r#"{"version": 1}"#;
    let request = "POST /v1/twins/test/rollback HTTP/1.1\r\nOrigin: https://example.org";
    let head = format!("{request}\r\nContent-Length: {}", body.len());
    send(server.address(), &head, body.as_bytes()).await.refused(403, "forbidden");
    assert_eq!(crate::http::get(&server, "/v1/twins/test").await.body["version"], 1);
}
