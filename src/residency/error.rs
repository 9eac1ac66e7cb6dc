//! Why a twin is not in memory.

use crate::store::StoreError;

/// Why a twin could not be loaded.
#[derive(Debug, thiserror::Error)]
pub enum ResidencyError {
    /// It is not in the store, or not as it was committed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// It does not fit beside what is in memory.
    #[error(
        "twin {twin:?} takes {needed_bytes} bytes of memory; {held_bytes} of {limit_bytes} are \
         taken by twins in use: close their sessions, or allow more with --memory-gib"
    )]
    NoRoom {
        /// The twin.
        twin: String,
        /// What it would take.
        needed_bytes: u64,
        /// What other twins take.
        held_bytes: u64,
        /// What all twins together may take.
        limit_bytes: u64,
    },
}
