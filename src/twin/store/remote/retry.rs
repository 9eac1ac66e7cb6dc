//! Requests run on threads of their own, each with a time-out and a bounded number of retries. This
//! is the only place where requests are timed and retried: `object_store`'s own retries are off.
//!
//! The calling thread waits on a channel, because `block_on` panics on threads of another runtime.

use std::io::{self, ErrorKind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver};
use std::time::Duration;

use tokio::runtime::{Builder, Runtime};

use crate::limits;
use crate::store::object_access::Traffic;

/// Time-outs, retries and threads of requests to an object store.
#[derive(Clone, Copy, Debug)]
pub struct RetryPolicy {
    /// How long one request may take, including its bytes.
    pub timeout: Duration,
    /// The most attempts of one request.
    pub tries: u32,
    /// Pause before the second attempt; it doubles before each further one. With none, no other
    /// request comes in between.
    pub backoff: Duration,
    /// How long one request for a section may take. Steps wait for these.
    pub section_timeout: Duration,
    /// The most attempts of a request for a section.
    pub section_tries: u32,
    /// Number of threads that wait for answers. On one thread, requests are sent in the order in
    /// which they begin.
    pub threads: usize,
}

impl RetryPolicy {
    /// The policy of requests that a step waits for, and of requests for the size of an object.
    pub(super) fn for_sections(self) -> Self {
        Self { timeout: self.section_timeout, tries: self.section_tries, ..self }
    }
}

impl Default for RetryPolicy {
    fn default() -> Self {
        Self {
            timeout: limits::REMOTE_TIMEOUT,
            tries: limits::REMOTE_TRIES,
            backoff: limits::REMOTE_BACKOFF,
            section_timeout: limits::SECTION_TIMEOUT,
            section_tries: limits::SECTION_TRIES,
            threads: limits::REMOTE_THREADS,
        }
    }
}

/// A counter of [`Traffic`], as an index.
#[derive(Clone, Copy, Debug)]
pub(super) enum RequestCounter {
    Request,
    Retry,
    Failure,
}

/// The threads on which requests run. Any thread may wait for a request, even one of another
/// runtime.
#[derive(Debug)]
pub(super) struct RequestRunner {
    /// `None` only while this is dropped.
    runtime: Option<Runtime>,
    retry: RetryPolicy,
    counts: Arc<[AtomicU64; 3]>,
}

/// A request that is running.
#[derive(Debug)]
pub(super) struct PendingRequest<T>(Receiver<io::Result<T>>);

