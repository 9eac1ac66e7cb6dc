//! Named states of a session, to which it can return, and from which other sessions can be opened.

use std::collections::BTreeMap;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::engine::answer_budget::BudgetShare;
use crate::error::SessionError;
use crate::limits;
use crate::record::format::RecordedOrigin;
use crate::state::{EpisodeState, PinnedVersion, SessionSettings};

/// A state of a session.
#[derive(Debug)]
pub struct Snapshot {
    pub(crate) settings: Arc<SessionSettings>,
    pub(crate) version: PinnedVersion,
    pub(crate) state: EpisodeState,
    /// Where the state was reached; absent if no frame of the episode is on record yet.
    pub(crate) origin: Option<RecordedOrigin>,
    /// The share of the budget for answers that the copy of the state takes: 16,384 triggers take
    /// megabytes.
    pub(crate) _share: BudgetShare,
}

/// The snapshots of a session, by name. Copies share them, so that other sessions can be opened
/// from a snapshot while its own session drives on. They end with the last copy.
#[derive(Clone, Debug, Default)]
pub struct Snapshots(Arc<Mutex<BTreeMap<String, Arc<Snapshot>>>>);

impl Snapshot {
    /// Name of the twin.
    pub fn twin(&self) -> &str {
        &self.version.resident.version.manifest.twin
    }
}

impl Snapshots {
    /// Stores a snapshot, in place of an earlier one of that name.
    ///
    /// # Errors
    /// There are [`limits::SNAPSHOTS`] other snapshots already.
    pub(crate) fn store(&self, name: String, snapshot: Snapshot) -> Result<(), SessionError> {
        let mut snapshots = self.0.lock();
        // A name that is used again takes no more room.
        if !snapshots.contains_key(&name) && snapshots.len() >= limits::SNAPSHOTS {
            let most = limits::SNAPSHOTS;
            let must = format!(
                "{name:?}, one snapshot too many: a session has at most {most}; use a name again"
            );
            return Err(SessionError::OutOfRange { field: "name", must });
        }
        snapshots.insert(name, Arc::new(snapshot));
        Ok(())
    }

    /// The snapshot of a name; `field` is the field of the request that has the name.
    ///
    /// # Errors
    /// [`SessionError::UnknownSnapshot`] with the names that there are.
    pub fn find(&self, field: &'static str, name: &str) -> Result<Arc<Snapshot>, SessionError> {
        let snapshots = self.0.lock();
        snapshots.get(name).cloned().ok_or_else(|| SessionError::UnknownSnapshot {
            field,
            name: name.to_owned(),
            known: snapshots.keys().cloned().collect(),
        })
    }
}
