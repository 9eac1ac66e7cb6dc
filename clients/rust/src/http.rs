//! The client of what HTTP carries: uploads, pushes, versions.
//!
//! A connection per request: there are few, and each may be the one that a broken network cuts.

use std::time::Duration;

use bytes::Bytes;
use http_body_util::combinators::UnsyncBoxBody;
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::header::{AUTHORIZATION, CONTENT_TYPE, HOST};
use hyper::{Method, Request, StatusCode};
use hyper_util::rt::TokioIo;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::limits;
use wildcity_protocol::error::Code;
use wildcity_protocol::http::{NewPush, Push, PushState, Refusal, Rollback};

/// A server, and the token for it.
#[derive(Clone)]
pub struct HttpClient {
    /// `host:port`.
    authority: String,
    token: Option<String>,
}

/// Why a request failed.
#[derive(Debug, thiserror::Error)]
pub enum HttpError {
    /// Not the address of a server.
    #[error("{url:?} is not a server: expected http://HOST:PORT")]
    Url {
        /// What was given.
        url: String,
    },
    /// The token cannot stand in a header.
    #[error("the token has a character that no header may have")]
    Token,
    /// Nobody answers, or not to the end.
    #[error("no answer from {server}: {reason}")]
    Lost {
        /// The server.
        server: String,
        /// Why not.
        reason: String,
    },
    /// The server refuses.
    #[error("refused, {status}: {message}")]
    Refused {
        /// As HTTP counts.
        status: u16,
        /// What went wrong; none if the answer is not of this protocol.
        code: Option<Code>,
        /// For people: what, and how to fix it.
        message: String,
        /// The cells at fault, as (x, y), where cells are.
        cells: Vec<[i32; 2]>,
        /// Where an upload goes on, where that is the matter.
        offset: Option<u64>,
    },
    /// The answer is not what was asked for.
    #[error("cannot read the answer of {server}: {reason}")]
    Answer {
        /// The server.
        server: String,
        /// Why not.
        reason: String,
    },
    /// The file cannot be read.
    #[error("cannot read {path}: {cause}")]
    File {
        /// The file.
        path: String,
        /// What the operating system says.
        cause: std::io::Error,
    },
}

/// A body on its way out: streamed, as whoever sends waits for a disk.
pub(super) type Body = UnsyncBoxBody<Bytes, std::io::Error>;

