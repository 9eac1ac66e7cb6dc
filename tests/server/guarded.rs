//! Tickets, hosts, origins and limits of a server that others can reach.

use serde_json::{Value, json};
use wildcity_server::{Origins, Tokens};

use crate::http::request;
use crate::support::{TEST_TIMEOUT, TestServer};

const DRIVER: &str = "driver-driver-driver";
const PUSHER: &str = "pusher-pusher-pusher";
const PAGE: &str = "https://sim.example.org";

/// A server with tokens and a list of one origin. The first token may have one connection.
async fn guarded() -> TestServer {
    let text = json!({ "tokens": [
        { "name": "driver", "role": "drive", "token": DRIVER, "limits": { "connections": 1 } },
        { "name": "pusher", "role": "push", "token": PUSHER },
    ]});
    let tokens = Tokens::parse(text.to_string().as_bytes()).unwrap();
    TestServer::configured(|config| {
        config.tokens = Some(tokens);
        config.origins = Origins::new(vec![format!("{PAGE}:443")]).unwrap();
    })
    .await
}

/// The status and the JSON of an answer to these lines, which end before the blank one.
async fn ask(server: &TestServer, lines: &str) -> (u16, Value) {
    let (status, answer) = request(server, &format!("{lines}\n\n")).await;
    let body = answer.split("\r\n\r\n").nth(1).unwrap_or_default();
    (status, serde_json::from_str(body).unwrap_or(Value::Null))
}

async fn ticket(server: &TestServer, token: &str) -> String {
    let lines = format!(
        "POST /v1/tickets HTTP/1.1\nHost: localhost\nContent-Length: 0\nAuthorization: Bearer {token}"
    );
    let (status, issued) = ask(server, &lines).await;
    assert_eq!(status, 201, "{issued}");
    issued["ticket"].as_str().unwrap().to_owned()
}

/// The headers of a handshake.
fn handshake(host: &str, protocol: &str) -> String {
    format!(
        "Host: {host}\nConnection: Upgrade\nUpgrade: websocket\nSec-WebSocket-Version: 13\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\nSec-WebSocket-Protocol: {protocol}"
    )
}

/// Every route of the document, asked without a token, with each role, and with a token of another
/// twin: a route whose check is missing or of another role fails. The roles of the document are
/// compared with the protocol's page in `src/server/routes/openapi.rs`.
#[tokio::test]
async fn every_route_refuses_the_tokens_that_may_not_use_it() {
    let mut tokens: Vec<Value> = ["metrics", "drive", "push", "admin"]
        .iter()
        .map(|role| json!({ "name": role, "role": role, "token": format!("{role}-{role}-{role}-{role}") }))
        .collect();
    tokens.push(json!({
        "name": "elsewhere", "role": "admin", "token": "elsewhere-elsewhere", "twins": ["road"],
    }));
    let text = json!({ "tokens": tokens }).to_string();
    let tokens = Tokens::parse(text.as_bytes()).unwrap();
    let server = TestServer::configured(|config| config.tokens = Some(tokens)).await;
    let document = include_str!("../../protocol/openapi.json");
    let document: Value = serde_json::from_str(document).unwrap();
    for (path, methods) in document["paths"].as_object().unwrap() {
        let named = path.replace("{twin}", "street").replace(['{', '}'], "");
        for (method, operation) in methods.as_object().unwrap() {
            let method = method.to_ascii_uppercase();
            let ask_as = async |token: Option<&str>| {
                let header =
                    token.map_or(String::new(), |token| format!("\nAuthorization: Bearer {token}"));
                let start = format!("{method} {named} HTTP/1.1\nHost: localhost");
                ask(&server, &format!("{start}\nContent-Length: 0{header}")).await
            };
            let allowed: &[&str] = match operation["description"].as_str().unwrap() {
                "" => {
                    let (status, _) = ask_as(None).await;
                    assert_eq!(status, 200, "{method} {path} without a token");
                    continue;
                }
                "Any token, except those with the role metrics."
                | "Tokens with the role drive, push or admin." => &["drive", "push", "admin"],
                "Tokens with the role push or admin." => &["push", "admin"],
                "Tokens with the role admin or admin." => &["admin"],
                "Tokens with the role metrics or admin." => &["metrics", "admin"],
                other => panic!("{method} {path}: {other}"),
            };
            assert_eq!(ask_as(None).await.0, 401, "{method} {path} without a token");
            for role in ["metrics", "drive", "push", "admin"] {
                let (status, body) = ask_as(Some(&format!("{role}-{role}-{role}-{role}"))).await;
                let is_refused = status == 403;
                assert_eq!(is_refused, !allowed.contains(&role), "{role}, {method} {path}: {body}");
            }
            let (status, body) = ask_as(Some("elsewhere-elsewhere")).await;
            let is_refused = status == 403 && body["field"] == "twin";
            // A token of some twins may add no asset either, which is another field.
            assert_eq!(is_refused, path.contains("{twin}"), "{method} {path}: {body}");
        }
    }
}

