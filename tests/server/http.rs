//! HTTP: health, twins, and the checks of an upgrade to WebSocket.

use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use wildcity_server::{Config, Limits, ServerError};

use crate::support::{TEST_TIMEOUT, TestServer};

/// Sends a request as it is, and reads until the server closes or the answer is there.
pub(crate) async fn request(server: &TestServer, text: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    stream.write_all(text.replace('\n', "\r\n").as_bytes()).await.unwrap();
    let mut answer = vec![0; 65536];
    let length = stream.read(&mut answer).await.unwrap();
    let answer = String::from_utf8_lossy(&answer[..length]).into_owned();
    let status = answer.split(' ').nth(1).expect("a status").parse().unwrap();
    (status, answer)
}

pub(crate) async fn get(server: &TestServer, path: &str) -> (u16, String) {
    request(server, &format!("GET {path} HTTP/1.1\nHost: localhost\n\n")).await
}

const UPGRADE: &str = "GET /v1/session HTTP/1.1\nHost: localhost\nConnection: keep-alive, Upgrade\n\
                       Upgrade: websocket\nSec-WebSocket-Version: 13\n\
                       Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\n";

/// The status, and the JSON of a refusal.
async fn refusal(server: &TestServer, text: &str) -> (u16, serde_json::Value) {
    let (status, answer) = request(server, text).await;
    let body = answer.split("\r\n\r\n").nth(1).expect("a body");
    let body = serde_json::from_str(body).unwrap_or_else(|_| panic!("no JSON: {answer}"));
    assert!(answer.contains("content-type: application/json"), "{answer}");
    (status, body)
}

