//! The result of an export.

use std::io;
use std::path::PathBuf;

use crate::file::ReadError;

/// Why an episode could not be exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The record cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The file cannot be written.
    #[error("cannot write {}: {cause}", path.display())]
    Io {
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    /// The folder to write exists.
    #[error("{} exists: name another folder, or remove it", .0.display())]
    Exists(PathBuf),
    /// The file cannot be written.
    #[error("cannot write the MCAP file: {0}")]
    Output(io::Error),
    /// The file cannot be written.
    #[cfg(feature = "mcap")]
    #[error("cannot write the MCAP file: {0}")]
    Mcap(mcap::McapError),
    /// A line cannot be written as JSON.
    #[error("cannot write a line as JSON: {0}")]
    Json(serde_json::Error),
    /// The images or the sweeps of the episode cannot be made.
    #[error("{0}")]
    Images(String),
    /// The episode has no frame.
    #[error("the episode has no frame: nothing was driven")]
    Empty,
    /// This build has no MCAP.
    #[error("built without `mcap`: cargo build --release --features full")]
    LeftOut,
}

#[cfg(feature = "mcap")]
impl From<mcap::McapError> for ExportError {
    fn from(cause: mcap::McapError) -> Self {
        Self::Mcap(cause)
    }
}

impl From<serde_json::Error> for ExportError {
    fn from(cause: serde_json::Error) -> Self {
        Self::Json(cause)
    }
}

/// Result of an export.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exported {
    pub messages: u64,
    /// How far the calibrations are off the lenses at most, in pixels.
    pub calibration_error_px: f64,
}