impl HttpClient {
    /// Of `http://HOST:PORT`. Nothing is sent yet.
    ///
    /// # Errors
    /// The address is not one.
    pub fn new(url: &str, token: Option<String>) -> Result<Self, HttpError> {
        let wrong = || HttpError::Url { url: url.to_owned() };
        let authority = url.strip_prefix("http://").ok_or_else(wrong)?.trim_end_matches('/');
        let has_port = authority
            .rsplit_once(':')
            .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok());
        let is_plain =
            authority.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.:[]_".contains(&b));
        match has_port && is_plain {
            true => Ok(Self { authority: authority.to_owned(), token }),
            false => Err(wrong()),
        }
    }

    /// Asks for a new version of uploaded files; [`HttpClient::wait_for_push`] tells how it goes on.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn push(&self, twin: &str, push: &NewPush) -> Result<Push, HttpError> {
        self.json(Method::POST, &format!("/v1/twins/{twin}/pushes"), Some(push)).await
    }

    /// How it stands with a push.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn push_status(&self, twin: &str, id: &str) -> Result<Push, HttpError> {
        self.json(Method::GET, &format!("/v1/twins/{twin}/pushes/{id}"), None::<&()>).await
    }

    /// Waits until a push is ready, refused or failed; `seen` is shown how it stands, again and again.
    ///
    /// # Errors
    /// The server refuses, or does not answer any more.
    pub async fn wait_for_push(
        &self,
        push: Push,
        seen: &mut (dyn FnMut(&Push) + Send),
    ) -> Result<Push, HttpError> {
        let (mut push, mut lost) = (push, 0);
        loop {
            seen(&push);
            if matches!(push.state, PushState::Ready | PushState::Refused | PushState::Failed) {
                return Ok(push);
            }
            tokio::time::sleep(limits::PUSH_POLL).await;
            push = match self.push_status(&push.twin, &push.id).await {
                Ok(push) => {
                    lost = 0;
                    push
                }
                Err(HttpError::Lost { .. }) if lost < limits::HTTP_TRIES => {
                    lost += 1;
                    push
                }
                Err(error) => return Err(error),
            };
        }
    }

    /// Makes an old version of a twin the latest again, as a new one.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn rollback(&self, twin: &str, version: u64) -> Result<u64, HttpError> {
        #[derive(serde::Deserialize)]
        struct Made {
            version: u64,
        }
        let path = format!("/v1/twins/{twin}/rollback");
        let made: Made = self.json(Method::POST, &path, Some(&Rollback { version })).await?;
        Ok(made.version)
    }

    /// Sends a request with a body in JSON, or none, and reads the answer.
    pub(super) async fn json<T: DeserializeOwned>(
        &self,
        method: Method,
        path: &str,
        body: Option<&impl Serialize>,
    ) -> Result<T, HttpError> {
        let body = match body {
            Some(body) => serde_json::to_vec(body).map_err(|error| self.unreadable(&error))?,
            None => Vec::new(),
        };
        let request =
            Request::builder().method(method).uri(path).header(CONTENT_TYPE, "application/json");
        let full = Full::new(Bytes::from(body)).map_err(|never| match never {}).boxed_unsync();
        let answer = self.send(request, full, limits::HTTP_TIMEOUT).await?;
        serde_json::from_slice(&answer).map_err(|error| self.unreadable(&error))
    }

    /// Sends a request on a connection of its own, and gives the body of an answer that is no refusal.
    pub(super) async fn send(
        &self,
        request: hyper::http::request::Builder,
        body: Body,
        patience: Duration,
    ) -> Result<Bytes, HttpError> {
        let mut request = request.header(HOST, &self.authority);
        if let Some(token) = &self.token {
            let bearer = hyper::header::HeaderValue::try_from(format!("Bearer {token}"));
            let mut bearer = bearer.map_err(|_| HttpError::Token)?;
            bearer.set_sensitive(true);
            request = request.header(AUTHORIZATION, bearer);
        }
        let request = request.body(body).map_err(|error| self.unreadable(&error))?;
        match timeout(patience, self.exchange(request)).await {
            Ok(answer) => answer,
            Err(_) => Err(self.lost(&format!("none within {patience:?}"))),
        }
    }

    async fn exchange(&self, request: Request<Body>) -> Result<Bytes, HttpError> {
        let stream = timeout(limits::HTTP_CONNECT_TIMEOUT, TcpStream::connect(&self.authority));
        let stream = stream.await.map_err(|_| self.lost(&"cannot connect in time"))?;
        let stream = stream.map_err(|error| self.lost(&error))?;
        let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream))
            .await
            .map_err(|error| self.lost(&error))?;
        // Driven beside the request, and dropped with it.
        let exchanged = async {
            let answer = sender.send_request(request).await.map_err(|error| self.lost(&error))?;
            let status = answer.status();
            let limited = Limited::new(answer.into_body(), limits::HTTP_ANSWER_BYTES);
            let body = limited.collect().await.map_err(|error| self.lost(&error))?.to_bytes();
            if status.is_success() { Ok(body) } else { Err(refused(status, &body)) }
        };
        tokio::pin!(exchanged);
        tokio::pin!(connection);
        tokio::select! {
            exchanged = &mut exchanged => exchanged,
            // The connection may end before its answer is read, and the answer is there all the same.
            _ = &mut connection => exchanged.await,
        }
    }

    pub(super) fn lost(&self, reason: &dyn std::fmt::Display) -> HttpError {
        HttpError::Lost { server: self.authority.clone(), reason: reason.to_string() }
    }

    fn unreadable(&self, reason: &dyn std::fmt::Display) -> HttpError {
        HttpError::Answer { server: self.authority.clone(), reason: reason.to_string() }
    }
}

/// Says nothing of the token.
impl std::fmt::Debug for HttpClient {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("HttpClient").field("authority", &self.authority).finish_non_exhaustive()
    }
}

fn refused(status: StatusCode, body: &[u8]) -> HttpError {
    let status = status.as_u16();
    match serde_json::from_slice::<Refusal>(body) {
        Ok(Refusal { code, message, cells, offset, .. }) => {
            HttpError::Refused { status, code: Some(code), message, cells, offset }
        }
        Err(_) => {
            let message = String::from_utf8_lossy(&body[..body.len().min(200)]).into_owned();
            HttpError::Refused { status, code: None, message, cells: Vec::new(), offset: None }
        }
    }
}
