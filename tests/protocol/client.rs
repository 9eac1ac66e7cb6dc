//! The Rust client against a server that follows a script.

use std::time::Duration;

use tokio::net::TcpListener;
use tokio::time::timeout;
use wildcity_client::{Action, Client, ClientError, ConnectOptions, Movement};
use wildcity_protocol::error::Code;
use wildcity_protocol::message::{Open, Outcome, Pose, Request};

use super::fake_server::{FakeServer, Reply, request_seq};
use super::read;

/// Whether an error is the expected one.
type Refusal = fn(&ClientError) -> bool;

const HERE: Pose = Pose { xyz: [12.5, -3.25, 0.125], q: [0.8, 0.0, 0.0, 0.6] };

const HELLO: Reply = Reply::Golden("welcome");
const OPEN: Reply = Reply::Golden("opened");
const OBSERVATION: Reply = Reply::Observation(0);

async fn opened(scripts: Vec<Vec<Reply>>) -> (FakeServer, Client) {
    let server = FakeServer::start(scripts).await;
    let mut client = Client::connect(&server.url, "test").await.unwrap();
    client.open(Open::twin("street")).await.unwrap();
    (server, client)
}

fn seqs(requests: &[Request]) -> Vec<u64> {
    requests.iter().map(request_seq).collect()
}

#[tokio::test]
async fn a_whole_session() {
    let ok = Reply::Golden("ok");
    let closed = Reply::Golden("closed");
    let (server, mut client) = opened(vec![vec![
        HELLO,
        OPEN,
        OBSERVATION,
        OBSERVATION,
        OBSERVATION,
        OBSERVATION,
        ok,
        closed,
    ]])
    .await;
    assert_eq!(client.welcome().twins[0].name, "street");
    assert_eq!(client.reset(7, None).await.unwrap().metadata().seq, 2);
    let observation = client.step(HERE).await.unwrap();
    assert_eq!(observation.camera("rear").unwrap().rgb().unwrap().len(), 4 * 3 * 3);
    assert!(observation.camera("left").is_none());
    client.last_step(HERE).await.unwrap();
    client.observe(&[HERE, HERE]).await.unwrap();
    client.prefetch(&[HERE]).await.unwrap();
    assert_eq!(client.close().await.unwrap().outcome, Outcome::OffModel);
    drop(client);

    let requests = server.requests().await.remove(0);
    assert_eq!(seqs(&requests), [0, 1, 2, 3, 4, 5, 6, 7]);
    assert!(matches!(requests[3], Request::Step { pose: Some(HERE), terminate: false, .. }));
    assert!(matches!(requests[4], Request::Step { terminate: true, .. }));
}

