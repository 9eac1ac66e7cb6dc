//! One WebSocket: sends a message and receives its answer, with size limits and time limits.

use std::fmt;
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
#[cfg(not(feature = "http"))]
use tokio_tungstenite::connect_async_with_config;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::handshake::client::Request as UpgradeRequest;
use tokio_tungstenite::tungstenite::http::HeaderValue;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Bytes, Message};
#[cfg(feature = "http")]
use tokio_tungstenite::{Connector, connect_async_tls_with_config};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

use wildcity_protocol::PROTOCOL;
use wildcity_protocol::limits::{HELLO_TIMEOUT, OBSERVATION_BYTES};
use wildcity_protocol::message::{Answer, Request};

use crate::error::{ClientError, FrameError};
use crate::many::Many;
use crate::memory::{Offer, SharedMemory};
use crate::observation::Observation;
use crate::options::ConnectOptions;

/// A server's address, with all that is needed to connect to it again.
#[derive(Clone)]
pub(crate) struct Endpoint {
    url: String,
    upgrade: UpgradeRequest,
    #[cfg(feature = "http")]
    connector: Connector,
    /// Whether connections share memory.
    pub(crate) shares_memory: bool,
}

#[derive(Debug)]
pub(crate) struct Connection {
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    memory: Option<SharedMemory>,
}

/// A message from the server.
#[derive(Debug)]
pub(crate) enum Incoming {
    Answer(Answer),
    Observation(Box<Observation>),
    Many(Box<Many>),
}

impl Endpoint {
    /// Checks the address and the options; nothing is sent yet.
    pub(crate) fn new(url: &str, options: &ConnectOptions) -> Result<Self, ClientError> {
        let failed = |reason: String| ClientError::Connect { url: url.to_owned(), reason };
        // Made once: a later reconnection sends the same headers.
        let mut upgrade = url.into_client_request().map_err(|error| failed(error.to_string()))?;

        let headers = upgrade.headers_mut();
        headers.insert("Sec-WebSocket-Protocol", HeaderValue::from_static(PROTOCOL));
        if let Some(token) = &options.token {
            let mut bearer = HeaderValue::try_from(format!("Bearer {token}")).map_err(|_| {
                failed("the token has a character that an HTTP header cannot carry".to_owned())
            })?;
            bearer.set_sensitive(true);
            headers.insert("Authorization", bearer);
        }

        let has_tls = upgrade.uri().scheme_str() == Some("wss");
        #[cfg(feature = "http")]
        let connector = if has_tls {
            let config = crate::tls::client_config(&options.root_certificates_pem);
            Connector::Rustls(std::sync::Arc::new(config.map_err(failed)?))
        } else {
            Connector::Plain
        };
        #[cfg(not(feature = "http"))]
        if has_tls {
            let reason = "built without TLS: build wildcity-client with the feature `http`";
            return Err(failed(reason.to_owned()));
        }
        Ok(Self {
            url: url.to_owned(),
            upgrade,
            #[cfg(feature = "http")]
            connector,
            shares_memory: options.shared_memory,
        })
    }

    /// Opens a connection. Fails after [`HELLO_TIMEOUT`].
    pub(crate) async fn connect(&self) -> Result<Connection, ClientError> {
        let failed = |reason: String| ClientError::Connect { url: self.url.clone(), reason };
        let limits = WebSocketConfig::default()
            .max_message_size(Some(OBSERVATION_BYTES))
            .max_frame_size(Some(OBSERVATION_BYTES));
        // Sets TCP_NODELAY: in lock step a request must not wait for the acknowledgement of the
        // previous request.
        let no_delay = true;
        #[cfg(feature = "http")]
        let connecting = connect_async_tls_with_config(
            self.upgrade.clone(),
            Some(limits),
            no_delay,
            Some(self.connector.clone()),
        );
        #[cfg(not(feature = "http"))]
        let connecting = connect_async_with_config(self.upgrade.clone(), Some(limits), no_delay);
        match timeout(HELLO_TIMEOUT, connecting).await {
            Ok(Ok((socket, _response))) => Ok(Connection { socket, memory: None }),
            Ok(Err(error)) => Err(failed(error.to_string())),
            Err(_) => Err(failed(format!("no answer within {HELLO_TIMEOUT:?}"))),
        }
    }
}

/// Hides the token, which is in the request.
impl fmt::Debug for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Endpoint").field("url", &self.url).finish_non_exhaustive()
    }
}

