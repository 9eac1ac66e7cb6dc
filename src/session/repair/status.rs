//! What is told of an image in a session that asked for repair.

use serde::{Deserialize, Serialize};

use wildcity_repair::RepairError;

/// What became of an image, in a session that asked for repair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageRepair {
    /// What became of it.
    pub status: RepairStatus,
    /// BLAKE3 of the pixels before the repair; the hash of the image unless it was repaired.
    pub rendered_hash: blake3::Hash,
}

/// What became of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RepairStatus {
    /// It was not selected.
    Kept,
    /// It was repaired.
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
