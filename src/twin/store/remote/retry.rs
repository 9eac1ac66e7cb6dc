//! Requests run on threads of their own, each with a time-out, and again a bounded number of times.

use std::io::{self, ErrorKind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc;
use std::sync::{Arc, mpsc::Receiver};
use std::time::Duration;

use tokio::runtime::{Builder, Runtime};

use crate::limits;

use super::to_io;

/// How long a store is waited for.
#[derive(Clone, Copy, Debug)]
pub struct RetryPolicy {
    /// How long one request may take, its bytes included.
    pub timeout: Duration,
    /// How often a request is made, at most.
    pub tries: u32,
    /// How long to wait before the second try; twice as long before each further one.
    pub backoff: Duration,
    /// How long one request for a section may take, which a step waits for.
    pub section_timeout: Duration,
    /// How often such a request is made, at most.
    pub section_tries: u32,
}

impl RetryPolicy {
    /// With what a step waits for, and with what tells how large something is.
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
        }
    }
}

/// What was asked of a store since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Requests, each try for itself.
    pub requests: u64,
    /// Requests that were made again.
    pub retries: u64,
    /// Requests that failed for good; not being there is no failure.
    pub failures: u64,
    /// Parts that the disk cache had.
    pub cache_hits: u64,
    /// Parts that it did not have.
    pub cache_misses: u64,
}

/// What is counted.
#[derive(Clone, Copy, Debug)]
pub(super) enum RequestCounter {
    Request,
    Retry,
    Failure,
}

/// Threads that requests run on, so that any thread may wait for one, even one of another runtime.
#[derive(Debug)]
pub(super) struct RequestRunner {
    /// Taken when it is dropped.
    runtime: Option<Runtime>,
    retry: RetryPolicy,
    counts: Arc<[AtomicU64; 3]>,
}

/// A request that runs.
#[derive(Debug)]
pub(super) struct PendingRequest<T>(Receiver<io::Result<T>>);

impl RequestRunner {
    pub(super) fn new(retry: RetryPolicy) -> io::Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(limits::REMOTE_THREADS)
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
        let [requests, retries, failures] =
            [0, 1, 2].map(|i: usize| self.counts[i].load(Ordering::Relaxed));
        Traffic { requests, retries, failures, ..Traffic::default() }
    }

    /// Makes a request until it succeeds, fails for good, or was made often enough. Only what may be
    /// done twice may be made so.
    pub(super) fn run<T, F>(&self, request: impl Fn() -> F + Send + 'static) -> io::Result<T>
    where
        T: Send + 'static,
        F: Future<Output = object_store::Result<T>> + Send,
    {
        self.start(self.retry, request).wait()
    }

    /// As [`RequestRunner::run`], with a retry of its own and without waiting for it.
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
            let (mut tries, mut backoff) = (1, retry.backoff);
            loop {
                let error = match once(retry, &counts, request()).await {
                    Ok(done) => return Ok(done),
                    Err(error) => error,
                };
                let passes = matches!(error.kind(), ErrorKind::Other | ErrorKind::TimedOut);
                if !passes || tries >= retry.tries {
                    if error.kind() != ErrorKind::NotFound {
                        add(&counts, RequestCounter::Failure);
                    }
                    return Err(error);
                }
                add(&counts, RequestCounter::Retry);
                tokio::time::sleep(backoff).await;
                (tries, backoff) = (tries + 1, backoff.saturating_mul(2));
            }
        })
    }

    /// Makes a request once.
    pub(super) fn once<T, F>(&self, request: F) -> io::Result<T>
    where
        T: Send + 'static,
        F: Future<Output = object_store::Result<T>> + Send + 'static,
    {
        let (retry, counts) = (self.retry, self.counts.clone());
        self.spawn(async move { once(retry, &counts, request).await }).wait()
    }

    fn spawn<T: Send + 'static>(
        &self,
        request: impl Future<Output = io::Result<T>> + Send + 'static,
    ) -> PendingRequest<T> {
        let (send, receive) = mpsc::sync_channel(1);
        if let Some(runtime) = &self.runtime {
            runtime.spawn(async move {
                // Nobody waits any more for what was given up.
                let _ = send.send(request.await);
            });
        }
        PendingRequest(receive)
    }
}

impl<T> PendingRequest<T> {
    /// Waits for its end. A plain channel, and not `block_on`, which panics on threads of a runtime.
    pub(super) fn wait(self) -> io::Result<T> {
        self.0.recv().unwrap_or_else(|_| Err(io::Error::other("the store's threads are gone")))
    }
}

impl Drop for RequestRunner {
    /// Without waiting, which would panic on threads of a runtime.
    fn drop(&mut self) {
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
