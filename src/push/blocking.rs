//! Work that waits for a disk or takes long, off the threads that answer requests.

use crate::error::PushError;

/// Runs `work` on one of tokio's blocking threads and waits for its result.
///
/// # Errors
/// That of `work`, or [`PushError::Crashed`] if `work` panicked.
pub(crate) async fn run_blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, PushError> + Send + 'static,
) -> Result<T, PushError> {
    tokio::task::spawn_blocking(work).await.map_err(|_| PushError::Crashed)?
}
