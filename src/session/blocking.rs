//! Work that waits for a disk or takes long, off the threads that answer requests.

use crate::error::SessionError;

/// Runs `work` on one of tokio's blocking threads and waits for its result.
///
/// # Errors
/// [`SessionError::Crashed`] if `work` panicked.
pub(crate) async fn run_blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, SessionError> {
    tokio::task::spawn_blocking(work).await.map_err(|_| SessionError::Crashed)
}