#[tokio::test]
async fn a_ticket_is_for_a_websocket_and_survives_a_refused_handshake() {
    let server = guarded().await;
    let ticket = ticket(&server, PUSHER).await;
    let with = |method: &str, path: &str, headers: &str| {
        format!("{method} {path}?ticket={ticket} HTTP/1.1\n{headers}")
    };
    let good = handshake("localhost", "wildcity.v1");
    for (lines, status) in [
        // Not a route of a WebSocket, although its path ends like one.
        (with("DELETE", "/v1/uploads/watch", "Host: localhost"), 401),
        (with("GET", "/v1/twins/watch", "Host: localhost"), 401),
        // Refused before the ticket is looked at.
        (with("GET", "/v1/session", &handshake("evil.example.org", "wildcity.v1")), 403),
        (with("GET", "/v1/session", &format!("{good}\nOrigin: https://evil.example.org")), 403),
        (with("GET", "/v1/session", "Host: localhost"), 426),
        (with("HEAD", "/v1/session", "Host: localhost"), 426),
        (with("GET", "/v1/session", &handshake("localhost", "wildcity.v2")), 400),
        (with("GET", "/v1/sessions/a/watch", &good), 400),
        // It is still valid, and is used then.
        (with("GET", "/v1/session", &good), 101),
        (with("GET", "/v1/session", &good), 401),
    ] {
        let (found, body) = ask(&server, &lines).await;
        assert_eq!(found, status, "{lines}: {body}");
    }
}

#[tokio::test]
async fn a_token_has_as_many_connections_as_it_may() {
    let server = guarded().await;
    let address = server.address();
    let connect = async |token: &str| {
        let lines = format!(
            "GET /v1/session HTTP/1.1\n{}\nAuthorization: Bearer {token}\n\n",
            handshake("localhost", "wildcity.v1")
        );
        let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
        let text = lines.replace('\n', "\r\n");
        tokio::io::AsyncWriteExt::write_all(&mut stream, text.as_bytes()).await.unwrap();
        let mut answer = vec![0; 4096];
        let length = tokio::io::AsyncReadExt::read(&mut stream, &mut answer).await.unwrap();
        (stream, String::from_utf8_lossy(&answer[..length]).into_owned())
    };
    let (first, answer) = connect(DRIVER).await;
    assert!(answer.starts_with("HTTP/1.1 101"), "{answer}");
    let (_, refused) = connect(DRIVER).await;
    assert!(refused.starts_with("HTTP/1.1 503"), "{refused}");
    assert!(refused.contains("there are 1 connections of this token already"), "{refused}");
    // Another token is not affected.
    let mut others = Vec::new();
    for _ in 0..3 {
        let (stream, answer) = connect(PUSHER).await;
        assert!(answer.starts_with("HTTP/1.1 101"), "{answer}");
        others.push(stream);
    }
    // A connection that ends makes room.
    drop(first);
    let again = async {
        while !connect(DRIVER).await.1.starts_with("HTTP/1.1 101") {
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, again).await.expect("room for a connection");
}

#[tokio::test]
async fn hosts_and_origins_are_there_once_and_a_foreign_host_is_told_how_to_be_listed() {
    let server = guarded().await;
    let get = |headers: &str| {
        format!("GET /v1/twins HTTP/1.1\n{headers}\nAuthorization: Bearer {DRIVER}")
    };
    for (headers, status, field) in [
        ("Host: localhost", 200, Value::Null),
        ("Host: sim.example.org", 200, Value::Null),
        ("Host: sim.example.org:443", 200, Value::Null),
        ("Host: localhost\nOrigin: https://sim.example.org", 200, Value::Null),
        ("Host: localhost\nHost: localhost", 400, json!("host")),
        ("Host: localhost\nHost: evil.example.org", 400, json!("host")),
        (
            "Host: localhost\nOrigin: http://localhost\nOrigin: https://evil.example.org",
            400,
            json!("origin"),
        ),
        ("Host: evil.example.org", 403, json!("host")),
    ] {
        let (found, body) = ask(&server, &get(headers)).await;
        assert_eq!((found, &body["field"]), (status, &field), "{headers}: {body}");
    }
    let (_, body) = ask(&server, &get("Host: evil.example.org")).await;
    let message = body["message"].as_str().unwrap();
    assert!(message.contains("host name \"evil.example.org\" is not accepted"), "{message}");
    assert!(message.contains("--origin") && !message.contains("token"), "{message}");
}

#[tokio::test]
async fn pages_of_this_machine_may_read_answers() {
    const LOCAL: &str = "http://localhost:5173";
    for server in [guarded().await, TestServer::start().await] {
        let preflight = format!(
            "OPTIONS /v1/tickets HTTP/1.1\nHost: localhost\nOrigin: {LOCAL}\n\
             Access-Control-Request-Method: POST\n\n"
        );
        let (status, answer) = request(&server, &preflight).await;
        assert_eq!(status, 204, "{answer}");
        let allows = format!("access-control-allow-origin: {LOCAL}\r\n");
        assert!(answer.contains(&allows), "{answer}");
        assert!(answer.contains("access-control-allow-methods: GET, POST"), "{answer}");
        let get = format!(
            "GET /v1/twins HTTP/1.1\nHost: localhost\nOrigin: {LOCAL}\nAuthorization: Bearer {DRIVER}\n\n"
        );
        let (status, answer) = request(&server, &get).await;
        assert!(status == 200 && answer.contains(&allows), "{answer}");
        let foreign = preflight.replace(LOCAL, "http://localhost.example.org");
        let (status, answer) = request(&server, &foreign).await;
        assert!(status != 204 && !answer.contains("access-control"), "{answer}");
    }
}
