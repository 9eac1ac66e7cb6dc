//! Work that waits for a disk or takes long, off the threads that answer requests.

use tokio::runtime::{Handle, RuntimeFlavor};
use tracing::Span;

use crate::error::SessionError;

/// Runs `work` on one of tokio's blocking threads, within the current span, and waits for its result.
///
/// # Errors
/// [`SessionError::Crashed`] if `work` panicked.
pub(crate) async fn run_blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, SessionError> {
    let span = Span::current();
    tokio::task::spawn_blocking(move || span.in_scope(work))
        .await
        .map_err(|_| SessionError::Crashed)
}

/// Runs `work` on this thread: for work of microseconds that may have to wait for a disk. Two changes of threads would
/// take longer than the work does. If it does wait, another thread takes over the other tasks of this one; only a
/// runtime of a single thread has none.
pub(crate) fn run_in_place<T>(work: impl FnOnce() -> T) -> T {
    match Handle::current().runtime_flavor() {
        RuntimeFlavor::CurrentThread => work(),
        _ => tokio::task::block_in_place(work),
    }
}
