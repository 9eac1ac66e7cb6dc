//! Work that waits for a disk or takes long, off the threads that answer requests.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio::time::{Instant, timeout_at};
use tracing::Span;

use crate::error::SessionError;

/// Tells work on another thread when its result is of no use any more: its deadline has passed, or
/// the request that it is for was dropped because its client left.
#[derive(Clone, Debug)]
pub(crate) struct Stop {
    is_dropped: Arc<AtomicBool>,
    deadline: Instant,
}

impl Stop {
    /// Breaks the work off if its result is of no use. Long work asks at least each millisecond.
    pub(crate) fn check(&self) -> ControlFlow<()> {
        let is_over = self.is_dropped.load(Ordering::Relaxed) || Instant::now() >= self.deadline;
        if is_over { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    /// As [`Self::check`], as an error of a request.
    ///
    /// # Errors
    /// [`SessionError::DeadlineExceeded`].
    pub(crate) fn refusal(&self) -> Result<(), SessionError> {
        match self.check() {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(SessionError::DeadlineExceeded),
        }
    }
}

/// Stops the work of a request that is dropped.
struct StopOnDrop(Arc<AtomicBool>);

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// As [`run_blocking`], until a deadline. The work gets a [`Stop`], and has to ask it.
///
/// # Errors
/// [`SessionError::DeadlineExceeded`], or as [`run_blocking`].
pub(crate) async fn run_until<T: Send + 'static>(
    deadline: Instant,
    work: impl FnOnce(&Stop) -> Result<T, SessionError> + Send + 'static,
) -> Result<T, SessionError> {
    let is_dropped = Arc::new(AtomicBool::new(false));
    // Also when this future is dropped while it waits.
    let _stop = StopOnDrop(is_dropped.clone());
    let stop = Stop { is_dropped, deadline };
    let done = timeout_at(deadline, run_blocking(move || work(&stop))).await;
    done.map_err(|_| SessionError::DeadlineExceeded)??
}

/// Runs `work` on one of tokio's blocking threads, within the current span, and waits for its
/// result.
///
/// # Errors
/// [`SessionError::Crashed`] if `work` panicked.
pub async fn run_blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, SessionError> {
    // A span belongs to its thread, so that the closure takes it along.
    let span = Span::current();
    tokio::task::spawn_blocking(move || span.in_scope(work))
        .await
        // Blocking tasks are not cancelled here: an error of the handle is a panic.
        .map_err(|_| SessionError::Crashed)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;
    use std::time::Duration;

    use super::*;

    /// Work that goes on until it is stopped, and then says so.
    fn endless(ended: mpsc::Sender<()>) -> impl FnOnce(&Stop) -> Result<(), SessionError> {
        move |stop| {
            while stop.check().is_continue() {
                std::thread::sleep(Duration::from_millis(1));
            }
            let _gone = ended.send(());
            stop.refusal()
        }
    }

    #[tokio::test]
    async fn work_ends_at_its_deadline() {
        let (ended, has_ended) = mpsc::channel();
        let deadline = Instant::now() + Duration::from_millis(20);
        let result = run_until(deadline, endless(ended)).await;
        assert!(matches!(result, Err(SessionError::DeadlineExceeded)), "{result:?}");
        has_ended.recv_timeout(Duration::from_secs(10)).unwrap();
    }

    #[tokio::test]
    async fn work_ends_when_its_request_is_dropped() {
        let (ended, has_ended) = mpsc::channel();
        let deadline = Instant::now() + Duration::from_secs(3600);
        let request = run_until(deadline, endless(ended));
        let dropped = tokio::time::timeout(Duration::from_millis(20), request).await;
        assert!(dropped.is_err(), "it has no end of its own");
        has_ended.recv_timeout(Duration::from_secs(10)).unwrap();
    }
}
