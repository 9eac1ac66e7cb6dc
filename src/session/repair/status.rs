//! Result of the repair of an image in a session that asked for repair.

use serde::{Deserialize, Serialize};

use wildcity_repair::RepairError;

/// Result of the repair of an image in a session that asked for repair.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImageRepair {
    /// Whether it was repaired.
    pub status: RepairStatus,
    /// BLAKE3 of the pixels before the repair; the hash of the image unless it was repaired.
    pub rendered_hash: blake3::Hash,
    /// References that the model got, at most 8, ordered from most to fewest contributed pixels.
    pub references: Vec<String>,
}

impl ImageRepair {
    /// Result for an image that was not selected.
    pub(crate) fn kept(hash: blake3::Hash) -> Self {
        Self { status: RepairStatus::Kept, rendered_hash: hash, references: Vec::new() }
    }
}

/// State of the repair of an episode's images that continues from one observation to the next, by
/// camera.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct RepairState {
    /// Whether the camera is in repair; empty if none is.
    pub(crate) is_on: Vec<bool>,
    /// Name of its image of the role `reference`; empty if none has one.
    pub(crate) references: Vec<Option<String>>,
}

impl RepairState {
    /// Resizes the state to one entry per camera.
    #[must_use]
    pub(crate) fn for_cameras(mut self, cameras: usize) -> Self {
        // An empty list stands for cameras that are all off.
        self.is_on.resize(cameras, false);
        self.references.resize(cameras, None);
        self
    }
}

/// Whether an image was repaired.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RepairStatus {
    /// It was not selected.
    Kept,
    Repaired,
    /// It was selected, and the model failed: it is as rendered.
    Failed(RepairFailure),
}

/// Why the model failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RepairFailure {
    /// It ran too long and was stopped.
    TimedOut,
    /// It returned NaN or infinity.
    NotFinite,
    /// It ran too long too often and is not used any more.
    Withdrawn,
    /// Anything else; the server's log has the message.
    Other,
}

impl From<&RepairError> for RepairFailure {
    fn from(error: &RepairError) -> Self {
        match error {
            RepairError::TimedOut { .. } => Self::TimedOut,
            RepairError::NotFinite { .. } => Self::NotFinite,
            RepairError::Withdrawn { .. } => Self::Withdrawn,
            _ => Self::Other,
        }
    }
}