/// With two sessions, requests name theirs, and both are resumed together.
#[tokio::test]
async fn several_sessions_of_one_connection() {
    let other = Reply::Text(
        String::from_utf8(read("vectors/answers/opened.json"))
            .unwrap()
            .replace("\"seq\": 1,", "\"seq\": 2,")
            .replace("run-17", "run-18"),
    );
    let many = Reply::Binary(read("vectors/many/two.bin"));
    let first = vec![HELLO, OPEN, other, many, OBSERVATION, Reply::HangUp];
    let second = vec![HELLO, Reply::Golden("resumed_also"), OBSERVATION, Reply::Golden("closed")];
    let (server, mut client) = opened(vec![first, second]).await;
    client.open(Open { session: Some("run-18".into()), ..Open::twin("street") }).await.unwrap();
    assert_eq!(client.sessions(), ["run-17", "run-18"]);

    let action = Action { acceleration: -1.5, curvature: 0.025 };
    let steps = vec![
        Movement::Pose(HERE).for_session("run-17"),
        Movement::Action(action).for_session("run-18"),
    ];
    let stepped = client.step_many(steps).await.unwrap();
    let names: Vec<_> = stepped.iter().map(|step| &*step.session).collect();
    assert_eq!(names, ["run-17", "run-18"]);
    let observation = stepped[0].result.as_ref().unwrap();
    observation.verify().unwrap();
    assert_eq!(observation.frame()[..], super::observations::raw_frame().bytes());
    let refused = stepped[1].result.as_ref().unwrap_err();
    assert_eq!(refused.code, Code::SessionState);
    assert_eq!(refused.field.as_deref(), Some("steps[1].action"));

    client.select("run-17");
    client.step(HERE).await.unwrap();
    client.step(HERE).await.unwrap_err();
    let resumed = client.reconnect().await.unwrap().unwrap();
    assert_eq!(resumed.also[0].step, 3);
    client.step(HERE).await.unwrap();
    client.close().await.unwrap();
    assert_eq!(client.sessions(), ["run-18"]);
    drop(client);

    let requests = server.requests().await;
    assert_eq!(seqs(&requests[0]), [0, 1, 2, 3, 4, 5]);
    assert_eq!(seqs(&requests[1]), [0, 1, 5, 6]);
    assert!(matches!(&requests[0][3], Request::StepMany { steps, .. } if steps.len() == 2));
    let named = |request: &Request| match request {
        Request::Step { session, .. } | Request::Close { session, .. } => session.clone(),
        _ => None,
    };
    for request in [&requests[0][4], &requests[1][2], &requests[1][3]] {
        assert_eq!(named(request).as_deref(), Some("run-17"));
    }
    let also = vec!["run-18".to_owned()];
    let resume = Request::Resume { seq: 1, session: "run-17".to_owned(), last_seq: 4, also };
    assert_eq!(requests[1][1], resume);
}

/// A message that differs from its header is refused.
#[tokio::test]
async fn damaged_answers_to_step_many() {
    let whole = read("vectors/many/two.bin");
    let swapped = String::from_utf8_lossy(&whole[8..]).find("run-17").unwrap() + 8;
    let mut other_session = whole.clone();
    other_session[swapped + 5] = b'9';
    for bytes in [whole[..whole.len() - 1].to_vec(), other_session] {
        let script = vec![HELLO, OPEN, OBSERVATION, Reply::Binary(bytes)];
        let (_server, mut client) = opened(vec![script]).await;
        client.step(HERE).await.unwrap();
        let steps = vec![Movement::Pose(HERE).for_session("run-17")];
        let refused = client.step_many(steps).await.unwrap_err();
        assert!(matches!(refused, ClientError::Frame(_)), "{refused}");
    }
}

#[tokio::test]
async fn a_refused_request_keeps_its_number() {
    let (server, mut client) =
        opened(vec![vec![HELLO, OPEN, Reply::Golden("error"), OBSERVATION]]).await;
    let Err(ClientError::Refused { code, field, fatal: false, .. }) = client.step(HERE).await
    else {
        panic!("the server refused");
    };
    assert_eq!((code, field.as_deref()), (Code::PoseNotFinite, Some("pose.q[2]")));
    client.step(HERE).await.unwrap();
    drop(client);
    assert_eq!(seqs(&server.requests().await[0]), [0, 1, 2, 2]);
}

#[tokio::test]
async fn a_fatal_error_ends_the_connection() {
    let (_server, mut client) = opened(vec![vec![HELLO, OPEN, Reply::Golden("error_fatal")]]).await;
    let refused = client.step(HERE).await;
    assert!(matches!(refused, Err(ClientError::Refused { fatal: true, .. })), "{refused:?}");
    let gone = client.step(HERE).await;
    assert!(matches!(&gone, Err(ClientError::Disconnected(why)) if why.contains("ShuttingDown")));
}

