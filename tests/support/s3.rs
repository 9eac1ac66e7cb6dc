//! An S3 server on loopback with configurable faults.
//!
//! The server is s3s-fs, within the process of the tests, so that neither Python nor a download is
//! needed. It honours `If-None-Match`, but does not put atomically if absent: puts are serialised
//! here.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use http_body_util::BodyExt as _;
use hyper::body::Incoming;
use hyper::header::{CONTENT_LENGTH, HeaderValue, LOCATION};
use hyper::{Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use object_store::aws::AmazonS3Builder;
use object_store::{ObjectStore, RetryConfig};
use s3s::auth::SimpleAuth;
use s3s::service::{S3Service, S3ServiceBuilder};
use wildcity_twin::store::{Catalog, DiskCacheSettings, RetryPolicy, StoreError};

const KEYS: [&str; 2] = ["test", "secret"];
const BUCKET: &str = "bucket";

/// A fault that a request encounters.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Fault {
    /// The request is answered with this status and not executed.
    Status(u16),
    /// The request is executed, but the connection breaks before the answer.
    AnswerLost,
    /// The request is executed, but answered with this status.
    Denied(u16),
    /// The request is neither executed nor answered.
    Silence,
    /// The request is redirected to the same path on a port of this machine.
    Redirected(u16),
    /// The answer is truncated in the middle.
    Short,
    /// One bit of the answer is flipped.
    Flipped,
}

#[derive(Clone, Debug)]
struct Rule {
    method: &'static str,
    path: String,
    times: usize,
    fault: Fault,
}

/// A running server and the folder of its buckets.
pub(crate) struct S3 {
    pub(crate) dir: tempfile::TempDir,
    port: u16,
    rules: Arc<Mutex<Vec<Rule>>>,
    _runtime: tokio::runtime::Runtime,
}

impl S3 {
    pub(crate) fn start() -> Self {
        // Another test may have installed a provider before.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join(BUCKET)).unwrap();
        let mut builder = S3ServiceBuilder::new(s3s_fs::FileSystem::new(dir.path()).unwrap());
        builder.set_auth(SimpleAuth::from_single(KEYS[0], KEYS[1]));
        let service = builder.build();
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
        let port = listener.local_addr().unwrap().port();
        let rules: Arc<Mutex<Vec<Rule>>> = Arc::default();
        runtime.spawn(serve(listener, service, rules.clone()));
        Self { dir, port, rules, _runtime: runtime }
    }

    /// The next requests of this kind fail.
    pub(crate) fn fail(&self, method: &'static str, path: &str, times: usize, fault: Fault) {
        let rule = Rule { method, path: path.to_owned(), times, fault };
        self.rules.lock().unwrap().push(rule);
    }

    /// No request fails any more.
    pub(crate) fn forgive(&self) {
        self.rules.lock().unwrap().clear();
    }

    /// How many requests are still to fail.
    pub(crate) fn to_fail(&self) -> usize {
        self.rules.lock().unwrap().iter().map(|rule| rule.times).sum()
    }

    pub(crate) fn url() -> String {
        format!("s3://{BUCKET}/twins")
    }

    /// Where the twins' keys are, as files.
    pub(crate) fn twins(&self) -> PathBuf {
        self.dir.path().join(BUCKET).join("twins")
    }

    pub(crate) fn store(&self) -> Arc<dyn ObjectStore> {
        let store = AmazonS3Builder::new()
            .with_endpoint(format!("http://127.0.0.1:{}", self.port))
            .with_allow_http(true)
            .with_region("here")
            .with_bucket_name(BUCKET)
            .with_access_key_id(KEYS[0])
            .with_secret_access_key(KEYS[1])
            .with_retry(RetryConfig { max_retries: 0, ..RetryConfig::default() })
            .build();
        Arc::new(store.unwrap())
    }

    pub(crate) fn catalog(&self) -> Catalog {
        self.cached(None).unwrap()
    }

    pub(crate) fn cached(&self, cache: Option<&DiskCacheSettings>) -> Result<Catalog, StoreError> {
        Catalog::over(self.store(), &Self::url(), "twins", cache, quick())
    }