/// Every refusal is JSON with a code: of the handshake, of a wrong route, of a body that is too
/// large.
#[tokio::test]
async fn refusals_are_json_with_a_code_and_a_field() {
    let server = TestServer::start().await;
    let subprotocol = "Sec-WebSocket-Protocol: wildcity.v1\n";
    let get = |path: &str| format!("GET {path} HTTP/1.1\nHost: localhost\n\n");
    let upgrade = |from: &str, to: &str| format!("{UPGRADE}{subprotocol}\n").replace(from, to);
    let large = "POST /v1/uploads HTTP/1.1\nHost: localhost\nContent-Length: 2000000\n\n";
    for (text, status, code, field) in [
        (get("/v1/session"), 426, "invalid_request", Some("upgrade")),
        (upgrade("Upgrade: websocket", "Upgrade: h2c"), 426, "invalid_request", Some("upgrade")),
        (
            upgrade("Version: 13", "Version: 8"),
            400,
            "invalid_request",
            Some("sec-websocket-version"),
        ),
        (
            upgrade("dGhlIHNhbXBsZSBub25jZQ==", "x"),
            400,
            "invalid_request",
            Some("sec-websocket-key"),
        ),
        (upgrade("wildcity.v1", "v2"), 400, "unsupported_protocol", Some("sec-websocket-protocol")),
        (
            upgrade(subprotocol, &format!("{subprotocol}Origin: https://example.org\n")),
            403,
            "forbidden",
            Some("origin"),
        ),
        (get("/nothing"), 404, "invalid_request", None),
        (get("/v1/sessions/a"), 404, "invalid_request", None),
        (get("/v1/session").replace("GET", "POST"), 405, "invalid_request", None),
        (get("/v1/twins/nope"), 404, "unknown_twin", Some("twin")),
        (large.to_owned(), 413, "message_too_large", None),
    ] {
        let (found, body) = refusal(&server, &text).await;
        assert_eq!((found, &body["code"]), (status, &code.into()), "{text}: {body}");
        assert_eq!(body["field"].as_str(), field, "{text}: {body}");
        let message = body["message"].as_str().unwrap();
        // The server has no tokens.
        assert!(!message.contains("token") && !message.is_empty(), "{message}");
    }
    // The answer to a client of a different WebSocket version has the supported version (RFC 6455,
    // section 4.4).
    let (_, answer) = request(&server, &upgrade("Version: 13", "Version: 8")).await;
    assert!(answer.contains("sec-websocket-version: 13"), "{answer}");

    // Bodies follow the same rules as requests over the socket.
    let digest = "blake3:c161acb4065fb456ded857fcc01f61847e2aa4e55872dbe090bc93d1b438bb3d";
    for (body, code, field) in [
        ("[]".to_owned(), "invalid_request", None),
        ("{".to_owned(), "malformed_json", None),
        (
            format!(r#"{{"name":"a","size":null,"digest":"{digest}"}}"#),
            "invalid_request",
            Some("size"),
        ),
        (format!(r#"{{"name":"a","size":-1,"digest":"{digest}"}}"#), "out_of_range", Some("size")),
        (
            format!(r#"{{"name":"a","size":1.5,"digest":"{digest}"}}"#),
            "invalid_request",
            Some("size"),
        ),
        (
            format!(r#"{{"name":"a","name":"b","size":1,"digest":"{digest}"}}"#),
            "invalid_request",
            Some("name"),
        ),
        (format!(r#"{{"size":1,"digest":"{digest}"}}"#), "invalid_request", Some("name")),
        (
            format!(r#"{{"name":"a","size":1,"digest":"{digest}","more":1}}"#),
            "invalid_request",
            Some("more"),
        ),
    ] {
        let length = body.len();
        let text = format!(
            "POST /v1/uploads HTTP/1.1\nHost: localhost\nContent-Length: {length}\n\n{body}"
        );
        let (_, answer) = refusal(&server, &text).await;
        assert_eq!((&answer["code"], answer["field"].as_str()), (&code.into(), field), "{answer}");
    }
}

async fn upgrade(server: &TestServer, more: &str) -> u16 {
    request(server, &format!("{UPGRADE}{more}\n")).await.0
}

#[tokio::test]
async fn health_and_twins() {
    let server = TestServer::start().await;
    assert_eq!(get(&server, "/healthz").await.0, 200);
    assert_eq!(get(&server, "/readyz").await.0, 200);
    let (status, answer) = get(&server, "/v1/twins").await;
    assert_eq!(status, 200);
    assert!(answer.contains("application/json"), "{answer}");
    let body: serde_json::Value =
        serde_json::from_str(answer.split("\r\n\r\n").nth(1).unwrap()).unwrap();
    assert_eq!(body["twins"][0]["name"], "test");
    assert_eq!(get(&server, "/nothing").await.0, 404);
    // A version never changes: its manifest is not read again.
    let manifest = body["twins"][0]["version_hash"].as_str().unwrap();
    let mut objects = walk(server.twins.path());
    objects.retain(|path| path.to_string_lossy().replace('/', "").contains(manifest));
    std::fs::remove_file(&objects[0]).unwrap();
    let (_, again) = get(&server, "/v1/twins").await;
    assert!(again.contains(manifest), "{again}");
    assert_eq!(get(&server, "/readyz").await.0, 200);
    assert_eq!(get(&server, "/v1/session").await.0, 426);
    assert_eq!(request(&server, "rubbish\n\n").await.0, 400);
}

#[tokio::test]
async fn episodes_are_listed_and_fetched_by_the_name_that_closed_gives() {
    let server = TestServer::start().await;
    let body = |answer: &str| -> serde_json::Value {
        serde_json::from_str(answer.split("\r\n\r\n").nth(1).unwrap()).unwrap()
    };
    let (_, none) = get(&server, "/v1/episodes").await;
    assert_eq!(body(&none), serde_json::json!({ "episodes": [] }));
    let mut agent = server.driver("a").await;
    agent.step(1.0).await;
    let closed = agent.ask(serde_json::json!({ "type": "close" })).await;
    let name = closed["summary"]["episode"].as_str().unwrap().to_owned();
    assert_eq!(name, "a-1");

    let (status, listed) = get(&server, "/v1/episodes").await;
    let listed = body(&listed);
    let entry = &listed["episodes"][0];
    assert_eq!(
        (status, &entry["episode"], &entry["outcome"]),
        (200, &name.clone().into(), &"completed".into())
    );
    assert_eq!((&entry["twin"], &entry["steps"]), (&"test".into(), &1.into()));
    let (status, record) = get(&server, &format!("/v1/episodes/{name}")).await;
    let text = std::fs::read_to_string(server.episodes.path().join("a-1.jsonl")).unwrap();
    assert_eq!((status, record.split("\r\n\r\n").nth(1).unwrap()), (200, text.as_str()));
    for wrong in ["a-2", "..%2Fa-1", "a-1.jsonl", "%00"] {
        let (status, answer) = get(&server, &format!("/v1/episodes/{wrong}")).await;
        assert_eq!(status, 404, "{wrong}: {answer}");
    }
}

/// All files below a directory.
fn walk(dir: &std::path::Path) -> Vec<std::path::PathBuf> {
    let paths = std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path());
    paths.flat_map(|path| if path.is_dir() { walk(&path) } else { vec![path] }).collect()
}

/// A connection with answers that are not read is closed, and another one can take its place.
#[tokio::test]
async fn an_answer_that_is_not_read_is_given_up() {
    // The client that is served afterwards must be this fast, also on a busy machine.
    let short = Duration::from_secs(1);
    let server = TestServer::with(Limits { hello: short, send: short, ..Limits::default() }).await;
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    let requests = "GET /v1/twins HTTP/1.1\r\nHost: localhost\r\n\r\n".repeat(1000);
    let asking = async { while stream.write_all(requests.as_bytes()).await.is_ok() {} };
    tokio::time::timeout(TEST_TIMEOUT / 2, asking).await.expect("the connection ends");
    server.still_serves().await;
}

#[tokio::test]
async fn only_local_pages_and_agents_may_drive() {
    let server = TestServer::start().await;
    let subprotocol = "Sec-WebSocket-Protocol: other, wildcity.v1\n";
    assert_eq!(upgrade(&server, subprotocol).await, 101);
    assert_eq!(upgrade(&server, "").await, 400);
    // Names of subprotocols are case-sensitive, and the key is 16 bytes in base64.
    assert_eq!(upgrade(&server, "Sec-WebSocket-Protocol: WildCity.v1\n").await, 400);
    for key in ["", "x", "dGhlIHNhbXBsZSBub25jZQ=", "dGhlIHNhbXBsZSBub25jZ!=="] {
        let bad = UPGRADE.replace("dGhlIHNhbXBsZSBub25jZQ==", key);
        assert_eq!(request(&server, &format!("{bad}{subprotocol}\n")).await.0, 400, "{key}");
    }
    assert_eq!(upgrade(&server, "Sec-WebSocket-Protocol: other\n").await, 400);
    for (origin, status) in [
        ("http://localhost:3000", 101),
        ("http://127.0.0.1", 101),
        ("http://[::1]:8080", 101),
        ("https://example.org", 403),
        ("null", 403),
    ] {
        let found = upgrade(&server, &format!("{subprotocol}Origin: {origin}\n")).await;
        assert_eq!(found, status, "{origin}");
    }
    server.still_serves().await;
}

#[tokio::test]
async fn public_addresses_are_refused() {
    let server = TestServer::start().await;
    let config = Config { listen: "0.0.0.0:0".parse().unwrap(), ..server.config() };
    let refused = wildcity_server::start(config.clone()).await.unwrap_err();
    assert!(matches!(refused, ServerError::PublicAddress { .. }), "{refused}");
    let taken =
        wildcity_server::start(Config { listen: server.address(), ..config }).await.unwrap_err();
    assert!(matches!(taken, ServerError::Listen { .. }), "{taken}");
}

/// Sockets that are opened and not used do not keep health checks and agents away.
#[tokio::test]
async fn idle_sockets_take_no_slot_from_others() {
    // They would be closed after longer than the test waits.
    let limits = Limits { connections: 8, hello: 3 * TEST_TIMEOUT, ..Limits::default() };
    let server = TestServer::with(limits).await;
    let mut idle = Vec::new();
    for round in 0..14 {
        for _ in 0..90 {
            idle.push(TcpStream::connect(server.address()).await.unwrap());
        }
        let health = tokio::time::timeout(TEST_TIMEOUT, get(&server, "/healthz"));
        let (status, _) = health.await.unwrap_or_else(|_| panic!("no answer in round {round}"));
        assert_eq!(status, 200);
    }
    server.still_serves().await;
}

/// DNS rebinding: a page's own host name, made to stand for 127.0.0.1.
#[tokio::test]
async fn a_server_without_tokens_answers_for_its_own_host_only() {
    let server = TestServer::start().await;
    for (host, status) in [
        ("localhost", 200),
        ("LOCALHOST:8080", 200),
        ("127.0.0.1", 200),
        ("[::1]:8080", 200),
        ("evil.example", 403),
        ("evil.example:8080", 403),
        ("localhost.evil.example", 403),
        ("127.0.0.1.evil.example", 403),
        ("", 403),
    ] {
        let text = format!("GET /v1/twins HTTP/1.1\nHost: {host}\n\n");
        assert_eq!(request(&server, &text).await.0, status, "{host}");
        let text = format!("GET /healthz HTTP/1.1\nHost: {host}\n\n");
        assert_eq!(request(&server, &text).await.0, 200, "{host}");
    }
}
