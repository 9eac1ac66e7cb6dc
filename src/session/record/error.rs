//! Why an episode could not be recorded, or a recorded one not be continued.

use std::io;
use std::path::PathBuf;

use super::replay_report::ReplayError;

/// Why an episode could not be recorded.
#[derive(Debug, thiserror::Error)]
#[error("cannot record the episode in {}: {cause}", path.display())]
pub struct RecordError {
    /// The file or directory.
    pub path: PathBuf,
    /// What the operating system says.
    pub cause: io::Error,
}

/// Why a recorded episode could not be continued.
#[derive(Debug, thiserror::Error)]
pub enum BranchError {
    /// The file cannot be read, or is damaged.
    #[error(transparent)]
    Read(#[from] ReplayError),
    /// The version of the twin is not the recorded one.
    #[error("version {version} of the twin was {recorded}, and is {now} now")]
    Version {
        /// Number of the version.
        version: u64,
        /// The recorded hash.
        recorded: String,
        /// The hash now.
        now: String,
    },
    /// The episode had a scenario.
    #[error(
        "the episode drove a scenario, whose traffic a record does not restore: branch from a snapshot"
    )]
    Scenario,
    /// Driving the recorded commands leads elsewhere, or to other frames.
    #[error("{0}")]
    Diverged(String),
    /// A frame that later observations show again is not rendered as it was then.
    #[error(
        "the image of camera {camera:?} at {time_us} µs is not as recorded (by backend \
         {recorded_by}); this is backend {backend}"
    )]
    Image {
        /// Name of the camera.
        camera: String,
        /// Time of the frame, in microseconds.
        time_us: i64,
        /// The backend that recorded it.
        recorded_by: String,
        /// The backend now.
        backend: String,
    },
}

impl From<BranchError> for crate::error::SessionError {
    fn from(error: BranchError) -> Self {
        Self::Branch(Box::new(error))
    }
}
