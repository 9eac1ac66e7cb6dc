//! The whole state of a run in a file, so that a run which is stopped goes on to the same bytes.
//!
//! The file is bincode after one line of text, and its last 32 bytes are the BLAKE3 hash of all
//! before: half a file is refused.

use bincode::config::{self, Config};
use serde::{Deserialize, Serialize};

use wildcity_render::gradient::Gradients;
use wildcity_scene::RenderProfile;

use crate::exposures::TrainedExposures;
use crate::history::History;
use crate::model::{Model, ModelState};
use crate::poses::{RigPoses, TrainedPoses};
use crate::settings::Settings;
use crate::sky::TrainedSky;
use crate::trainer::{Fixed, Trainer};

/// The first line of a file.
const FORMAT: &[u8] = b"wildcity.checkpoint/2\n";

/// Bytes of the hash at the end.
const HASH: usize = blake3::OUT_LEN;

/// Why a run cannot go on from a file.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// Another file, or one of another version of the program.
    #[error("no checkpoint of this version of the program: begin anew, without --resume")]
    Format,
    /// Bytes have changed, or are missing.
    #[error("the checkpoint is damaged ({0}): begin anew, without --resume")]
    Damaged(String),
    /// The run that wrote it had other images, points or cameras.
    #[error(
        "the checkpoint is of a run on other images, cameras or points: give those, or begin anew, without --resume"
    )]
    OtherInputs,
    /// The run that wrote it had other settings.
    #[error(
        "the checkpoint is of a run with other settings: give those, or begin anew, without --resume"
    )]
    OtherSettings,
}

/// All that a run must know to go on.
#[derive(Serialize, Deserialize)]
struct State {
    /// The hash of what names images, cameras and points.
    inputs: [u8; HASH],
    settings: Settings,
    step: u64,
    history: History,
    model: ModelState,
    rig: Option<RigPoses>,
    poses: Option<TrainedPoses>,
    exposures: Option<TrainedExposures>,
    sky: Option<TrainedSky>,
}

impl Trainer {
    /// The bytes of a file that [`Trainer::from_checkpoint`] reads. `inputs` is any text that names
    /// the images, cameras and points of the run, of which the file keeps a hash.
    ///
    /// # Errors
    /// The state is larger than the address space.
    pub fn to_checkpoint(&self, inputs: &str) -> Result<Vec<u8>, CheckpointError> {
        let state = State {
            inputs: *blake3::hash(inputs.as_bytes()).as_bytes(),
            settings: self.settings.clone(),
            step: self.step as u64,
            history: self.history.clone(),
            model: self.model.state(),
            rig: self.rig.clone(),
            poses: self.poses.clone(),
            exposures: self.exposures.clone(),
            sky: self.sky.clone(),
        };
        let mut bytes = FORMAT.to_vec();
        bincode::serde::encode_into_std_write(&state, &mut bytes, encoding())
            .map_err(|error| CheckpointError::Damaged(error.to_string()))?;
        bytes.extend(blake3::hash(&bytes).as_bytes());
        Ok(bytes)
    }

    /// The run that wrote a file, at the step at which it did. What is not trained is not in the
    /// file: it is given again.
    ///
    /// # Errors
    /// The file is damaged, or of a run with other inputs or settings.
    pub fn from_checkpoint(
        bytes: &[u8],
        inputs: &str,
        profile: RenderProfile,
        settings: &Settings,
        fixed: Fixed,
    ) -> Result<Self, CheckpointError> {
        let contents = bytes.strip_prefix(FORMAT).ok_or(CheckpointError::Format)?;
        let Some((contents, hash)) = contents.split_last_chunk::<HASH>() else {
            return Err(CheckpointError::Damaged("it is cut off".to_owned()));
        };
        let hashed = &bytes[..bytes.len() - HASH];
        if blake3::hash(hashed) != blake3::Hash::from_bytes(*hash) {
            return Err(CheckpointError::Damaged("its hash is another".to_owned()));
        }
        let (state, _): (State, usize) = bincode::serde::decode_from_slice(contents, encoding())
            .map_err(|error| CheckpointError::Damaged(error.to_string()))?;
        if state.inputs != *blake3::hash(inputs.as_bytes()).as_bytes() {
            return Err(CheckpointError::OtherInputs);
        }
        if state.settings != *settings {
            return Err(CheckpointError::OtherSettings);
        }
        let Fixed { sky, chunks } = fixed;
        let model = Model::from_state(state.model, chunks);
        Ok(Self {
            settings: state.settings,
            profile,
            model: model.ok_or_else(|| CheckpointError::Damaged("its sizes differ".to_owned()))?,
            rig: state.rig,
            poses: state.poses,
            exposures: state.exposures,
            sky: state.sky,
            fixed_sky: sky,
            step: state.step as usize,
            history: state.history,
            gradients: Gradients::default(),
        })
    }
}

fn encoding() -> impl Config {
    config::standard().with_fixed_int_encoding()
}
