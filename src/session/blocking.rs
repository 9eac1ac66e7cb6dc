//! Work that waits for a disk or takes long, off the threads that answer requests.

use tracing::Span;

use crate::error::SessionError;

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
