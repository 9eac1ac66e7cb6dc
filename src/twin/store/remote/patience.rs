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
pub struct Patience {
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

impl Patience {
    /// With what a step waits for, and with what tells how large something is.
    pub(super) fn of_sections(self) -> Self {
        Self { timeout: self.section_timeout, tries: self.section_tries, ..self }
    }
}

impl Default for Patience {
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
pub(super) enum Counted {
    Request,
    Retry,
    Failure,
}

/// Threads that requests run on, so that any thread may wait for one, even one of another runtime.
#[derive(Debug)]
pub(super) struct Runner {
    /// Taken when it is dropped.
    runtime: Option<Runtime>,
    patience: Patience,
    counts: Arc<[AtomicU64; 3]>,
}

/// A request that runs.
#[derive(Debug)]
pub(super) struct Running<T>(Receiver<io::Result<T>>);

impl Runner {
    pub(super) fn new(patience: Patience) -> io::Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(limits::REMOTE_THREADS)
            .thread_name("store")
            .enable_all()
            .build()?;
        Ok(Self { runtime: Some(runtime), patience, counts: Arc::default() })
    }

    pub(super) fn patience(&self) -> Patience {
        self.patience
    }

    pub(super) fn count(&self, what: Counted) {
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
        self.start(self.patience, request).wait()
    }

    /// As [`Runner::run`], with a patience of its own and without waiting for it.
    pub(super) fn start<T, F>(
        &self,
        patience: Patience,
        request: impl Fn() -> F + Send + 'static,
    ) -> Running<T>
    where
        T: Send + 'static,
        F: Future<Output = object_store::Result<T>> + Send,
    {
        let counts = self.counts.clone();
        self.spawn(async move {
            let (mut tries, mut backoff) = (1, patience.backoff);
            loop {
                let error = match once(patience, &counts, request()).await {
                    Ok(done) => return Ok(done),
                    Err(error) => error,
                };
                let passes = matches!(error.kind(), ErrorKind::Other | ErrorKind::TimedOut);
                if !passes || tries >= patience.tries {
                    if error.kind() != ErrorKind::NotFound {
                        add(&counts, Counted::Failure);
                    }
                    return Err(error);
                }
                add(&counts, Counted::Retry);
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
        let (patience, counts) = (self.patience, self.counts.clone());
        self.spawn(async move { once(patience, &counts, request).await }).wait()
    }

    fn spawn<T: Send + 'static>(
        &self,
        request: impl Future<Output = io::Result<T>> + Send + 'static,
    ) -> Running<T> {
        let (send, receive) = mpsc::sync_channel(1);
        if let Some(runtime) = &self.runtime {
            runtime.spawn(async move {
                // Nobody waits any more for what was given up.
                let _ = send.send(request.await);
            });
        }
        Running(receive)
    }
}

impl<T> Running<T> {
    /// Waits for its end. A plain channel, and not `block_on`, which panics on threads of a runtime.
    pub(super) fn wait(self) -> io::Result<T> {
        self.0.recv().unwrap_or_else(|_| Err(io::Error::other("the store's threads are gone")))
    }
}

impl Drop for Runner {
    /// Without waiting, which would panic on threads of a runtime.
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

async fn once<T>(
    patience: Patience,
    counts: &[AtomicU64; 3],
    request: impl Future<Output = object_store::Result<T>>,
) -> io::Result<T> {
    add(counts, Counted::Request);
    match tokio::time::timeout(patience.timeout, request).await {
        Ok(done) => done.map_err(|error| to_io(&error)),
        Err(_) => {
            let said = format!("no answer within {} s", patience.timeout.as_secs_f32());
            Err(io::Error::new(ErrorKind::TimedOut, said))
        }
    }
}

fn add(counts: &[AtomicU64; 3], what: Counted) {
    counts[what as usize].fetch_add(1, Ordering::Relaxed);
}
