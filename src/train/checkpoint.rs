//! The whole state of a run in a file, so that a run which is stopped goes on to the same bytes.
//!
//! The file is bincode after one line of text, and its last 32 bytes are the BLAKE3 hash of all
//! before: half a file is refused. It is written and read as a stream: a run takes no second copy
//! of its state for it.

use std::io::{self, Read, Write};

use bincode::config::{self, Config};
use bincode::error::{DecodeError, EncodeError};
use serde::{Deserialize, Serialize};

use wildcity_render::gradient::Gradients;
use wildcity_scene::RenderProfile;

use crate::exposures::TrainedExposures;
use crate::history::History;
use crate::model::{Model, ModelState, SavedModel};
use crate::poses::{RigPoses, TrainedPoses};
use crate::settings::Settings;
use crate::sky::TrainedSky;
use crate::trainer::{Fixed, Trainer};

/// The first line of a file.
const FORMAT: &[u8] = b"wildcity.checkpoint/4\n";

/// Bytes that are hashed at a time.
const BUFFER: usize = 1 << 16;

/// Bytes of the hash at the end.
const HASH: usize = blake3::OUT_LEN;

/// Why a run cannot be written, or cannot go on from a file.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// Another file, or one of another version of the program.
    #[error("no checkpoint of this version of the program: remove the file to begin anew")]
    Format,
    /// Bytes have changed, or are missing.
    #[error("the checkpoint is damaged ({0}): remove the file to begin anew")]
    Damaged(String),
    /// The run that wrote it had other images, points or cameras.
    #[error(
        "the checkpoint is of a run on other images, cameras or points: give those, or remove the file to begin anew"
    )]
    OtherInputs,
    /// The run that wrote it had other settings.
    #[error(
        "the checkpoint is of a run with other settings: give those, or remove the file to begin anew"
    )]
    OtherSettings,
    /// The file cannot be written or read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The state cannot be written.
    #[error(transparent)]
    Encode(#[from] EncodeError),
}

/// What names a run, at the beginning of a file.
#[derive(Serialize, Deserialize)]
struct Header {
    /// The hash of what names images, cameras and points.
    inputs: [u8; HASH],
    settings: Settings,
}

/// All else that a run must know to go on, as it is read.
#[derive(Deserialize)]
struct State {
    step: u64,
    history: History,
    rig: Option<RigPoses>,
    poses: Option<TrainedPoses>,
    exposures: Option<TrainedExposures>,
    sky: Option<TrainedSky>,
    model: ModelState,
}

/// The same, as it is written.
#[derive(Serialize)]
struct SavedState<'a> {
    step: u64,
    history: &'a History,
    rig: &'a Option<RigPoses>,
    poses: &'a Option<TrainedPoses>,
    exposures: &'a Option<TrainedExposures>,
    sky: &'a Option<TrainedSky>,
    model: SavedModel<'a>,
}

impl Trainer {
    /// Writes a file that [`Trainer::from_checkpoint`] reads. `inputs` is any text that names the
    /// images, cameras and points of the run, of which the file keeps a hash.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write_checkpoint(
        &self,
        inputs: &str,
        mut to: impl Write,
    ) -> Result<(), CheckpointError> {
        let mut hashed = Hashed::new(&mut to);
        hashed.write_all(FORMAT)?;
        let header = Header { inputs: hash(inputs), settings: self.settings.clone() };
        bincode::serde::encode_into_std_write(&header, &mut hashed, encoding())?;
        let state = SavedState {
            step: self.step as u64,
            history: &self.history,
            rig: &self.rig,
            poses: &self.poses,
            exposures: &self.exposures,
            sky: &self.sky,
            model: self.model.saved(),
        };
        bincode::serde::encode_into_std_write(&state, &mut hashed, encoding())?;
        // The hash itself is written past the hasher.
        let (_, hash) = hashed.end();
        Ok(to.write_all(hash.as_bytes())?)
    }

    /// The run that wrote a file, at the step at which it did. What is not trained is not in the
    /// file: it is given again.
    ///
    /// # Errors
    /// The file is damaged, or of a run with other inputs or settings.
    pub fn from_checkpoint(
        from: impl Read,
        inputs: &str,
        profile: RenderProfile,
        settings: &Settings,
        fixed: Fixed,
    ) -> Result<Self, CheckpointError> {
        let mut hashed = Hashed::new(from);
        let mut format = [0; FORMAT.len()];
        // A file that is shorter than the first line is another file as well.
        if hashed.read_exact(&mut format).is_err() || format != FORMAT {
            return Err(CheckpointError::Format);
        }
        let header: Header = decode(&mut hashed)?;
        // Of another run all else may have another form.
        if header.inputs != hash(inputs) {
            return Err(CheckpointError::OtherInputs);
        }
        if header.settings != *settings {
            return Err(CheckpointError::OtherSettings);
        }
        let state: State = decode(&mut hashed)?;
        let (mut inner, hash) = hashed.end();
        let mut end = Vec::new();
        // A byte more than the hash, so that a file with something behind it is found out.
        inner.by_ref().take(HASH as u64 + 1).read_to_end(&mut end)?;
        if end != hash.as_bytes() {
            return Err(CheckpointError::Damaged("its hash is another".to_owned()));
        }
        let Fixed { sky, chunks } = fixed;
        let model = Model::from_state(state.model, chunks);
        Ok(Self {
            settings: header.settings,
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

/// A stream of which all bytes are hashed.
struct Hashed<T> {
    inner: T,
    hasher: blake3::Hasher,
    /// Bytes that are not hashed yet: numbers come one by one, and a hash of four bytes costs as
    /// much as one of a thousand.
    pending: Vec<u8>,
}

impl<T> Hashed<T> {
    fn new(inner: T) -> Self {
        Self { inner, hasher: blake3::Hasher::new(), pending: Vec::with_capacity(BUFFER) }
    }

    fn add(&mut self, bytes: &[u8]) {
        self.pending.extend_from_slice(bytes);
        if self.pending.len() >= BUFFER {
            self.hasher.update(&self.pending);
            self.pending.clear();
        }
    }

    /// The stream, and the hash of all that went through.
    fn end(mut self) -> (T, blake3::Hash) {
        self.hasher.update(&self.pending);
        (self.inner, self.hasher.finalize())
    }
}

impl<T: Write> Write for Hashed<T> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.inner.write(bytes)?;
        // A writer may take fewer bytes than it is given; the rest comes again.
        self.add(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

impl<T: Read> Read for Hashed<T> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(bytes)?;
        self.add(&bytes[..read]);
        Ok(read)
    }
}

fn hash(inputs: &str) -> [u8; HASH] {
    *blake3::hash(inputs.as_bytes()).as_bytes()
}

/// What a stream has next. A length that is damaged takes no memory before its bytes are there.
fn decode<T: for<'de> Deserialize<'de>>(from: &mut impl Read) -> Result<T, CheckpointError> {
    bincode::serde::decode_from_std_read(from, encoding()).map_err(|error| match error {
        DecodeError::Io { inner, .. } if inner.kind() != io::ErrorKind::UnexpectedEof => {
            inner.into()
        }
        error => CheckpointError::Damaged(error.to_string()),
    })
}

fn encoding() -> impl Config {
    config::standard().with_fixed_int_encoding()
}
