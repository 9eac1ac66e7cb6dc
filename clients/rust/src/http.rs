//! The HTTP client: pushes and versions. Uploads are in `upload`.
//!
//! Each request opens a new connection, because requests are rare, and a connection that is kept
//! open may be cut by a broken network.

use std::error::Error;
use std::fmt::{self, Display};
use std::time::Duration;

use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};
use reqwest::redirect::Policy;
use reqwest::{Method, RequestBuilder, StatusCode, Url};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use wildcity_protocol::error::Code;
use wildcity_protocol::http::{NewPush, Push, PushState, Refusal, Rollback};
use wildcity_protocol::message::{Drive, DriveSection};

use crate::limits;
use crate::options::ConnectOptions;
use crate::tls;

/// Uploads scenes to a server and publishes them as versions of a twin.
///
/// ```no_run
/// use std::path::Path;
/// use wildcity_client::{ConnectOptions, HttpClient};
///
/// # async fn upload() -> Result<(), wildcity_client::HttpError> {
/// let options = ConnectOptions::with_token(std::env::var("WILDCITY_TOKEN").ok());
/// let client = HttpClient::new("http://127.0.0.1:8080", &options)?;
/// let mut progress = |sent, total| eprintln!("{sent} of {total} bytes");
/// let upload = client.upload(Path::new("street.ply"), &mut progress).await?;
/// println!("{}", upload.id);
/// # Ok(())
/// # }
/// ```
#[derive(Clone)]
pub struct HttpClient {
    /// The server's address, without a path.
    server: Url,
    http: reqwest::Client,
}

/// Why a call of the HTTP client failed.
#[derive(Debug, thiserror::Error)]
pub enum HttpError {
    /// The text is not the address of a server.
    #[error("{url:?} is not a server: expected http://HOST:PORT or https://HOST:PORT")]
    Url {
        /// The text as it was given.
        url: String,
    },
    /// The token cannot be sent.
    #[error("the token has a character that an HTTP header cannot carry")]
    Token,
    /// TLS cannot be set up.
    #[error("cannot set up TLS: {reason}")]
    Tls {
        /// What is wrong with the root certificates, or missing.
        reason: String,
    },
    /// The server did not answer, or its answer was cut off.
    #[error("no answer from {server}: {reason}")]
    NoAnswer {
        /// Host and port of the server.
        server: String,
        /// What the network reported.
        reason: String,
    },
    /// The server refused the request.
    #[error("refused, {status}: {message}")]
    Refused {
        /// Status of the answer, such as 409.
        status: u16,
        /// Code of the error; `None` if the answer is not of this protocol.
        code: Option<Code>,
        /// Description of the error and of its remedy.
        message: String,
        /// The cells at fault, as (x, y), if the error concerns cells.
        cells: Vec<[i32; 2]>,
        /// The offset at which an upload must continue, in bytes, if the request had a different
        /// one.
        offset: Option<u64>,
    },
    /// The answer does not conform to the protocol.
    #[error("cannot read the answer of {server}: {reason}")]
    Answer {
        /// Host and port of the server.
        server: String,
        /// What is wrong with the answer.
        reason: String,
    },
    /// A file cannot be read.
    #[error("cannot read {path}: {cause}")]
    File {
        /// Path of the file, as it was given.
        path: String,
        /// The error of the operating system.
        cause: std::io::Error,
    },
}

impl HttpClient {
    /// A client of the server at `http://HOST:PORT` or `https://HOST:PORT`. Nothing is sent yet.
    ///
    /// # Errors
    /// [`HttpError::Url`], [`HttpError::Token`] or [`HttpError::Tls`].
    pub fn new(url: &str, options: &ConnectOptions) -> Result<Self, HttpError> {
        let server = parse_server(url).ok_or_else(|| HttpError::Url { url: url.to_owned() })?;

        let mut headers = HeaderMap::new();
        if let Some(token) = &options.token {
            let mut bearer =
                HeaderValue::try_from(format!("Bearer {token}")).map_err(|_| HttpError::Token)?;
            bearer.set_sensitive(true);
            headers.insert(AUTHORIZATION, bearer);
        }

        let tls = match server.scheme() {
            "https" => tls::client_config(&options.root_certificates_pem),
            // Without TLS a system without root certificates must not fail.
            _ => tls::no_roots_config(),
        };
        let http = reqwest::Client::builder()
            .tls_backend_preconfigured(tls.map_err(|reason| HttpError::Tls { reason })?)
            .default_headers(headers)
            .connect_timeout(limits::HTTP_CONNECT_TIMEOUT)
            .http1_only()
            .pool_max_idle_per_host(0)
            // The protocol has no redirections: following one would send a scene to another host.
            .redirect(Policy::none())
            .no_proxy()
            .build()
            .map_err(|error| HttpError::Tls { reason: describe(error) })?;
        Ok(Self { server, http })
    }

