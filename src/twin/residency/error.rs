//! Why a twin, or what a frame needs of it, is not in memory.

use std::time::Duration;

use crate::store::StoreError;
use wildcity_scene::sky::SkyError;

/// Why a twin cannot be opened, or a frame not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum ResidencyError {
    /// It is not in the store, or not as it was committed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Its worst frame does not fit beside those of the sessions that are open.
    #[error(
        "a frame of twin {twin:?} may need {needed_bytes} bytes of memory; {held_bytes} of \
         {limit_bytes} are set aside for open sessions: close some, allow more with --memory-gib, or \
         import the twin with a smaller reach_m or a larger tau_px"
    )]
    NoRoom {
        /// The twin.
        twin: String,
        /// What its worst frame needs, as far as it is not set aside already.
        needed_bytes: u64,
        /// What is set aside for sessions.
        held_bytes: u64,
        /// What there is for all.
        limit_bytes: u64,
    },
    /// One frame needs more than all the memory there is for twins.
    #[error(
        "this frame of twin {twin:?} needs {needed_bytes} bytes of memory, and there are \
         {limit_bytes} for all twins: allow more with --memory-gib, or draw it with a smaller reach_m \
         or a larger tau_px"
    )]
    TooLarge {
        /// The twin.
        twin: String,
        /// What the frame needs.
        needed_bytes: u64,
        /// What there is for all.
        limit_bytes: u64,
    },
    /// The deadline passed before everything was there.
    #[error(
        "{missing} of the {needed} sections of twin {twin:?} that the frame needs were not in memory \
         after {waited:.1?}; they go on loading: try again, or allow more time"
    )]
    TimedOut {
        /// The twin.
        twin: String,
        /// Sections that are still not there.
        missing: usize,
        /// Sections of the frame.
        needed: usize,
        /// How long the frame waited for them.
        waited: Duration,
    },
    /// A section cannot be read. The next frame that needs it tries again.
    #[error(
        "block {block} of cell {cell:?} of twin {twin:?}, level {level}, could not be loaded in \
         {attempts} attempts: {cause}"
    )]
    Load {
        /// The twin.
        twin: String,
        /// The cell.
        cell: [i32; 2],
        /// The block within the cell.
        block: u8,
        /// The level of detail.
        level: u8,
        /// How often it was tried.
        attempts: u32,
        /// What went wrong the last time.
        cause: String,
    },
    /// Its sky cannot be drawn as its profile asks.
    #[error("the sky of twin {twin:?}: {cause}")]
    Sky {
        /// The twin.
        twin: String,
        /// Why not.
        cause: SkyError,
    },
    /// The threads that load cannot be started.
    #[error("cannot start the threads that load twins: {reason}")]
    Thread {
        /// What the operating system says.
        reason: String,
    },
}
