//! Waiting for the sections that a frame needs.

use std::sync::Arc;

use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use wildcity_scene::RenderProfile;
use wildcity_twin::residency::{PinnedScene, Resident, Viewpoint};

use crate::blocking::run_blocking;
use crate::error::SessionError;
use crate::limits;

/// Waits until all sections that a frame needs are in memory, and pins them.
///
/// # Errors
/// They are not loaded by the deadline, cannot be loaded, or do not fit.
pub(crate) async fn pin(
    resident: Arc<Resident>,
    profile: RenderProfile,
    deadline: Instant,
    viewpoints: Vec<Viewpoint>,
) -> Result<PinnedScene, SessionError> {
    let (reply, answer) = oneshot::channel();
    let is_small = resident.blocks() * viewpoints.len() <= limits::DEMAND_IN_PLACE;
    let start = move || {
        let done = Box::new(move |pinned| {
            // Sending fails if the deadline has passed and the receiver is gone.
            let _ = reply.send(pinned);
        });
        resident.request(&viewpoints, &profile, done)
    };
    // Reads nothing, and takes less time than to wake another thread unless the twin is large.
    // Dropping the request takes the frame out of the pager's queue.
    let request = if is_small { start()? } else { run_blocking(start).await?? };
    match timeout_at(deadline, answer).await {
        Ok(Ok(pinned)) => Ok(pinned?),
        // The pager dropped the request without an answer, which it never does unless it panics.
        Ok(Err(_)) => Err(SessionError::Crashed),
        // Only the request knows which sections are still missing.
        Err(_) => Err(request.timeout_error().into()),
    }
}
