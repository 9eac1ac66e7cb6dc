//! A request that is rendered and not yet carried out.
//!
//! Every request with images goes the same way: it plans the state that follows, renders it, and
//! makes a [`Pending`] of both. [`Pending::commit`] is the only place that records a request and
//! changes the session. If anything before it fails or is dropped, the session is unchanged.

use tracing::{Instrument as _, debug_span};

use super::Session;
use crate::episode::{Episode, Outcome};
use crate::error::SessionError;
use crate::observe::observation::Observation;
use crate::record::format::{FrameRecord, RecordedOrigin};
use crate::state::{EpisodeState, PinnedVersion};
use wildcity_twin::residency::{FrameBytes, SceneBytes};

/// What a request has rendered, and what it changes.
pub(super) struct Pending {
    /// The state after the request; `None` if it stays as it is.
    pub(super) next: Option<EpisodeState>,
    pub(super) record: FrameRecord,
    pub(super) file: EpisodeFile,
    pub(super) observation: Observation,
}

/// Where a request is recorded.
pub(super) enum EpisodeFile {
    /// In the file of the episode, which the first frame creates.
    Same,
    /// In a new file: another episode begins, and the old one ends.
    New(Box<NewEpisode>),
}

/// An episode that begins with a request.
pub(super) struct NewEpisode {
    pub(super) version: PinnedVersion,
    /// Memory for the worst frame of the version, if it is another one.
    pub(super) memory: Option<(SceneBytes, FrameBytes)>,
    /// The recorded episode that it is a branch of.
    pub(super) origin: Option<RecordedOrigin>,
    /// The state with which the file begins.
    pub(super) first: Episode,
}

impl Pending {
    /// Records the request, then changes the session.
    ///
    /// # Errors
    /// The request could not be recorded, or the memory of another version does not fit; the
    /// session is unchanged.
    pub(super) async fn commit(self, session: &mut Session) -> Result<Observation, SessionError> {
        let Self { next, record, file, observation } = self;
        let recorded = session.record(record, next.as_ref(), &file);
        let created = recorded.instrument(debug_span!("record")).await?;
        if let EpisodeFile::New(new) = file {
            // A file that was just created goes again.
            if let Some((scenes, frame)) = new.memory
                && let Err(error) =
                    session.exchange_memory(new.version.resident.clone(), scenes, frame)
            {
                if let Some(created) = created {
                    created.recorder.discard();
                }
                return Err(error);
            }
            session.version = new.version;
            session.end_recording(Outcome::Completed).await;
            session.origin = new.origin;
            session.hint.clear();
        }
        if let Some(created) = created {
            session.recorder = Some(created.recorder);
            session.episode_number = created.number;
        }
        // Only now: after a failure, the next frame has to write the switch.
        session.version_switched = false;
        if let Some(next) = next {
            session.state = next;
            session.look_ahead();
        }
        Ok(observation)
    }
}
