//! Rights of each role.

use std::sync::Arc;

use serde_json::json;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use wildcity_client::{Client, ConnectOptions, HttpClient};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_server::{Config, Tokens};

use crate::http::{Reply, new_push, send};
use crate::support::TestServer;

const DRIVER: &str = "driver-driver-driver";
const PUSHER: &str = "pusher-pusher-pusher";
const ADMIN: &str = "admin-admin-admin-admin";
const ELSEWHERE: &str = "elsewhere-elsewhere";
const RIVAL: &str = "rival-rival-rival";
const SCRAPER: &str = "scraper-scraper-scraper";

fn with_token(token: &str) -> ConnectOptions {
    ConnectOptions::with_token(Some(token.to_owned()))
}

async fn guarded() -> TestServer {
    guarded_with(|_| {}).await
}

async fn guarded_with(change: impl FnOnce(&mut Config)) -> TestServer {
    let hash = blake3::hash(PUSHER.as_bytes());
    let text = json!({ "tokens": [
        { "name": "driver", "role": "drive", "token": DRIVER },
        { "name": "pusher", "role": "push", "hash": format!("blake3:{hash}") },
        { "name": "admin", "role": "admin", "token": ADMIN },
        { "name": "rival", "role": "push", "token": RIVAL },
        { "name": "scraper", "role": "metrics", "token": SCRAPER },
        { "name": "elsewhere", "role": "admin", "token": ELSEWHERE, "twins": ["other"] },
    ]});
    let tokens = Tokens::parse(text.to_string().as_bytes()).unwrap();
    // A public address: with tokens it is allowed.
    TestServer::configured(|config| {
        config.tokens = Some(tokens);
        config.listen = "0.0.0.0:0".parse().unwrap();
        change(config);
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
    let actor = r#"{"name": "a", "class": "object", "files": [{"upload": "x"}]}"#;
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
        ("POST /v1/twins/test/edits", "{}", &[PUSHER, ADMIN]),
        ("GET /v1/twins/test/ground", "", &[PUSHER, ADMIN]),
        ("GET /v1/actors", "", &[DRIVER, PUSHER, ADMIN]),
        ("GET /v1/scenarios", "", &[DRIVER, PUSHER, ADMIN]),
        ("GET /v1/twins/test/scenarios", "", &[DRIVER, PUSHER, ADMIN]),
        ("GET /v1/actors/x", "", &[DRIVER, PUSHER, ADMIN]),
        ("POST /v1/actors", actor, &[PUSHER, ADMIN]),
        ("GET /v1/sessions", "", &[ADMIN]),
        ("POST /v1/tickets", "", &[DRIVER, PUSHER, ADMIN]),
        ("GET /v1/episodes", "", &[ADMIN]),
        ("GET /metrics", "", &[SCRAPER, ADMIN]),
    ] {
        for unknown in [None, Some("driver-driver-drive"), Some("")] {
            let refused = ask(&server, request, unknown, body).await;
            refused.refused(401, "unauthorized");
            assert!(refused.header("www-authenticate").is_some(), "{refused:?}");
        }
        for token in [SCRAPER, DRIVER, PUSHER, ADMIN] {
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
    assert_eq!(upgrade(&server, Some(SCRAPER)).await.err(), Some(403));
    // Placing a drive in the viewer needs the rights to drive and to edit, and one token has both.
    let mut pusher = upgrade(&server, Some(PUSHER)).await.ok().unwrap();
    pusher.hello().await;
    pusher.open(json!({ "session": "placing" })).await;
    pusher.step(1.0).await;
    pusher.ask(json!({ "type": "close" })).await;
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
    let begun = pusher.push("test", &new_push(&[&upload.id])).await.unwrap();
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

/// Changes of the images by a push are visible to all tokens that may push to the twin, and to no
/// others.
#[tokio::test]
async fn the_report_of_a_push_is_for_those_that_may_push() {
    let cpu = Arc::new(Cpu::new(1, Simd::Best).unwrap());
    let server = guarded_with(|config| config.backend = cpu).await;
    let url = format!("http://127.0.0.1:{}", server.address().port());
    let dir = tempfile::tempdir().unwrap();
    let path = crate::http::write(dir.path(), "a.ply", &crate::http::in_cell([0, 0], 40, 1));
    let pusher = HttpClient::new(&url, &with_token(PUSHER)).unwrap();
    let upload = pusher.upload(&path, &mut |_, _| {}).await.unwrap();
    let begun = pusher.push("test", &new_push(&[&upload.id])).await.unwrap();
    let request = format!("GET /v1/twins/test/pushes/{}", begun.id);
    pusher.wait_for_push(begun, &mut |_| {}).await.unwrap();
    for token in [PUSHER, RIVAL, ADMIN] {
        let shown = ask(&server, &request, Some(token), "").await;
        let previews = shown.body["report"]["golden"].as_array().unwrap();
        assert_eq!((shown.status, previews.len()), (200, 4), "{shown:?}");
        assert!(previews.iter().any(|preview| preview["psnr_db"].is_f64()), "{shown:?}");
    }
    for token in [DRIVER, ELSEWHERE] {
        ask(&server, &request, Some(token), "").await.refused(403, "forbidden");
    }
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

/// All twins share the assets, and the source of one may name a twin.
#[tokio::test]
async fn a_token_that_is_limited_to_twins_pushes_no_assets_and_sees_no_sources() {
    let server = guarded().await;
    let url = format!("http://127.0.0.1:{}", server.address().port());
    let dir = tempfile::tempdir().unwrap();
    let path = crate::http::write(dir.path(), "a.ply", &crate::http::in_cell([0, 0], 40, 1));
    let pusher = HttpClient::new(&url, &with_token(PUSHER)).unwrap();
    let upload = pusher.upload(&path, &mut |_, _| {}).await.unwrap().id;
    let asked = json!({ "name": "a", "class": "object", "files": [{ "upload": upload }] });
    let asked = asked.to_string();

    // An upload belongs to its token.
    let foreign = ask(&server, "POST /v1/actors", Some(RIVAL), &asked).await;
    foreign.refused(404, "unknown_upload");
    assert_eq!(foreign.body["field"], "files[0].upload");
    let limited = ask(&server, "POST /v1/actors", Some(ELSEWHERE), &asked).await;
    limited.refused(403, "forbidden");
    assert_eq!(limited.body["field"], "authorization");
    let made = ask(&server, "POST /v1/actors", Some(PUSHER), &asked).await;
    assert_eq!(made.status, 201, "{made:?}");

    for (token, sees_source) in [(DRIVER, true), (ELSEWHERE, false)] {
        let listed = ask(&server, "GET /v1/actors", Some(token), "").await.body["actors"].clone();
        let shown = ask(&server, "GET /v1/actors/a", Some(token), "").await.body;
        for actor in [&listed[0], &shown] {
            assert_eq!(actor["hash"], made.body["hash"]);
            assert_eq!(actor.get("provenance").is_some(), sees_source, "{actor}");
        }
    }
}

fn announcement(content: &[u8], size: u64) -> String {
    let digest = format!("blake3:{}", blake3::hash(content).to_hex());
    json!({ "name": "x", "size": size, "digest": digest }).to_string()
}

#[tokio::test]
async fn announcements_alone_keep_no_other_token_from_uploading() {
    let server = guarded().await;
    for byte in 0..2 {
        // The largest uploads that are accepted, and no byte of them.
        let huge = announcement(&[byte], 64 << 30);
        assert_eq!(ask(&server, "POST /v1/uploads", Some(RIVAL), &huge).await.status, 201);
    }
    let content = b"a scene";
    let own = announcement(content, 7);
    let begun = ask(&server, "POST /v1/uploads", Some(PUSHER), &own).await;
    assert_eq!(begun.status, 201, "{begun:?}");
    let path = begun.header("location").unwrap();
    let sent = send_part(&server, &format!("PATCH {path}"), PUSHER, content).await;
    assert_eq!(sent.body["complete"], true, "{sent:?}");
}

/// Sends the first bytes of an upload.
async fn send_part(server: &TestServer, request: &str, token: &str, body: &[u8]) -> Reply {
    let head = format!(
        "{request} HTTP/1.1\r\nUpload-Offset: 0\r\nContent-Length: {}\r\nAuthorization: Bearer {token}",
        body.len()
    );
    send(server.address(), &head, body).await
}

#[tokio::test]
async fn an_upload_is_that_of_its_token() {
    let server = guarded().await;
    let content = b"a scene";
    // The rival announces the same content, of a wrong size.
    let wrong = announcement(content, 8);
    assert_eq!(ask(&server, "POST /v1/uploads", Some(RIVAL), &wrong).await.status, 201);
    let right = announcement(content, 7);
    let begun = ask(&server, "POST /v1/uploads", Some(PUSHER), &right).await;
    assert_eq!(begun.status, 201, "{begun:?}");
    let path = begun.header("location").unwrap().to_owned();

    // Its requests with this id concern its own upload.
    let deleted = ask(&server, &format!("DELETE {path}"), Some(RIVAL), "").await;
    assert_eq!(deleted.status, 204);
    ask(&server, &format!("DELETE {path}"), Some(RIVAL), "").await.refused(404, "unknown_upload");
    ask(&server, &format!("GET {path}"), Some(RIVAL), "").await.refused(404, "unknown_upload");
    let sent = send_part(&server, &format!("PATCH {path}"), PUSHER, content).await;
    assert_eq!(sent.body["complete"], true, "{sent:?}");

    // It cannot push uploads of other tokens either.
    let push = json!({ "files": [{ "upload": begun.body["id"] }] }).to_string();
    let pushes = "POST /v1/twins/test/pushes";
    ask(&server, pushes, Some(RIVAL), &push).await.refused(404, "unknown_upload");
    assert_eq!(ask(&server, pushes, Some(PUSHER), &push).await.status, 202);
}

#[tokio::test]
async fn a_token_has_a_quota() {
    let server = guarded_with(|config| config.limits.spool.bytes = 1000).await;
    let begin = async |token: &'static str, byte: u8, size: u64| {
        ask(&server, "POST /v1/uploads", Some(token), &announcement(&[byte], size)).await
    };
    assert_eq!(begin(RIVAL, 1, 400).await.status, 201);
    let full = begin(RIVAL, 2, 200).await;
    full.refused(507, "storage_full");
    let reason = full.body["message"].as_str().unwrap();
    assert!(reason.contains("this token keeps 1 uploads of 400 bytes"), "{reason}");
    let large = begin(RIVAL, 3, 501).await;
    large.refused(507, "storage_full");
    let reason = large.body["message"].as_str().unwrap();
    assert!(reason.contains("501 bytes, and the uploads of this token may have 500"), "{reason}");
    assert_eq!(begin(PUSHER, 4, 500).await.status, 201);
    // All tokens together have a limit, too.
    begin(ADMIN, 5, 200).await.refused(507, "storage_full");
    assert_eq!(begin(ADMIN, 6, 100).await.status, 201);
}

/// A server with one token that has limits, and perhaps an audit log.
async fn limited(limits: serde_json::Value, audit: Option<&std::path::Path>) -> TestServer {
    let text = json!({ "tokens": [
        { "name": "admin", "role": "admin", "token": ADMIN, "limits": limits },
        { "name": "rival", "role": "admin", "token": RIVAL },
    ]});
    let tokens = Tokens::parse(text.to_string().as_bytes()).unwrap();
    TestServer::configured(|config| {
        config.tokens = Some(tokens);
        config.audit = audit.map(std::path::Path::to_owned);
    })
    .await
}

#[tokio::test]
async fn a_token_has_limits_of_its_own() {
    let limits = json!({ "sessions": 1, "pushes": 0, "upload_bytes": 100 });
    let server = limited(limits, None).await;
    let mut agents = Vec::new();
    for token in [ADMIN, RIVAL, RIVAL] {
        let mut agent = upgrade(&server, Some(token)).await.ok().unwrap();
        agent.hello().await;
        agent.open(json!({})).await;
        agents.push(agent);
    }
    let mut second = upgrade(&server, Some(ADMIN)).await.ok().unwrap();
    second.hello().await;
    let refused = second.try_open(json!({})).await;
    crate::support::refused(&refused, "busy");
    assert!(refused["message"].as_str().unwrap().contains("1 sessions of this token"), "{refused}");
    // A session that ends makes room.
    agents[0].ask(json!({ "type": "close" })).await;
    second.open(json!({})).await;

    let large = announcement(b"large", 101);
    ask(&server, "POST /v1/uploads", Some(ADMIN), &large).await.refused(507, "storage_full");
    assert_eq!(ask(&server, "POST /v1/uploads", Some(RIVAL), &large).await.status, 201);
    let actor = r#"{"name": "a", "class": "object", "files": [{"upload": "x"}]}"#;
    ask(&server, "POST /v1/actors", Some(ADMIN), actor).await.refused(503, "busy");
    ask(&server, "POST /v1/actors", Some(RIVAL), actor).await.refused(404, "unknown_upload");
    let edit = r#"{"rig": "surround6"}"#;
    let refused = ask(&server, "POST /v1/twins/test/edits", Some(ADMIN), edit).await;
    refused.refused(503, "busy");
    let edited = ask(&server, "POST /v1/twins/test/edits", Some(RIVAL), edit).await;
    assert_eq!(edited.status, 200, "{edited:?}");
    let ground = "GET /v1/twins/test/ground";
    ask(&server, ground, Some(ADMIN), "").await.refused(503, "busy");
    assert_eq!(ask(&server, ground, Some(RIVAL), "").await.status, 200);
}

#[tokio::test]
async fn the_audit_log_says_which_token_changed_what() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("audit.jsonl");
    let server = limited(json!({}), Some(&path)).await;
    let url = format!("http://127.0.0.1:{}", server.address().port());
    let scene = crate::http::write(dir.path(), "a.ply", &crate::http::in_cell([0, 0], 40, 1));
    let rival = HttpClient::new(&url, &with_token(RIVAL)).unwrap();
    let upload = rival.upload(&scene, &mut |_, _| {}).await.unwrap();
    let begun = rival.push("test", &new_push(&[&upload.id])).await.unwrap();
    rival.wait_for_push(begun, &mut |_| {}).await.unwrap();
    let edit = |body: &'static str| ask(&server, "POST /v1/twins/test/edits", Some(ADMIN), body);
    assert_eq!(edit(r#"{"rig": "surround6"}"#).await.status, 200);
    edit(r#"{"rig": "surround6", "base": 77}"#).await.refused(404, "unknown_version");
    let admin = HttpClient::new(&url, &with_token(ADMIN)).unwrap();
    admin.rollback("test", 1).await.unwrap();
    let upload = admin.upload(&scene, &mut |_, _| {}).await.unwrap().id;
    let actor = async |scale: f64| {
        let file = json!({ "upload": upload, "scale": scale });
        let body = json!({ "name": "a", "class": "object", "files": [file] }).to_string();
        ask(&server, "POST /v1/actors", Some(ADMIN), &body).await
    };
    let made = actor(1.0).await;
    assert_eq!(made.status, 201, "{made:?}");
    actor(1000.0).await.refused(422, "push_refused");

    let text = std::fs::read_to_string(&path).unwrap();
    let lines: Vec<serde_json::Value> =
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let told: Vec<_> = lines
        .iter()
        .map(|line| {
            let text = |field: &str| line[field].as_str().unwrap_or_default();
            (text("token"), text("what"), text("state"), line["version"].as_u64())
        })
        .collect();
    assert_eq!(
        told,
        [
            ("rival", "push", "begun", None),
            ("rival", "push", "done", Some(2)),
            ("admin", "edit", "begun", None),
            ("admin", "edit", "done", Some(3)),
            ("admin", "edit", "begun", None),
            ("admin", "edit", "refused", None),
            ("admin", "rollback", "begun", None),
            ("admin", "rollback", "done", Some(4)),
            ("admin", "actor", "begun", None),
            ("admin", "actor", "done", None),
            ("admin", "actor", "begun", None),
            ("admin", "actor", "refused", None),
        ]
    );
    let (twins, actors) = lines.split_at(8);
    assert!(twins.iter().all(|line| line["twin"] == "test"), "{text}");
    assert!(actors.iter().all(|line| line["actor"] == "a" && line.get("twin").is_none()), "{text}");
    assert_eq!(actors[1]["hash"], made.body["hash"]);
}

/// A token must not be able to fill the audit log, and with it to remove older lines.
#[tokio::test]
async fn the_audit_log_repeats_no_long_names_and_has_cancelled_pushes() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("audit.jsonl");
    let server = limited(json!({}), Some(&path)).await;
    let long = "x".repeat(60_000);
    for (route, body) in [("edits", r#"{"rig": "surround6"}"#), ("rollback", r#"{"version": 1}"#)] {
        let request = format!("POST /v1/twins/{long}/{route}");
        ask(&server, &request, Some(RIVAL), body).await.refused(400, "invalid_name");
    }
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "");

    let url = format!("http://127.0.0.1:{}", server.address().port());
    // Reading it takes seconds.
    let scene =
        crate::http::write(dir.path(), "a.ply", &crate::http::in_cell([0, 0], 1_000_000, 1));
    let rival = HttpClient::new(&url, &with_token(RIVAL)).unwrap();
    let upload = rival.upload(&scene, &mut |_, _| {}).await.unwrap();
    let push = json!({ "id": "p", "files": [{ "upload": upload.id }] }).to_string();
    let begun = ask(&server, "POST /v1/twins/test/pushes", Some(RIVAL), &push).await;
    assert_eq!(begun.status, 202, "{begun:?}");
    let cancel = "DELETE /v1/twins/test/pushes/p";
    assert_eq!(ask(&server, cancel, Some(ADMIN), "").await.status, 200);
    ask(&server, cancel, Some(ADMIN), "").await.refused(409, "conflict");
    let text = std::fs::read_to_string(&path).unwrap();
    let lines = text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
    let told: Vec<String> = lines
        .filter(|line| line["what"] == "cancel")
        .map(|line| {
            assert_eq!((&line["token"], &line["id"]), (&json!("admin"), &json!("p")), "{line}");
            line["state"].as_str().unwrap().to_owned()
        })
        .collect();
    assert_eq!(told, ["begun", "done", "begun", "refused"]);
}
