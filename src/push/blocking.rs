//! Work that waits for a disk or takes long, off the threads that answer requests.

use crate::error::PushError;

/// As [`wildcity_session::run_blocking`], with the errors of a push.
///
/// # Errors
/// That of `work`, or [`PushError::Crashed`] if `work` panicked.
pub(crate) async fn run_blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, PushError> + Send + 'static,
) -> Result<T, PushError> {
    wildcity_session::run_blocking(work).await.map_err(|_| PushError::Crashed)?
}
