//! Waiting for the sections that a frame needs.

use std::sync::Arc;

use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use wildcity_scene::RenderProfile;
use wildcity_twin::residency::{PinnedScene, Resident, Viewpoint};

use crate::blocking::run_blocking;
use crate::error::SessionError;

/// Waits until all sections that a frame needs are in memory, and pins them.
///
/// # Errors
/// They are not there by the deadline, cannot be loaded, or do not fit.
pub(crate) async fn pin(
    resident: Arc<Resident>,
    profile: RenderProfile,
    deadline: Instant,
    viewpoints: Vec<Viewpoint>,
) -> Result<PinnedScene, SessionError> {
    let (reply, answer) = oneshot::channel();
    let request = run_blocking(move || {
        let done = Box::new(move |pinned| {
            // Sending fails if the deadline has passed and the receiver is gone.
            let _ = reply.send(pinned);
        });
        resident.request(&viewpoints, &profile, done)
    });
    // Dropping the request takes the frame out of the pager's queue.
    let request = request.await??;
    match timeout_at(deadline, answer).await {
        Ok(Ok(pinned)) => Ok(pinned?),
        Ok(Err(_)) => Err(SessionError::Crashed),
        Err(_) => Err(request.timeout_error().into()),
    }
}
