//! A WebSocket server that answers from a script of golden messages, with or without TLS.

use futures_util::{SinkExt, StreamExt};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_rustls::TlsAcceptor;
use tokio_tungstenite::accept_hdr_async;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::handshake::server::{Request as Upgrade, Response};
use tokio_tungstenite::tungstenite::http::HeaderValue;
use wildcity_protocol::PROTOCOL;
use wildcity_protocol::message::Request;

use super::frames::Frame;
use super::observations::raw_frame;
use super::read;

/// Reaction of the server to one request.
#[derive(Clone)]
pub(crate) enum Reply {
    /// Sends a golden answer with the request's number.
    Golden(&'static str),
    /// Sends the golden raw frame with the request's number plus this offset.
    Observation(u64),
    /// Sends exactly this text.
    Text(String),
    /// Sends exactly these bytes.
    Binary(Vec<u8>),
    /// Sends nothing, and keeps the connection open.
    Silence,
    /// Closes the connection without a message.
    HangUp,
}

pub(crate) struct FakeServer {
    pub(crate) url: String,
    task: JoinHandle<Vec<Vec<Request>>>,
}

impl FakeServer {
    /// Accepts one connection per script, one after the other.
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

    /// As [`FakeServer::start`], with TLS. A failed handshake uses up no script.
    pub(crate) async fn start_tls(scripts: Vec<Vec<Reply>>, acceptor: TlsAcceptor) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("wss://localhost:{}/v1/session", listener.local_addr().unwrap().port());
        let task = tokio::spawn(async move {
            let mut requests = Vec::new();
            let mut scripts = scripts.into_iter();
            while scripts.len() > 0 {
                let (stream, _) = listener.accept().await.unwrap();
                let Ok(stream) = acceptor.accept(stream).await else { continue };
                requests.push(follow(stream, scripts.next().unwrap()).await);
            }
            requests
        });
        Self { url, task }
    }

    /// The requests of each connection. Waits until all scripts are done and their clients are
    /// gone.
    pub(crate) async fn requests(self) -> Vec<Vec<Request>> {
        self.task.await.unwrap()
    }
}

#[expect(clippy::result_large_err, reason = "the type of tungstenite's callback")]
async fn follow(stream: impl AsyncRead + AsyncWrite + Unpin, script: Vec<Reply>) -> Vec<Request> {
    let choose_subprotocol = |upgrade: &Upgrade, mut response: Response| {
        assert_eq!(upgrade.uri().path(), "/v1/session");
        assert_eq!(upgrade.headers()["Sec-WebSocket-Protocol"], PROTOCOL);
        let chosen = HeaderValue::from_static(PROTOCOL);
        response.headers_mut().insert("Sec-WebSocket-Protocol", chosen);
        Ok(response)
    };
    let mut socket = accept_hdr_async(stream, choose_subprotocol).await.unwrap();
    let mut requests = Vec::new();
    for reply in script {
        let Some(Ok(Message::Text(text))) = socket.next().await else { return requests };
        let request: Request = serde_json::from_str(&text).unwrap();
        let message = answer(&reply, request_seq(&request));
        requests.push(request);
        match message {
            Some(message) => socket.send(message).await.unwrap(),
            None if matches!(reply, Reply::HangUp) => return requests,
            None => {}
        }
    }
    // Until the client disconnects. Requests beyond the script are recorded and get no answer.
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
        Reply::Observation(offset) => {
            let mut frame: Frame = raw_frame();
            frame.metadata.seq = seq + offset;
            Some(Message::binary(frame.bytes()))
        }
        Reply::Text(text) => Some(Message::text(text.clone())),
        Reply::Binary(bytes) => Some(Message::binary(bytes.clone())),
        Reply::Silence | Reply::HangUp => None,
    }
}

pub(crate) fn request_seq(request: &Request) -> u64 {
    match request {
        Request::Open(open) => open.seq,
        Request::Hello { seq, .. }
        | Request::ShareMemory { seq, .. }
        | Request::Step { seq, .. }
        | Request::Observe { seq, .. }
        | Request::Prefetch { seq, .. }
        | Request::Reset { seq, .. }
        | Request::SwitchVersion { seq, .. }
        | Request::Close { seq, .. }
        | Request::StepMany { seq, .. }
        | Request::Snapshot { seq, .. }
        | Request::Restore { seq, .. }
        | Request::Resume { seq, .. } => *seq,
        Request::Branch(branch) => branch.seq,
    }
}