/// The golden `resumed` says that request 4 was carried out.
#[tokio::test]
async fn a_lost_answer_is_fetched_after_reconnecting() {
    let resumed = Reply::Golden("resumed");
    let first = vec![HELLO, OPEN, OBSERVATION, OBSERVATION, Reply::HangUp];
    let (server, mut client) =
        opened(vec![first, vec![HELLO, resumed, OBSERVATION, OBSERVATION]]).await;
    client.reset(0, None).await.unwrap();
    client.step(HERE).await.unwrap();
    let lost = client.step(HERE).await;
    assert!(matches!(lost, Err(ClientError::Disconnected(_))), "{lost:?}");

    let resumed = client.reconnect().await.unwrap().unwrap();
    assert_eq!((resumed.last_seq, resumed.step), (4, 2));
    client.step(HERE).await.unwrap();
    client.step(HERE).await.unwrap();
    drop(client);
    let requests = server.requests().await;
    assert_eq!(seqs(&requests[0]), [0, 1, 2, 3, 4]);
    assert_eq!(seqs(&requests[1]), [0, 1, 4, 5]);
    let session = "run-17".to_owned();
    assert_eq!(requests[1][1], Request::Resume { seq: 1, session, last_seq: 3, also: Vec::new() });
}

#[tokio::test]
async fn a_new_session_can_follow_one_that_is_gone() {
    let gone = r#"{"type":"error","seq":1,"code":"unknown_session","message":"","fatal":false}"#;
    let second = vec![HELLO, Reply::Text(gone.into()), OPEN, OBSERVATION];
    let (server, mut client) =
        opened(vec![vec![HELLO, OPEN, OBSERVATION, Reply::HangUp], second]).await;
    client.step(HERE).await.unwrap();
    client.step(HERE).await.unwrap_err();
    let refused = client.reconnect().await;
    assert!(
        matches!(refused, Err(ClientError::Refused { code: Code::UnknownSession, .. })),
        "{refused:?}"
    );
    client.open(Open::twin("street")).await.unwrap();
    client.step(HERE).await.unwrap();
    drop(client);
    assert_eq!(seqs(&server.requests().await[1]), [0, 1, 1, 2]);
}

#[tokio::test]
async fn another_client_can_resume_a_session() {
    let server = FakeServer::start(vec![vec![HELLO, Reply::Golden("resumed"), OBSERVATION]]).await;
    let mut client = Client::connect(&server.url, "test").await.unwrap();
    let resumed = client.resume("run-17", 4).await.unwrap();
    assert_eq!((resumed.last_seq, client.next_seq()), (4, 5));
    assert_eq!(client.step(HERE).await.unwrap().metadata().seq, 5);
}

#[tokio::test]
async fn the_largest_number_does_not_overflow() {
    let server = FakeServer::start(vec![vec![HELLO, Reply::Golden("resumed")]]).await;
    let mut client = Client::connect(&server.url, "test").await.unwrap();
    let result = client.resume("run-17", u64::MAX).await;
    assert!(matches!(result, Err(ClientError::UnexpectedAnswer { .. })), "{result:?}");
}

/// A call after a failed `reconnect` reports why the connection was lost.
#[tokio::test]
async fn a_refused_resume_is_reported_by_the_next_call() {
    let busy = r#"{"type":"error","seq":1,"code":"busy","message":"full","fatal":false}"#;
    let first = vec![HELLO, OPEN, Reply::HangUp];
    let (_server, mut client) = opened(vec![first, vec![HELLO, Reply::Text(busy.into())]]).await;
    client.step(HERE).await.unwrap_err();
    client.reconnect().await.unwrap_err();
    let gone = client.step(HERE).await;
    assert!(
        matches!(&gone, Err(ClientError::Disconnected(why)) if why.contains("full")),
        "{gone:?}"
    );
}

#[tokio::test]
async fn a_session_at_another_request_is_not_resumed() {
    let server = FakeServer::start(vec![vec![HELLO, Reply::Golden("resumed")]]).await;
    let mut client = Client::connect(&server.url, "test").await.unwrap();
    let result = client.resume("run-17", 2).await;
    assert!(matches!(result, Err(ClientError::UnexpectedAnswer { .. })), "{result:?}");
}