impl RequestRunner {
    pub(super) fn new(retry: RetryPolicy) -> io::Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(retry.threads)
            .thread_name("store")
            .enable_all()
            .build()?;
        Ok(Self { runtime: Some(runtime), retry, counts: Arc::default() })
    }

    pub(super) fn retry(&self) -> RetryPolicy {
        self.retry
    }

    pub(super) fn count(&self, what: RequestCounter) {
        add(&self.counts, what);
    }

    pub(super) fn traffic(&self) -> Traffic {
        // Relaxed, because the counts are only reported and order no other memory.
        let [requests, retries, failures] =
            [0, 1, 2].map(|i: usize| self.counts[i].load(Ordering::Relaxed));
        Traffic { requests, retries, failures, ..Traffic::default() }
    }

    /// Makes a request until it succeeds, fails with an error that retrying cannot change, or has
    /// had all attempts. Only for idempotent requests.
    pub(super) fn run<T, F>(&self, request: impl Fn() -> F + Send + 'static) -> io::Result<T>
    where
        T: Send + 'static,
        F: Future<Output = object_store::Result<T>> + Send,
    {
        self.start(self.retry, request).wait()
    }

    /// As [`RequestRunner::run`], with another policy, and without waiting for the result.
    pub(super) fn start<T, F>(
        &self,
        retry: RetryPolicy,
        request: impl Fn() -> F + Send + 'static,
    ) -> PendingRequest<T>
    where
        T: Send + 'static,
        F: Future<Output = object_store::Result<T>> + Send,
    {
        let counts = self.counts.clone();
        self.spawn(async move {
            let mut tries = 1;
            let mut backoff = retry.backoff;
            loop {
                let error = match once(retry, &counts, request()).await {
                    Ok(done) => return Ok(done),
                    Err(error) => error,
                };
                // Only what another attempt may cure. A missing object or a lack of rights stays as
                // it is.
                let is_transient = matches!(error.kind(), ErrorKind::Other | ErrorKind::TimedOut);
                if !is_transient || tries >= retry.tries {
                    // That an object is missing is an answer.
                    if error.kind() != ErrorKind::NotFound {
                        add(&counts, RequestCounter::Failure);
                    }
                    return Err(error);
                }
                add(&counts, RequestCounter::Retry);
                if !backoff.is_zero() {
                    tokio::time::sleep(backoff).await;
                }
                tries += 1;
                // Pauses of b, 2 b, 4 b, 8 b: 15 b for five attempts.
                backoff = backoff.saturating_mul(2);
            }
        })
    }

    /// Makes a request once, and waits for the result.
    pub(super) fn once<T, F>(&self, request: F) -> io::Result<T>
    where
        T: Send + 'static,
        F: Future<Output = object_store::Result<T>> + Send + 'static,
    {
        let retry = self.retry;
        let counts = self.counts.clone();
        self.spawn(async move { once(retry, &counts, request).await }).wait()
    }

    fn spawn<T: Send + 'static>(
        &self,
        request: impl Future<Output = io::Result<T>> + Send + 'static,
    ) -> PendingRequest<T> {
        // Room for one result, so that the task never waits for the caller.
        let (send, receive) = mpsc::sync_channel(1);
        // There is one until the drop. Without it, the dropped sender makes `wait` fail.
        if let Some(runtime) = &self.runtime {
            runtime.spawn(async move {
                // Sending fails if the caller no longer waits.
                let _ = send.send(request.await);
            });
        }
        PendingRequest(receive)
    }
}

impl<T> PendingRequest<T> {
    /// Waits for the result.
    pub(super) fn wait(self) -> io::Result<T> {
        self.0.recv().unwrap_or_else(|_| Err(io::Error::other("the store's threads are gone")))
    }
}

impl Drop for RequestRunner {
    /// Does not wait for running requests: that would panic on threads of a runtime.
    fn drop(&mut self) {
        // Taken out, because shutting it down needs it by value.
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

async fn once<T>(
    retry: RetryPolicy,
    counts: &[AtomicU64; 3],
    request: impl Future<Output = object_store::Result<T>>,
) -> io::Result<T> {
    add(counts, RequestCounter::Request);
    match tokio::time::timeout(retry.timeout, request).await {
        Ok(done) => done.map_err(|error| to_io(&error)),
        Err(_) => {
            let said = format!("no answer within {} s", retry.timeout.as_secs_f32());
            Err(io::Error::new(ErrorKind::TimedOut, said))
        }
    }
}

fn add(counts: &[AtomicU64; 3], what: RequestCounter) {
    counts[what as usize].fetch_add(1, Ordering::Relaxed);
}

/// The kind of an error, as one of the operating system's.
fn to_io(error: &object_store::Error) -> io::Error {
    use object_store::Error;
    let kind = match error {
        Error::NotFound { .. } => ErrorKind::NotFound,
        // Some stores answer a conditional put in this way, others in that.
        Error::AlreadyExists { .. } | Error::Precondition { .. } => ErrorKind::AlreadyExists,
        Error::PermissionDenied { .. } | Error::Unauthenticated { .. } => {
            ErrorKind::PermissionDenied
        }
        // All else may be transient: a lost connection, an overloaded store.
        _ => ErrorKind::Other,
    };
    // The last cause names the reason; reqwest's own texts leave it out.
    let mut said = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(next) = cause {
        let text = next.to_string();
        if !said.contains(&text) {
            said = format!("{said}: {text}");
        }
        cause = next.source();
    }
    io::Error::new(kind, said)
}