    /// Sets the environment variables with which a process finds the server.
    pub(crate) fn environment<'a>(&self, command: &'a mut Command) -> &'a mut Command {
        command
            .env("AWS_ENDPOINT", format!("http://127.0.0.1:{}", self.port))
            .env("AWS_ALLOW_HTTP", "true")
            .env("AWS_REGION", "here")
            .env("AWS_ACCESS_KEY_ID", KEYS[0])
            .env("AWS_SECRET_ACCESS_KEY", KEYS[1])
    }
}

/// Short time-outs and few retries, for tests.
pub(crate) fn quick() -> RetryPolicy {
    let (timeout, backoff) = (Duration::from_secs(3), Duration::from_millis(10));
    RetryPolicy {
        timeout,
        tries: 3,
        backoff,
        section_timeout: timeout,
        section_tries: 3,
        ..RetryPolicy::default()
    }
}

/// All files below a folder that are objects of the server, without the server's own metadata
/// files.
pub(crate) fn keys(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(keys(&path));
        } else if !path.file_name().unwrap().to_str().unwrap().starts_with('.') {
            found.push(path);
        }
    }
    found.sort();
    found
}

async fn serve(listener: tokio::net::TcpListener, s3: S3Service, rules: Arc<Mutex<Vec<Rule>>>) {
    let turns = Arc::new(tokio::sync::Mutex::new(()));
    loop {
        let Ok((stream, _)) = listener.accept().await else { return };
        let (s3, rules, turns) = (s3.clone(), rules.clone(), turns.clone());
        let answer = hyper::service::service_fn(move |request: Request<Incoming>| {
            let (s3, turns) = (s3.clone(), turns.clone());
            let fault = fault(&rules, &request);
            async move {
                match fault {
                    Some(Fault::Status(status)) => return Ok(plain(status)),
                    Some(Fault::Redirected(port)) => {
                        let place = format!("http://127.0.0.1:{port}{}", request.uri());
                        let mut answer = plain(307);
                        answer.headers_mut().insert(LOCATION, place.parse().unwrap());
                        return Ok(answer);
                    }
                    Some(Fault::Silence) => std::future::pending::<()>().await,
                    _ => {}
                }
                let is_put = request.method() == hyper::Method::PUT;
                let turn = if is_put { Some(turns.lock().await) } else { None };
                let answer = s3.call(request.map(s3s::Body::from)).await;
                drop(turn);
                let answer = answer.map_err(|error| format!("{error:?}"))?;
                match fault {
                    Some(Fault::AnswerLost) => Err("told to".to_owned()),
                    Some(Fault::Denied(status)) => Ok(plain(status)),
                    Some(Fault::Short) => Ok(changed(answer, |bytes| {
                        bytes.truncate(bytes.len() / 2);
                    })
                    .await),
                    Some(Fault::Flipped) => Ok(changed(answer, |bytes| {
                        let middle = bytes.len() / 2;
                        bytes[middle] ^= 1;
                    })
                    .await),
                    _ => Ok(answer),
                }
            }
        });
        tokio::spawn(async move {
            let connection = hyper::server::conn::http1::Builder::new();
            // A client that went away, or an answer that was to be lost.
            let _ = connection.serve_connection(TokioIo::new(stream), answer).await;
        });
    }
}

fn fault(rules: &Mutex<Vec<Rule>>, request: &Request<Incoming>) -> Option<Fault> {
    let mut rules = rules.lock().unwrap();
    let path = request.uri().to_string();
    let rule = rules.iter_mut().find(|rule| {
        rule.times > 0 && rule.method == request.method().as_str() && path.contains(&rule.path)
    })?;
    rule.times -= 1;
    Some(rule.fault)
}

fn plain(status: u16) -> Response<s3s::Body> {
    let mut answer = Response::new(s3s::Body::empty());
    *answer.status_mut() = StatusCode::from_u16(status).unwrap();
    answer
}

/// The answer with other bytes, and the length that it had.
async fn changed(
    answer: Response<s3s::Body>,
    change: impl Fn(&mut Vec<u8>),
) -> Response<s3s::Body> {
    let (mut parts, body) = answer.into_parts();
    let mut bytes = Vec::from(body.collect().await.unwrap().to_bytes());
    parts.headers.insert(CONTENT_LENGTH, HeaderValue::from(bytes.len()));
    change(&mut bytes);
    // In one piece and with its length left as it was: hyper breaks the connection after too few.
    Response::from_parts(parts, s3s::Body::http_body_unsync(http_body_util::Full::from(bytes)))
}