#[tokio::test]
async fn silence_ends_in_a_time_out() {
    let (_server, mut client) = opened(vec![vec![HELLO, OPEN, Reply::Silence]]).await;
    client.set_answer_timeout(Duration::from_millis(50));
    let silent = client.step(HERE).await;
    assert!(matches!(silent, Err(ClientError::TimedOut(_))), "{silent:?}");
    // The answer may still come, so the connection cannot be used again.
    assert!(matches!(client.step(HERE).await, Err(ClientError::Disconnected(_))));
}

#[tokio::test]
async fn a_dropped_call_gives_the_connection_up() {
    let (_server, mut client) = opened(vec![vec![HELLO, OPEN, Reply::Silence]]).await;
    assert!(timeout(Duration::from_millis(50), client.step(HERE)).await.is_err());
    let gone = client.step(HERE).await;
    assert!(matches!(&gone, Err(ClientError::Disconnected(why)) if why.contains("given up")));
}

#[tokio::test]
async fn invalid_answers_are_named() {
    let damaged = read("vectors/damaged/overlap.bin");
    let cases: [(Reply, Refusal); 5] = [
        (Reply::Observation(1), |e| {
            matches!(e, ClientError::SeqMismatch { expected: 2, got: Some(3) })
        }),
        (Reply::Golden("opened"), |e| matches!(e, ClientError::UnexpectedAnswer { .. })),
        (Reply::Text("{\"type\":".into()), |e| matches!(e, ClientError::Answer(_))),
        (Reply::Text("{\"type\":\"sing\",\"seq\":2}".into()), |e| {
            matches!(e, ClientError::Answer(_))
        }),
        (Reply::Binary(damaged), |e| matches!(e, ClientError::Frame(_))),
    ];
    for (reply, expected) in cases {
        let (_server, mut client) = opened(vec![vec![HELLO, OPEN, reply]]).await;
        let error = client.step(HERE).await.unwrap_err();
        assert!(expected(&error), "{error:?}");
        assert!(matches!(client.step(HERE).await, Err(ClientError::Disconnected(_))));
    }
}

#[tokio::test]
async fn connecting_without_a_server_fails() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("ws://{}/v1/session", listener.local_addr().unwrap());
    drop(listener);
    for url in [url.as_str(), "ws://", "not a url"] {
        let result = Client::connect(url, "test").await;
        assert!(matches!(result, Err(ClientError::Connect { .. })), "{url}: {result:?}");
    }
}

/// A server on another machine names a path that is a different file on this machine, or does not
/// exist: it is not opened.
#[tokio::test]
async fn memory_that_is_not_the_servers_is_not_opened() {
    for (path, target) in [("/proc/self/exe", "/memfd:wildcity (deleted)"), ("/none/such", "x")] {
        let offer = serde_json::json!({
            "type": "shared_memory", "seq": 1, "path": path, "target": target, "proof_bytes": 32, "slots": 3,
            "slot_bytes": 4096,
        });
        let server = FakeServer::start(vec![vec![HELLO, Reply::Text(offer.to_string())]]).await;
        let options = ConnectOptions { shared_memory: true, ..ConnectOptions::default() };
        let refused = Client::connect_with(&server.url, "test", &options).await.unwrap_err();
        let ClientError::SharedMemory(reason) = &refused else { panic!("{refused}") };
        assert!(reason.contains(path) && reason.contains("same container"), "{reason}");
        assert_eq!(server.requests().await[0].len(), 2, "no proof was sent");
    }
}

/// A place in memory that was not asked for is not an answer.
#[tokio::test]
async fn memory_that_was_not_asked_for_is_an_error() {
    let (_server, mut client) = opened(vec![vec![HELLO, OPEN, Reply::Golden("in_memory")]]).await;
    let refused = client.step(HERE).await.unwrap_err();
    assert!(matches!(refused, ClientError::SharedMemory(_)), "{refused}");
    let lost = client.step(HERE).await.unwrap_err();
    assert!(matches!(lost, ClientError::Disconnected(_)), "{lost}");
}
