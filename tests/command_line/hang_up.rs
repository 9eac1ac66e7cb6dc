//! SIGHUP, and the log of a server.

use std::fs::{self, File};
use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::served::Served;
use crate::support::{self, Agent};

/// The status and the text of the answer to a request with a token.
async fn get(served: &Served, path: &str, token: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(served.address).await.unwrap();
    let request = format!(
        "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nAuthorization: Bearer {token}\r\n\r\n"
    );
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    (answer.split(' ').nth(1).unwrap().parse().unwrap(), answer)
}

/// Waits until a log has a text.
async fn logs(log: &Path, text: &str) {
    let has = async {
        while !fs::read_to_string(log).unwrap().contains(text) {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    let found = tokio::time::timeout(support::TEST_TIMEOUT, has).await;
    assert!(found.is_ok(), "no {text:?} in {}", fs::read_to_string(log).unwrap());
}

/// A server that logs to a file.
fn logging(filter: &str, log: &Path, arguments: &[&str]) -> Served {
    let twins = support::twins();
    let at = twins.path().as_os_str().to_owned();
    let stderr = File::create(log).unwrap();
    Served::logging(filter, &at, twins, |command| command.args(arguments).stderr(stderr))
}

#[tokio::test]
async fn a_server_without_tls_and_tokens_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let log = dir.path().join("log");
    let served = logging("info", &log, &[]);
    served.hang_up();
    logs(&log, "there is nothing to read again").await;
    served.whole_session(2).await;
    assert_eq!(served.signal_and_wait(), Some(0));
}

#[tokio::test]
async fn a_log_of_json_has_an_object_on_each_line() {
    let dir = tempfile::tempdir().unwrap();
    let log = dir.path().join("log");
    let served = logging("info", &log, &["--log-format", "json"]);
    served.whole_session(2).await;
    assert_eq!(served.signal_and_wait(), Some(0));
    let text = fs::read_to_string(&log).unwrap();
    let lines: Vec<Value> =
        text.lines().map(|line| serde_json::from_str(line).expect(line)).collect();
    assert!(lines.len() > 1, "{text}");
    for line in &lines {
        let has = |field: &str| line[field].is_string();
        assert!(
            has("timestamp") && has("level") && line["fields"]["message"].is_string(),
            "{line}"
        );
    }
}

#[tokio::test]
async fn tokens_are_read_again() {
    let dir = tempfile::tempdir().unwrap();
    let log = dir.path().join("log");
    let tokens = dir.path().join("tokens.json");
    let write = |token: &str| {
        let text = json!({ "tokens": [{ "name": "a", "role": "drive", "token": token }] });
        fs::write(&tokens, text.to_string()).unwrap();
    };
    let [first, second] = ["first-first-first", "second-second-second"];
    write(first);
    let served = logging("info", &log, &["--tokens", tokens.to_str().unwrap()]);
    assert_eq!(get(&served, "/v1/twins", first).await.0, 200);
    write(second);
    assert_eq!(get(&served, "/v1/twins", second).await.0, 401);
    served.hang_up();
    logs(&log, "read the tokens again").await;
    assert_eq!(get(&served, "/v1/twins", first).await.0, 401);
    assert_eq!(get(&served, "/v1/twins", second).await.0, 200);
    // A damaged file changes nothing.
    write("short");
    served.hang_up();
    logs(&log, "the old tokens stay: tokens[0].token: a token has at least 16").await;
    assert_eq!(get(&served, "/v1/twins", second).await.0, 200);
}

/// An episode with frames of `observe` only is not an error, and has no MCAP file.
#[tokio::test]
async fn a_session_that_drove_nothing_is_no_error_in_the_log() {
    let dir = tempfile::tempdir().unwrap();
    let log = dir.path().join("log");
    let served = logging("wildcity=debug", &log, &[]);
    let mut agent = Agent::connect(served.address).await;
    agent.hello().await;
    agent.open(json!({})).await;
    agent.look(json!({ "type": "observe", "poses": [support::pose(1.0)] })).await;
    agent.ask(json!({ "type": "close" })).await;
    logs(&log, "no MCAP file: the episode has no frame").await;
    let text = fs::read_to_string(&log).unwrap();
    assert!(!text.contains("ERROR"), "{text}");
}
