//! Reads and renders the references of a repair model.
//!
//! Each is rendered as a separate frame, scheduled among the frames of other sessions, and stays in
//! memory for the next steps and for other sessions. Along the drive, new references are needed
//! only every 2 m.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::{Instant, timeout_at};
use tracing::{Instrument as _, debug_span};

use wildcity_repair::reference::Reference;

use super::Session;
use crate::blocking::run_blocking;
use crate::engine::render_queue::{FrameCost, Scratch};
use crate::error::SessionError;
use crate::observe::builder::ObservationBuilder;
use crate::pin::pin;
use crate::repair::drawn;
use crate::repair::references::{ReferenceView, ReferenceViews};
use crate::state::PinnedVersion;
use crate::viewpoint::viewpoints;

impl Session {
    /// Adds the references that the chosen images of the last capture need.
    ///
    /// # Errors
    /// A recorded image or a section cannot be read, or the deadline has passed.
    pub(super) async fn find_references(
        &self,
        version: &PinnedVersion,
        views: &Arc<ReferenceViews>,
        mut builder: ObservationBuilder,
        deadline: Instant,
    ) -> Result<ObservationBuilder, SessionError> {
        let started = Instant::now();
        // The builder goes to the thread and back, because the search adds to its candidates.
        let find = {
            let views = views.clone();
            move || {
                let wanted = builder.wanted_references(&views);
                (wanted, builder)
            }
        };
        let (wanted, found) = run_blocking(find).await?;
        builder = found;
        let mut references = HashMap::with_capacity(wanted.len());
        // One after the other: like its frames, each has its turn among those of other sessions.
        for view in wanted {
            let id = view.id();
            let reference = self
                .reference(version, views, view, deadline)
                .instrument(debug_span!("reference", id));
            references.insert(id, reference.await?);
        }
        builder.add_references(references, started.elapsed());
        Ok(builder)
    }

    /// A reference: from memory, or read and rendered.
    async fn reference(
        &self,
        version: &PinnedVersion,
        views: &Arc<ReferenceViews>,
        view: ReferenceView,
        deadline: Instant,
    ) -> Result<Arc<Reference>, SessionError> {
        let key = view.key(&version.resident.version.hash, &version.profile_hash);
        let repairs = self.engine.repairs().clone();
        if let Some(known) = repairs.references().get(&key) {
            return Ok(known);
        }
        let read = {
            let engine = self.engine.clone();
            let views = views.clone();
            let view = view.clone();
            let resident = version.resident.clone();
            move || {
                let image = drawn::read(engine.catalog(), &resident.version, &view)?;
                Ok::<_, SessionError>((image, views.projection(&view.camera)))
            }
        };
        let in_time = timeout_at(deadline, run_blocking(read)).await;
        // Too late, a panic, and an error of the store.
        let (image, projection) = in_time.map_err(|_| SessionError::DeadlineExceeded)???;
        let profile = version.profile;
        let places = viewpoints(&[view.view()]);
        // Pinned until it is drawn, as the scene of any frame is.
        let pinned = pin(version.resident.clone(), profile, deadline, places).await?;
        let cost = FrameCost::new(self.slot.number(), &[view.view()], &profile);
        let work = move |_: &mut Scratch, backend: &dyn wildcity_render::Backend| {
            drawn::draw(&view, image, projection, &pinned, &profile, backend)
        };
        let (drawn, _queued): (_, Duration) = self.engine.run(cost, deadline, work).await?;
        let reference = Arc::new(drawn?);
        // Two sessions may have drawn the same one meanwhile. Both are equal.
        repairs.references().insert(key, reference.clone());
        Ok(reference)
    }
}
