//! The viewer's files, tickets, watching, and recorded episodes over HTTP.

use serde_json::{Value, json};
use wildcity_server::{Limits, Origins, Tokens};

use crate::http::request;
use crate::support::{Reply, Seen, TEST_TIMEOUT, TestServer, WATCH, connect};

const DRIVER: &str = "driver-driver-driver";
const RIVAL: &str = "rival-rival-rival";
const ADMIN: &str = "admin-admin-admin-admin";

async fn guarded() -> TestServer {
    let text = json!({ "tokens": [
        { "name": "driver", "role": "drive", "token": DRIVER },
        { "name": "rival", "role": "drive", "token": RIVAL },
        { "name": "admin", "role": "admin", "token": ADMIN },
    ]});
    let tokens = Tokens::parse(text.to_string().as_bytes()).unwrap();
    TestServer::configured(|config| config.tokens = Some(tokens)).await
}

/// The status and the JSON of an answer.
async fn ask(server: &TestServer, line: &str, token: &str) -> (u16, Value) {
    let text = format!(
        "{line} HTTP/1.1\nHost: localhost\nAuthorization: Bearer {token}\nContent-Length: 0\n\n"
    );
    let (status, answer) = request(server, &text).await;
    let body = answer.split("\r\n\r\n").nth(1).unwrap();
    (status, serde_json::from_str(body).unwrap_or(Value::Null))
}

#[tokio::test]
async fn the_page_may_load_from_this_server_alone() {
    let server = guarded().await;
    for (path, content_type, begins) in [
        ("/", "text/html; charset=utf-8", "<!doctype html>"),
        ("/viewer.js", "text/javascript; charset=utf-8", ""),
        ("/style.css", "text/css; charset=utf-8", ":root{"),
        ("/icon.svg", "image/svg+xml", "<svg"),
    ] {
        let (status, answer) = crate::http::get(&server, path).await;
        assert_eq!(status, 200, "{path}");
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        assert!(head.contains(&format!("content-type: {content_type}\r\n")), "{head}");
        assert!(head.contains("content-security-policy: default-src 'none'; script-src 'self';"));
        assert!(head.contains("x-content-type-options: nosniff\r\n"), "{head}");
        assert!(body.starts_with(begins) && body.len() > 100, "{path}: {body}");
    }
    assert_eq!(request(&server, "POST / HTTP/1.1\nHost: localhost\n\n").await.0, 405);
}

#[tokio::test]
async fn a_ticket_opens_one_connection_with_the_rights_of_its_token() {
    let server = guarded().await;
    let (status, issued) = ask(&server, "POST /v1/tickets", DRIVER).await;
    assert_eq!((status, &issued["expires_ms"]), (201, &json!(30_000)));
    let path = format!("/v1/session?ticket={}", issued["ticket"].as_str().unwrap());
    let mut agent = connect(server.address(), &path, "wildcity.v1", None).await.ok().unwrap();
    agent.hello().await;
    agent.open(json!({ "session": "mine" })).await;
    // It was used already, and it is neither a token nor valid for other routes.
    let again = connect(server.address(), &path, "wildcity.v1", None).await;
    assert_eq!(again.err(), Some(401));
    let (_, issued) = ask(&server, "POST /v1/tickets", ADMIN).await;
    let ticket = issued["ticket"].as_str().unwrap();
    assert_eq!(
        ask(&server, &format!("GET /v1/sessions?ticket={ticket}"), "no-such-token").await.0,
        401
    );
    assert_eq!(ask(&server, "GET /v1/sessions", ticket).await.0, 401);
    // The session belongs to the token: another ticket of it resumes the session, a rival's does
    // not.
    drop(agent);
    for (token, answer) in [(RIVAL, "error"), (DRIVER, "resumed")] {
        let (_, issued) = ask(&server, "POST /v1/tickets", token).await;
        let path = format!("/v1/session?ticket={}", issued["ticket"].as_str().unwrap());
        let mut agent = connect(server.address(), &path, "wildcity.v1", None).await.ok().unwrap();
        agent.hello().await;
        let resumed =
            agent.ask(json!({ "type": "resume", "session": "mine", "last_seq": 0 })).await;
        assert_eq!(resumed["type"], answer, "{resumed}");
    }
    assert_eq!(ask(&server, "POST /v1/tickets", "no-such-token").await.0, 401);
}

#[tokio::test]
async fn a_watcher_gets_the_observations_of_the_agent() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let mut watcher =
        connect(server.address(), "/v1/sessions/a/watch", WATCH, None).await.ok().unwrap();
    let driven = agent.step(1.0).await;
    assert_eq!(watcher.seen().await.bytes, driven.bytes);
    // The watcher does not read now: the agent drives on, and the watcher sees the last step, and
    // few of the others.
    let mut last = driven;
    for step in 2..40 {
        last = agent.step(f64::from(step)).await;
    }
    let mut seen: Seen = watcher.seen().await;
    let mut count = 1;
    while seen.meta["step"] != last.meta["step"] {
        seen = watcher.seen().await;
        count += 1;
    }
    assert_eq!(seen.bytes, last.bytes);
    assert!(count < 20, "{count} of 38 observations, at ten a second");
    // The end of the session is a Close frame.
    agent.ask(json!({ "type": "close" })).await;
    watcher.closed().await;
}

#[tokio::test]
async fn watching_changes_no_hash() {
    let mut hashes = Vec::new();
    for watched in [false, true] {
        let server = TestServer::start().await;
        let mut agent = server.driver("a").await;
        let path = "/v1/sessions/a/watch";
        let watcher =
            if watched { connect(server.address(), path, WATCH, None).await.ok() } else { None };
        let mut frames = Vec::new();
        for step in 0..5 {
            frames.push(agent.step(f64::from(step)).await.frame_hash().to_owned());
        }
        assert_eq!(watcher.is_some(), watched);
        hashes.push(frames);
    }
    assert_eq!(hashes[0], hashes[1]);
}

