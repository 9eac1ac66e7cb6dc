//! Why a twin cannot be opened, or the sections of a frame cannot be brought into memory.

use std::time::Duration;

use super::Viewpoint;
use crate::store::StoreError;
use wildcity_scene::sky::SkyError;

/// Why a twin cannot be opened, or a frame cannot be drawn.
#[derive(Debug, thiserror::Error)]
pub enum ResidencyError {
    /// The version is not in the store, or differs from what was committed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The memory for its worst frame does not fit in addition to that of the open sessions.
    #[error(
        "a frame of twin {twin:?} may need {needed_bytes} bytes of memory; {held_bytes} of \
         {limit_bytes} are reserved for open sessions: close some, allow more with --memory-gib, or \
         import the twin with a smaller reach_m or a larger tau_px"
    )]
    NoRoom {
        twin: String,
        /// Bytes that its worst frame needs beyond those that are reserved already.
        needed_bytes: u64,
        /// Bytes that are reserved for sessions.
        held_bytes: u64,
        /// Bytes that all twins together may use.
        limit_bytes: u64,
    },
    /// The memory for an asset of an actor does not fit in addition to that of the open sessions.
    #[error(
        "actor {actor:?} needs {needed_bytes} bytes of memory; {held_bytes} of {limit_bytes} are reserved for open \
         sessions: close some, allow more with --memory-gib, or import the actor with fewer Gaussians"
    )]
    NoRoomForActor {
        actor: String,
        /// Bytes of all its levels of detail.
        needed_bytes: u64,
        /// Bytes that are reserved for sessions.
        held_bytes: u64,
        /// Bytes that all twins and actors together may use.
        limit_bytes: u64,
    },
    /// One frame needs more than all the memory that twins may use.
    #[error(
        "this frame of twin {twin:?} needs {needed_bytes} bytes of memory, and all twins \
         together may use {limit_bytes}: allow more with --memory-gib, or draw it with a smaller reach_m \
         or a larger tau_px"
    )]
    TooLarge {
        twin: String,
        /// Bytes that the frame needs.
        needed_bytes: u64,
        /// Bytes that all twins together may use.
        limit_bytes: u64,
    },
    /// More views than a frame has.
    #[error("a frame has at most {most} views, not {views}", most = Viewpoint::MAX)]
    Views { views: usize },
    /// The deadline passed before every section was in memory.
    #[error(
        "{missing} of the {needed} sections of twin {twin:?} that the frame needs were not in memory \
         after {waited:.1?}; loading continues: try again, or allow more time"
    )]
    TimedOut {
        twin: String,
        /// Sections that are still missing.
        missing: usize,
        /// Sections that the frame needs.
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
        twin: String,
        /// Grid cell (x, y).
        cell: [i32; 2],
        /// The block within the cell.
        block: u8,
        /// The level of detail.
        level: u8,
        attempts: u32,
        /// Why the last attempt failed.
        cause: String,
    },
    /// Its sky cannot be drawn with the error that its profile asks for.
    #[error("the sky of twin {twin:?}: {cause}")]
    Sky { twin: String, cause: SkyError },
    /// The loader threads cannot be started.
    #[error("cannot start the threads that load sections: {reason}")]
    Thread {
        /// The operating system's message.
        reason: String,
    },
}
