//! Runs blocking work on threads of its own, so that it does not delay asynchronous tasks.

use bytes::Bytes;

use crate::fault::Fault;
use crate::limits;

/// Runs work that may wait for a disk, and returns its result.
pub(crate) async fn blocking<T, F>(
    work: impl FnOnce() -> Result<T, F> + Send + 'static,
) -> Result<T, Fault>
where
    T: Send + 'static,
    F: Into<Fault> + Send + 'static,
{
    let done = wildcity_session::run_blocking(work)
        .await
        .map_err(|_| Fault::Internal("a task crashed; the server's log says where".to_owned()))?;
    done.map_err(Into::into)
}

/// Parses the body of a request; a long one on a thread that may block.
pub(crate) async fn parsed<T: Send + 'static>(
    body: Bytes,
    parse: impl FnOnce(&[u8]) -> Result<T, Fault> + Send + 'static,
) -> Result<T, Fault> {
    if body.len() <= limits::INLINE_REQUEST_BYTES {
        return parse(&body);
    }
    blocking(move || parse(&body)).await
}