    /// Asks the server to make a new version of a twin from uploaded files, and returns as soon as
    /// the push is queued. [`HttpClient::wait_for_push`] waits for its end.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn push(&self, twin: &str, push: &NewPush) -> Result<Push, HttpError> {
        self.request_json(Method::POST, &["v1", "twins", twin, "pushes"], Some(push)).await
    }

    /// The state of a push.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn push_status(&self, twin: &str, id: &str) -> Result<Push, HttpError> {
        let path = ["v1", "twins", twin, "pushes", id];
        self.request_json(Method::GET, &path, None::<&()>).await
    }

    /// Waits until a push is ready, refused or failed, and returns its last state. `on_state` is
    /// called with every state that the server reports, 10 times a second.
    ///
    /// # Errors
    /// The server refuses, or does not answer [`limits::HTTP_ATTEMPTS`] times in a row.
    pub async fn wait_for_push(
        &self,
        push: Push,
        on_state: &mut (dyn FnMut(&Push) + Send),
    ) -> Result<Push, HttpError> {
        let mut push = push;
        let mut unanswered = 0;
        loop {
            on_state(&push);
            if matches!(push.state, PushState::Ready | PushState::Refused | PushState::Failed) {
                return Ok(push);
            }
            tokio::time::sleep(limits::PUSH_POLL_INTERVAL).await;
            match self.push_status(&push.twin, &push.id).await {
                Ok(next) => {
                    unanswered = 0;
                    push = next;
                }
                Err(HttpError::NoAnswer { .. }) if unanswered + 1 < limits::HTTP_ATTEMPTS => {
                    unanswered += 1;
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Makes an old version of a twin the latest again, as a new version, and returns the number of
    /// the new version.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn rollback(&self, twin: &str, version: u64) -> Result<u64, HttpError> {
        #[derive(Deserialize)]
        struct RolledBack {
            version: u64,
        }
        let path = ["v1", "twins", twin, "rollback"];
        let body = Rollback { version };
        let made: RolledBack = self.request_json(Method::POST, &path, Some(&body)).await?;
        Ok(made.version)
    }

    /// Poses of a recorded drive of a version of a twin; of the latest if `version` is `None`.
    ///
    /// # Errors
    /// The server refuses, or does not answer.
    pub async fn trajectory(
        &self,
        twin: &str,
        version: Option<u64>,
        section: &DriveSection,
    ) -> Result<Drive, HttpError> {
        let DriveSection { name, from_m, to_m, every_m } = section;
        let path = ["v1", "twins", twin, "trajectories", name];
        let version = version.map(|number| ("version", number.to_string()));
        let fields = [("from_m", from_m), ("to_m", to_m), ("every_m", every_m)];
        let stations =
            fields.into_iter().filter_map(|(field, value)| Some((field, (*value)?.to_string())));
        let mut url = self.url(&path);
        url.query_pairs_mut().extend_pairs(version.into_iter().chain(stations));
        let answer = self.send(self.http.request(Method::GET, url), limits::HTTP_TIMEOUT).await?;
        serde_json::from_slice(&answer).map_err(|error| self.unreadable(&error))
    }

    /// Sends a request with an optional JSON body, and reads the JSON of the answer.
    pub(crate) async fn request_json<T: DeserializeOwned>(
        &self,
        method: Method,
        path: &[&str],
        body: Option<&impl Serialize>,
    ) -> Result<T, HttpError> {
        self.request_json_within(method, path, body, limits::HTTP_TIMEOUT).await
    }

    /// As [`HttpClient::request_json`], with another time-out.
    pub(crate) async fn request_json_within<T: DeserializeOwned>(
        &self,
        method: Method,
        path: &[&str],
        body: Option<&impl Serialize>,
        time_limit: Duration,
    ) -> Result<T, HttpError> {
        let mut request = self.request(method, path);
        if let Some(body) = body {
            let json = serde_json::to_vec(body).map_err(|error| self.unreadable(&error))?;
            request = request.header("Content-Type", "application/json").body(json);
        }
        let answer = self.send(request, time_limit).await?;
        serde_json::from_slice(&answer).map_err(|error| self.unreadable(&error))
    }

    /// A request to a path, given by its segments.
    pub(crate) fn request(&self, method: Method, path: &[&str]) -> RequestBuilder {
        self.http.request(method, self.url(path))
    }

    /// The address of a path, given by its segments.
    fn url(&self, path: &[&str]) -> Url {
        let mut url = self.server.clone();
        if let Ok(mut segments) = url.path_segments_mut() {
            // Segments are escaped one by one: a name cannot add a slash to the path.
            segments.clear().extend(path);
        }
        url
    }

    /// Sends a request and returns the body of a successful answer.
    pub(crate) async fn send(
        &self,
        request: RequestBuilder,
        time_limit: Duration,
    ) -> Result<Vec<u8>, HttpError> {
        let no_answer = |error: reqwest::Error| {
            // Connecting has a limit of its own, which is not `time_limit`.
            if error.is_timeout() && !error.is_connect() {
                self.no_answer(&format!("none within {time_limit:?}"))
            } else {
                self.no_answer(&describe(error))
            }
        };
        let mut response = request.timeout(time_limit).send().await.map_err(no_answer)?;
        let status = response.status();
        let mut body = Vec::new();
        while let Some(chunk) = response.chunk().await.map_err(no_answer)? {
            // The length that the answer announces is not trusted: it may be absent or wrong.
            if body.len() + chunk.len() > limits::HTTP_ANSWER_BYTES {
                let limit = limits::HTTP_ANSWER_BYTES;
                return Err(self.unreadable(&format!("it is larger than {limit} bytes")));
            }
            body.extend_from_slice(&chunk);
        }
        if status.is_success() { Ok(body) } else { Err(refused(status, &body)) }
    }

    pub(crate) fn no_answer(&self, reason: &dyn Display) -> HttpError {
        HttpError::NoAnswer { server: self.authority(), reason: reason.to_string() }
    }

    fn unreadable(&self, reason: &dyn Display) -> HttpError {
        HttpError::Answer { server: self.authority(), reason: reason.to_string() }
    }

    /// Host and port of the server, for messages.
    fn authority(&self) -> String {
        self.server.authority().to_owned()
    }
}

/// Hides the token, which is in the headers.
impl fmt::Debug for HttpClient {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("HttpClient").field("server", &self.server.as_str()).finish_non_exhaustive()
    }
}

/// The address of a server: a scheme, a host, perhaps a port, and nothing else.
fn parse_server(text: &str) -> Option<Url> {
    let url = Url::parse(text).ok()?;
    let is_http = matches!(url.scheme(), "http" | "https");
    let is_plain = url.path() == "/" && url.query().is_none() && url.fragment().is_none();
    let is_anonymous = url.username().is_empty() && url.password().is_none();
    (is_http && url.has_host() && is_plain && is_anonymous).then_some(url)
}

/// Describes an error with its causes: the error itself only says that a request failed.
fn describe(error: reqwest::Error) -> String {
    // The message of `no_answer` names the server already.
    let error = error.without_url();
    let mut causes = Vec::new();
    let mut source = error.source();
    while let Some(cause) = source {
        causes.push(cause.to_string());
        source = cause.source();
    }
    if causes.is_empty() { error.to_string() } else { causes.join(": ") }
}

fn refused(status: StatusCode, body: &[u8]) -> HttpError {
    let status = status.as_u16();
    match serde_json::from_slice::<Refusal>(body) {
        Ok(Refusal { code, message, cells, offset, .. }) => {
            HttpError::Refused { status, code: Some(code), message, cells, offset }
        }
        Err(_) => {
            // Not of this protocol: a proxy answers with a page, of which the beginning is enough.
            let message = String::from_utf8_lossy(&body[..body.len().min(200)]).into_owned();
            HttpError::Refused { status, code: None, message, cells: Vec::new(), offset: None }
        }
    }
}
