//! A server of a few lines that answers from a script, in golden messages.

use futures_util::{SinkExt, StreamExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio_tungstenite::accept_hdr_async;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::handshake::server::{Request as Upgrade, Response};
use tokio_tungstenite::tungstenite::http::HeaderValue;
use wildcity_protocol::PROTOCOL;
use wildcity_protocol::message::Request;

use super::frames::Frame;
use super::observations::raw_frame;
use super::read;

/// What the server does with one request.
#[derive(Clone)]
pub(crate) enum Reply {
    /// A golden answer, with the request's number.
    Golden(&'static str),
    /// The golden raw frame, with the request's number and this much more.
    Observation(u64),
    /// These very bytes.
    Text(String),
    /// These very bytes.
    Binary(Vec<u8>),
    /// Says nothing, and keeps the connection.
    Silence,
    /// Drops the connection without a word.
    HangUp,
}

pub(crate) struct FakeServer {
    pub(crate) url: String,
    task: JoinHandle<Vec<Vec<Request>>>,
}

impl FakeServer {
    /// Answers one connection after the other by its script.
    pub(crate) async fn start(scripts: Vec<Vec<Reply>>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("ws://{}/v1/session", listener.local_addr().unwrap());
        let task = tokio::spawn(async move {
            let mut requests = Vec::new();
            for script in scripts {
                let (stream, _) = listener.accept().await.unwrap();
                requests.push(follow(stream, script).await);
            }
            requests
        });
        Self { url, task }
    }

    /// What came in, by connection, once all scripts are done and their clients gone.
    pub(crate) async fn requests(self) -> Vec<Vec<Request>> {
        self.task.await.unwrap()
    }
}

#[expect(clippy::result_large_err, reason = "the type of tungstenite's callback")]
async fn follow(stream: TcpStream, script: Vec<Reply>) -> Vec<Request> {
    let choose = |upgrade: &Upgrade, mut response: Response| {
        assert_eq!(upgrade.uri().path(), "/v1/session");
        assert_eq!(upgrade.headers()["Sec-WebSocket-Protocol"], PROTOCOL);
        let chosen = HeaderValue::from_static(PROTOCOL);
        response.headers_mut().insert("Sec-WebSocket-Protocol", chosen);
        Ok(response)
    };
    let mut socket = accept_hdr_async(stream, choose).await.unwrap();
    let mut requests = Vec::new();
    for reply in script {
        let Some(Ok(Message::Text(text))) = socket.next().await else { return requests };
        let request: Request = serde_json::from_str(&text).unwrap();
        let message = answer(&reply, seq_of(&request));
        requests.push(request);
        match message {
            Some(message) => socket.send(message).await.unwrap(),
            None if matches!(reply, Reply::HangUp) => return requests,
            None => {}
        }
    }
    // Until the client leaves. What is not in the script gets no answer, but is noted.
    while let Some(Ok(message)) = socket.next().await {
        if let Message::Text(text) = message {
            requests.push(serde_json::from_str(&text).unwrap());
        }
    }
    requests
}

fn answer(reply: &Reply, seq: u64) -> Option<Message> {
    match reply {
        Reply::Golden(name) => {
            let mut value: serde_json::Value =
                serde_json::from_slice(&read(&format!("vectors/answers/{name}.json"))).unwrap();
            if let Some(field) = value.get_mut("seq") {
                *field = seq.into();
            }
            Some(Message::text(value.to_string()))
        }
        Reply::Observation(off) => {
            let mut frame: Frame = raw_frame();
            frame.metadata.seq = seq + off;
            Some(Message::binary(frame.bytes()))
        }
        Reply::Text(text) => Some(Message::text(text.clone())),
        Reply::Binary(bytes) => Some(Message::binary(bytes.clone())),
        Reply::Silence | Reply::HangUp => None,
    }
}

pub(crate) fn seq_of(request: &Request) -> u64 {
    match request {
        Request::Open(open) => open.seq,
        Request::Hello { seq, .. }
        | Request::Step { seq, .. }
        | Request::Observe { seq, .. }
        | Request::Prefetch { seq, .. }
        | Request::Reset { seq, .. }
        | Request::SwitchVersion { seq, .. }
        | Request::Close { seq }
        | Request::Resume { seq, .. } => *seq,
    }
}
