//! The progress of a push.

use std::sync::Arc;

use parking_lot::Mutex;
use tokio::sync::Notify;

use wildcity_twin::ingest::StopFlag;

use crate::error::PushError;
use crate::report::PushReport;

/// The stage of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Waiting for earlier pushes.
    Queued,
    /// Its files are read.
    Ingesting,
    /// Its content is compared with the twin.
    Validating,
    /// The version is written.
    Committing,
    /// The version is loaded into memory for the sessions that may switch to it.
    Prefetching,
    /// The version is the latest.
    Ready,
    /// The content cannot be accepted.
    Refused,
    /// The server could not carry it out.
    Failed,
}

impl State {
    /// Whether a push in this state waits or runs.
    fn is_open(self) -> bool {
        match self {
            Self::Queued
            | Self::Ingesting
            | Self::Validating
            | Self::Committing
            | Self::Prefetching => true,
            Self::Ready | Self::Refused | Self::Failed => false,
        }
    }
}

/// Work done within a state. The unit is bytes while files are read, else poses or Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    pub done: u64,
    /// All work of the state; 0 if unknown.
    pub total: u64,
}

/// The version that a push made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PushedVersion {
    /// Number of the version.
    pub number: u64,
    /// BLAKE3 of its manifest, in hex.
    pub hash: String,
}

/// The state of a push, as it is reported to clients.
#[derive(Clone, Debug)]
pub struct Status {
    pub state: State,
    /// Progress within the stage.
    pub progress: Progress,
    /// The version, once it is ready.
    pub version: Option<PushedVersion>,
    /// Contents of the files; `None` until they are read.
    pub report: Option<Arc<PushReport>>,
    /// Why it was refused or failed.
    pub error: Option<Arc<PushError>>,
}

/// A push from its request to its end, as its threads and the clients that poll it share it.
pub struct Push {
    request_hash: blake3::Hash,
    /// Counts the pushes of a queue: the oldest is forgotten first.
    number: u64,
    status: Mutex<Status>,
    /// Stops the threads that read its files.
    stop: StopFlag,
    cancelled: Notify,
}

impl Push {
    pub(crate) fn new(request_hash: blake3::Hash, number: u64) -> Self {
        let status = Status {
            state: State::Queued,
            progress: Progress::default(),
            version: None,
            report: None,
            error: None,
        };
        Self {
            request_hash,
            number,
            status: Mutex::new(status),
            stop: StopFlag::default(),
            cancelled: Notify::new(),
        }
    }

    pub(crate) fn request_hash(&self) -> blake3::Hash {
        self.request_hash
    }

    pub(crate) fn number(&self) -> u64 {
        self.number
    }

    /// A copy of the status at this moment.
    pub fn status(&self) -> Status {
        self.status.lock().clone()
    }

    /// Whether the push waits or runs.
    pub fn is_open(&self) -> bool {
        self.status.lock().state.is_open()
    }

    /// Cancels the push: it ends with [`PushError::Cancelled`], and nothing of it is visible.
    ///
    /// # Errors
    /// Says why it is too late: its version is being written, or it has ended.
    pub fn cancel(&self) -> Result<(), &'static str> {
        let mut status = self.status.lock();
        match status.state {
            State::Queued | State::Ingesting | State::Validating => {}
            State::Committing | State::Prefetching => return Err("is being published"),
            State::Ready | State::Refused | State::Failed => return Err("has ended"),
        }
        status.state = State::Failed;
        status.error = Some(Arc::new(PushError::Cancelled));
        // The waiter may lock the status at once.
        drop(status);
        // Before the reading ends because of it.
        self.cancelled.notify_one();
        self.stop.stop();
        Ok(())
    }

    /// Returns when the push is cancelled.
    pub async fn cancelled(&self) {
        // `notify_one` stores a permit, so a cancellation before this call is not lost. There is
        // one waiter for each push.
        self.cancelled.notified().await;
    }

    /// Reason for which the push ends: its cancellation if it was cancelled, because this also ends
    /// the reading with an error.
    pub(crate) fn cause(&self, error: PushError) -> PushError {
        let status = self.status.lock();
        match status.error.as_deref() {
            Some(PushError::Cancelled) => PushError::Cancelled,
            _ => error,
        }
    }

    /// Stops the threads that read the push's files.
    pub(crate) fn stop_flag(&self) -> &StopFlag {
        &self.stop
    }

    /// Ends the push, unless it was cancelled before. An error that is a refusal gives
    /// [`State::Refused`], any other [`State::Failed`]. Returns the state.
    pub fn end(&self, result: Result<PushedVersion, PushError>) -> State {
        let mut status = self.status.lock();
        // A push ends once. What comes later, such as the error of a reader that was stopped, is
        // dropped.
        if !status.state.is_open() {
            return status.state;
        }
        match result {
            Ok(version) => {
                status.state = State::Ready;
                status.version = Some(version);
            }
            Err(error) => {
                status.state = if error.is_refusal() { State::Refused } else { State::Failed };
                status.error = Some(Arc::new(error));
            }
        }
        status.state
    }

    /// Ends a push whose result is reported elsewhere, unless it was cancelled before. Returns the
    /// state.
    pub fn close(&self, result: Result<(), &PushError>) -> State {
        let mut status = self.status.lock();
        if status.state.is_open() {
            // The caller owns the error and answers with it, so only the state is kept here.
            status.state = match result {
                Ok(()) => State::Ready,
                Err(error) if error.is_refusal() => State::Refused,
                Err(_) => State::Failed,
            };
        }
        status.state
    }

    /// Enters a state, at its beginning.
    ///
    /// # Errors
    /// [`PushError::Cancelled`] if the push was cancelled meanwhile.
    pub(crate) fn enter(&self, state: State) -> Result<(), PushError> {
        let mut status = self.status.lock();
        if !status.state.is_open() {
            return Err(PushError::Cancelled);
        }
        status.state = state;
        status.progress = Progress::default();
        Ok(())
    }

    pub(crate) fn set_progress(&self, done: u64, total: u64) {
        self.status.lock().progress = Progress { done, total };
    }

    pub(crate) fn set_report(&self, report: PushReport) {
        self.status.lock().report = Some(Arc::new(report));
    }
}
