//! Why a recorded episode could not be continued.

use super::replay_report::ReplayError;
use crate::error::SessionError;

/// Why a recorded episode could not be continued.
#[derive(Debug, thiserror::Error)]
pub enum BranchError {
    /// The file cannot be read, or is damaged.
    #[error(transparent)]
    Read(#[from] ReplayError),
    /// The version of the twin differs from the recorded one.
    #[error("version {version} of the twin was {recorded}, and is {now} now")]
    Version {
        /// Number of the version.
        version: u64,
        recorded: String,
        now: String,
    },
    /// The episode had a scenario.
    #[error(
        "the episode drove a scenario, whose traffic a record does not restore: branch from a snapshot"
    )]
    Scenario,
    /// The images of the episode were repaired.
    #[error(
        "images of the episode were repaired by a model, which a record does not have: branch from a snapshot"
    )]
    Repair,
    /// Driving the recorded commands leads elsewhere, or to other frames.
    #[error("{0}")]
    Diverged(String),
    /// A frame that later observations show again is rendered differently from the record.
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
        backend: String,
    },
}

impl From<BranchError> for SessionError {
    fn from(error: BranchError) -> Self {
        Self::Branch { reason: error.to_string() }
    }
}