#[tokio::test]
async fn a_session_is_watched_by_its_token_and_by_administrators() {
    let server = guarded().await;
    let mut agent =
        connect(server.address(), "/v1/session", "wildcity.v1", Some(DRIVER)).await.ok().unwrap();
    agent.hello().await;
    agent.open(json!({ "session": "a" })).await;
    for (path, protocol, token, refused) in [
        ("/v1/sessions/a/watch", WATCH, Some(DRIVER), None),
        ("/v1/sessions/a/watch", WATCH, Some(ADMIN), None),
        ("/v1/sessions/a/watch", WATCH, Some(RIVAL), Some(404)),
        ("/v1/sessions/b/watch", WATCH, Some(ADMIN), Some(404)),
        ("/v1/sessions/a/watch", "wildcity.v1", Some(ADMIN), Some(400)),
        ("/v1/sessions/a/watch", WATCH, None, Some(401)),
    ] {
        let connected = connect(server.address(), path, protocol, token).await;
        assert_eq!(connected.err(), refused, "{path} {token:?}");
    }
    // A message of a watcher ends only its own connection.
    let path = "/v1/sessions/a/watch";
    let mut watcher = connect(server.address(), path, WATCH, Some(DRIVER)).await.ok().unwrap();
    watcher.send_text("{}").await;
    watcher.closed().await;
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
}

#[tokio::test]
async fn a_server_with_watchers_stops() {
    // The server would wait for the watcher for longer than the test does.
    let limits = Limits { drain: 3 * TEST_TIMEOUT, ..Limits::default() };
    let server = TestServer::with(limits).await;
    let _agent = server.driver("a").await;
    let mut watcher =
        connect(server.address(), "/v1/sessions/a/watch", WATCH, None).await.ok().unwrap();
    let stopped = tokio::time::timeout(TEST_TIMEOUT, server.running.stop()).await;
    assert!(stopped.is_ok(), "the watcher kept the server");
    assert!(matches!(watcher.receive().await, Reply::Closed));
}

#[tokio::test]
async fn recorded_episodes_are_listed_and_read() {
    let server = guarded().await;
    let mut agent =
        connect(server.address(), "/v1/session", "wildcity.v1", Some(DRIVER)).await.ok().unwrap();
    agent.hello().await;
    agent.open(json!({ "session": "a" })).await;
    agent.step(1.0).await;
    agent.step(2.0).await;
    agent.ask(json!({ "type": "close" })).await;
    let (status, listed) = ask(&server, "GET /v1/episodes", ADMIN).await;
    assert_eq!(status, 200);
    let [episode] = &listed["episodes"].as_array().unwrap()[..] else { panic!("{listed}") };
    assert_eq!(episode["episode"], "a-1");
    assert_eq!((&episode["twin"], &episode["steps"]), (&json!("test"), &json!(2)));
    assert_eq!(episode["outcome"], "completed");
    let text = format!(
        "GET /v1/episodes/a-1 HTTP/1.1\nHost: localhost\nAuthorization: Bearer {ADMIN}\n\n"
    );
    let (status, answer) = request(&server, &text).await;
    let body = answer.split_once("\r\n\r\n").unwrap().1;
    let file = std::fs::read_to_string(&server.recorded()[0]).unwrap();
    assert_eq!((status, body), (200, file.as_str()));
    for path in ["/v1/episodes", "/v1/episodes/a-1"] {
        assert_eq!(ask(&server, &format!("GET {path}"), DRIVER).await.0, 403, "{path}");
    }
    for path in ["nothing-1", "..%2fa-1", "%2e%2e%2f.uploads%2fx", "a"] {
        let (status, body) = ask(&server, &format!("GET /v1/episodes/{path}"), ADMIN).await;
        assert_eq!((status, &body["code"]), (404, &json!("unknown_state")), "{path}");
    }
}

#[tokio::test]
async fn pages_of_listed_origins_are_answered() {
    const PAGE: &str = "https://sim.example.org";
    let server = TestServer::configured(|config| {
        config.origins = Origins::new(vec![PAGE.to_owned()]).unwrap();
    })
    .await;
    let get = |origin: &str, host: &str| {
        format!("GET /v1/twins HTTP/1.1\nHost: {host}\nOrigin: {origin}\n\n")
    };
    let allows = format!("access-control-allow-origin: {PAGE}\r\n");
    for (origin, host, status) in [
        (PAGE, "localhost", 200),
        (PAGE, "sim.example.org", 200),
        ("http://localhost:5173", "localhost", 200),
        ("https://evil.example.org", "localhost", 403),
        (PAGE, "evil.example.org", 403),
    ] {
        let (found, answer) = request(&server, &get(origin, host)).await;
        assert_eq!(found, status, "{origin} {host}: {answer}");
        assert_eq!(answer.contains(&allows), origin == PAGE, "{answer}");
    }
    let preflight = |origin: &str| {
        format!(
            "OPTIONS /v1/tickets HTTP/1.1\nHost: localhost\nOrigin: {origin}\n\
             Access-Control-Request-Method: POST\n\n"
        )
    };
    let (status, answer) = request(&server, &preflight(PAGE)).await;
    assert_eq!(status, 204, "{answer}");
    assert!(answer.contains("access-control-allow-headers: authorization, "), "{answer}");
    let (status, answer) = request(&server, &preflight("https://evil.example.org")).await;
    assert!(status != 204 && !answer.contains("access-control"), "{answer}");
}
