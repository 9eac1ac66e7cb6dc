//! One WebSocket: a message out, a message in, each with a limit and a time-out.

use std::fmt;
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::http::HeaderValue;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Bytes, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async_with_config};

use wildcity_protocol::PROTOCOL;
use wildcity_protocol::message::{Answer, Request};

use super::error::ClientError;
use super::observation::Observation;

#[derive(Debug)]
pub(super) struct Connection {
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
}

/// An answer that is not an error.
#[derive(Debug)]
pub(super) enum Incoming {
    Answer(Answer),
    Observation(Box<Observation>),
}

impl Connection {
    /// Connects, with a token for a server that has tokens.
    pub(super) async fn open(url: &str, token: Option<&str>) -> Result<Self, ClientError> {
        let failed = |reason: String| ClientError::Connect { url: url.to_owned(), reason };
        let mut request = url.into_client_request().map_err(|e| failed(e.to_string()))?;
        let subprotocol = HeaderValue::from_static(PROTOCOL);
        request.headers_mut().insert("Sec-WebSocket-Protocol", subprotocol);
        if let Some(token) = token {
            let bearer = HeaderValue::try_from(format!("Bearer {token}"));
            let bearer = bearer.map_err(|_| failed("no header may have that token".to_owned()))?;
            request.headers_mut().insert("Authorization", bearer);
        }
        let limits = WebSocketConfig::default()
            .max_message_size(Some(wildcity_protocol::limits::OBSERVATION_BYTES))
            .max_frame_size(Some(wildcity_protocol::limits::OBSERVATION_BYTES));
        // Lock step on TCP: a request must not wait for the acknowledgement of the last one.
        let without_delay = true;
        let connecting = connect_async_with_config(request, Some(limits), without_delay);
        match timeout(wildcity_protocol::limits::HELLO_TIMEOUT, connecting).await {
            Ok(Ok((socket, _))) => Ok(Self { socket }),
            Ok(Err(error)) => Err(failed(error.to_string())),
            Err(_) => Err(failed(format!(
                "no answer within {:?}",
                wildcity_protocol::limits::HELLO_TIMEOUT
            ))),
        }
    }

    /// Sends a request and gives its answer, which must bear the same number.
    pub(super) async fn exchange(
        &mut self,
        request: &Request,
        seq: u64,
        patience: Duration,
    ) -> Result<Incoming, ClientError> {
        let text = serde_json::to_string(request).map_err(ClientError::Request)?;
        let both_ways = async {
            let sent = self.socket.send(Message::text(text)).await;
            // A server that closes says why first, and that outlives the failure to send.
            let answer = self.receive().await;
            match sent {
                Err(error) if matches!(answer, Err(ClientError::Disconnected(_))) => {
                    Err(ClientError::Disconnected(error.to_string()))
                }
                _ => answer,
            }
        };
        let incoming =
            timeout(patience, both_ways).await.map_err(|_| ClientError::TimedOut(patience))??;
        let answered = incoming.seq();
        match incoming {
            // A request that could not be read has no number to answer with.
            Incoming::Answer(Answer::Error { seq: of, code, message, field, fatal })
                if of.is_none_or(|of| of == seq) =>
            {
                Err(ClientError::Refused { code, message, field, fatal })
            }
            incoming if answered == Some(seq) => Ok(incoming),
            _ => Err(ClientError::SeqMismatch { expected: seq, got: answered }),
        }
    }

    async fn receive(&mut self) -> Result<Incoming, ClientError> {
        loop {
            match self.socket.next().await {
                Some(Ok(Message::Text(text))) => {
                    return Ok(Incoming::Answer(
                        serde_json::from_str(&text).map_err(ClientError::Answer)?,
                    ));
                }
                Some(Ok(Message::Binary(frame))) => return decode(frame),
                Some(Ok(Message::Close(Some(close)))) => {
                    let reason = format!("the server closed: {} {}", close.code, close.reason);
                    return Err(ClientError::Disconnected(reason));
                }
                Some(Ok(Message::Close(None))) | None => {
                    return Err(ClientError::Disconnected("the server closed".into()));
                }
                Some(Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_))) => {}
                Some(Err(error)) => return Err(ClientError::Disconnected(error.to_string())),
            }
        }
    }
}

fn decode(frame: Bytes) -> Result<Incoming, ClientError> {
    let seen = Observation::decode(frame).map_err(ClientError::Frame)?;
    Ok(Incoming::Observation(Box::new(seen)))
}

impl Incoming {
    fn seq(&self) -> Option<u64> {
        match self {
            Self::Observation(observation) => Some(observation.metadata().seq),
            Self::Answer(Answer::Error { seq, .. }) => *seq,
            Self::Answer(Answer::Opened(opened)) => Some(opened.seq),
            Self::Answer(
                Answer::Welcome { seq, .. }
                | Answer::Resumed { seq, .. }
                | Answer::Ok { seq }
                | Answer::Switched { seq, .. }
                | Answer::Closed { seq, .. },
            ) => Some(*seq),
        }
    }
}

/// Short, for messages.
impl fmt::Display for Incoming {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Observation(observation) => {
                write!(f, "observation {}", observation.metadata().seq)
            }
            Self::Answer(answer) => write!(f, "{answer:.200?}"),
        }
    }
}