impl Connection {
    /// Sends a request and returns its answer, which must have the same number.
    ///
    /// # Errors
    /// [`ClientError::Refused`] if the answer is an error; otherwise the connection cannot be used
    /// again.
    pub(crate) async fn exchange(
        &mut self,
        request: &Request,
        seq: u64,
        time_limit: Duration,
    ) -> Result<Incoming, ClientError> {
        let text = serde_json::to_string(request).map_err(ClientError::Request)?;
        let send_and_receive = async {
            let sent = self.socket.send(Message::text(text)).await;
            // A server sends the reason before it closes the connection. This message can be read
            // even after a failed send, and explains more than the failure.
            let answer = self.receive().await;
            match sent {
                Err(error) if matches!(answer, Err(ClientError::Disconnected(_))) => {
                    Err(ClientError::Disconnected(error.to_string()))
                }
                _ => answer,
            }
        };
        let incoming = timeout(time_limit, send_and_receive)
            .await
            .map_err(|_| ClientError::TimedOut(time_limit))??;
        let answered_seq = incoming.seq();
        match incoming {
            // An error has no number if the server could not read the request.
            Incoming::Answer(Answer::Error { seq: error_seq, code, message, field, fatal })
                if error_seq.is_none_or(|error_seq| error_seq == seq) =>
            {
                Err(ClientError::Refused { code, message, field, fatal })
            }
            Incoming::Answer(Answer::InMemory { offset, bytes, .. })
                if answered_seq == Some(seq) =>
            {
                let memory = self.memory.as_ref().ok_or_else(|| {
                    ClientError::SharedMemory(
                        "the server uses one that was not asked for".to_owned(),
                    )
                })?;
                let incoming = decode(memory.read(offset, bytes).await?)?;
                match incoming.seq() {
                    found if found == Some(seq) => Ok(incoming),
                    got => Err(ClientError::SeqMismatch { expected: seq, got }),
                }
            }
            incoming if answered_seq == Some(seq) => Ok(incoming),
            _ => Err(ClientError::SeqMismatch { expected: seq, got: answered_seq }),
        }
    }

    /// Lets the server send observations in shared memory. `seq` is the first of two numbers.
    ///
    /// # Errors
    /// The server refuses, or its memory cannot be opened.
    pub(crate) async fn share_memory(&mut self, seq: u64) -> Result<(), ClientError> {
        let asked = Request::ShareMemory { seq, proof: None };
        let offer = match self.exchange(&asked, seq, HELLO_TIMEOUT).await? {
            Incoming::Answer(Answer::SharedMemory {
                path,
                target,
                proof_bytes,
                slots,
                slot_bytes,
                ..
            }) => Offer { path, target, proof_bytes, size: slots.saturating_mul(slot_bytes) },
            other => return Err(unexpected("shared_memory", &other)),
        };
        let (memory, proof) = SharedMemory::open(&offer)?;
        // The proof is a request of its own, and each request has its own number.
        let seq = seq + 1;
        let proven = Request::ShareMemory { seq, proof: Some(proof) };
        match self.exchange(&proven, seq, HELLO_TIMEOUT).await? {
            Incoming::Answer(Answer::Ok { .. }) => {
                self.memory = Some(memory);
                Ok(())
            }
            other => Err(unexpected("ok", &other)),
        }
    }

    async fn receive(&mut self) -> Result<Incoming, ClientError> {
        loop {
            match self.socket.next().await {
                Some(Ok(Message::Text(text))) => {
                    let answer = serde_json::from_str(&text).map_err(ClientError::Answer)?;
                    return Ok(Incoming::Answer(answer));
                }
                Some(Ok(Message::Binary(frame))) => return decode(frame),
                Some(Ok(Message::Close(Some(close)))) => {
                    let reason = format!(
                        "the server closed the connection: {} {}",
                        close.code, close.reason
                    );
                    return Err(ClientError::Disconnected(reason));
                }
                Some(Ok(Message::Close(None))) | None => {
                    let reason = "the server closed the connection".to_owned();
                    return Err(ClientError::Disconnected(reason));
                }
                // The library answers pings by itself.
                Some(Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_))) => {}
                Some(Err(error)) => return Err(ClientError::Disconnected(error.to_string())),
            }
        }
    }
}

fn unexpected(expected: &'static str, got: &Incoming) -> ClientError {
    ClientError::UnexpectedAnswer { expected, got: got.to_string() }
}

fn decode(frame: Bytes) -> Result<Incoming, ClientError> {
    // A clone of `Bytes` counts a reference, and copies no pixels.
    match Observation::decode(frame.clone()) {
        Ok(observation) => Ok(Incoming::Observation(Box::new(observation))),
        // The answer to `step_many` has another metadata.
        Err(FrameError::NoObservation) => {
            let many = Many::decode(&frame).map_err(ClientError::Frame)?;
            Ok(Incoming::Many(Box::new(many)))
        }
        Err(error) => Err(ClientError::Frame(error)),
    }
}

impl Incoming {
    /// Number of the request that this message answers.
    fn seq(&self) -> Option<u64> {
        match self {
            Self::Observation(observation) => Some(observation.metadata().seq),
            Self::Many(many) => Some(many.seq),
            Self::Answer(Answer::Error { seq, .. }) => *seq,
            Self::Answer(Answer::Opened(opened)) => Some(opened.seq),
            Self::Answer(
                Answer::Welcome { seq, .. }
                | Answer::Resumed { seq, .. }
                | Answer::Ok { seq }
                | Answer::SharedMemory { seq, .. }
                | Answer::InMemory { seq, .. }
                | Answer::Switched { seq, .. }
                | Answer::Closed { seq, .. },
            ) => Some(*seq),
        }
    }
}

/// A short form for error messages.
impl fmt::Display for Incoming {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Observation(observation) => {
                write!(f, "observation {}", observation.metadata().seq)
            }
            Self::Many(many) => {
                write!(f, "observations of {} sessions {}", many.steps.len(), many.seq)
            }
            Self::Answer(answer) => write!(f, "{answer:.200?}"),
        }
    }
}
