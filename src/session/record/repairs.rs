//! The repair of images in a record.

use serde::{Deserialize, Serialize};

use wildcity_repair::Selection;

use crate::repair::session_repair::SessionRepair;
use crate::repair::status::{ImageRepair, RepairFailure, RepairStatus};
use wildcity_options::OnFailure;

/// The repair of an episode's images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedRepair {
    /// Name of the model.
    pub model: String,
    pub version: String,
    /// BLAKE3 of all that decides its bytes, in hex: manifest, files, build of the runtime,
    /// provider.
    pub repair_hash: String,
    /// `cpu`, `cuda` or `tensorrt`.
    pub provider: String,
    /// The runtime: name of its library, and its commit.
    pub runtime: String,
    /// Whether three runs at its load gave the same bytes.
    pub deterministic: bool,
    /// Which images it repairs.
    pub selection: Selection,
    /// Behaviour when it failed.
    pub on_failure: OnFailure,
}

/// Result of the model for an image that was selected.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum RecordedImageRepair {
    /// It repaired the image that had this BLAKE3 before, in hex.
    Repaired(String),
    /// It failed; the image is as rendered.
    Failed(RepairFailure),
}

impl RecordedRepair {
    /// The record of a session's repair.
    pub(crate) fn from_repair(repair: &SessionRepair) -> Self {
        let model = &repair.model;
        Self {
            model: model.manifest().name.clone(),
            version: model.manifest().version.clone(),
            repair_hash: model.repair_hash().to_hex().to_string(),
            provider: model.provider().name().to_owned(),
            runtime: model.runtime(),
            deterministic: model.is_deterministic(),
            selection: repair.selection,
            on_failure: repair.on_failure,
        }
    }
}

impl RecordedImageRepair {
    /// The records of an answer's images; empty if all were kept.
    pub(crate) fn list(repairs: &[ImageRepair]) -> Vec<Option<Self>> {
        let record = |repair: &ImageRepair| match repair.status {
            RepairStatus::Kept => None,
            RepairStatus::Repaired => {
                Some(Self::Repaired(repair.rendered_hash.to_hex().to_string()))
            }
            RepairStatus::Failed(failure) => Some(Self::Failed(failure)),
        };
        let list: Vec<Option<Self>> = repairs.iter().map(record).collect();
        // Most answers have no repair, and their lines no such field.
        if list.iter().all(Option::is_none) { Vec::new() } else { list }
    }
}
