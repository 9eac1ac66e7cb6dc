//! Why the poses of a capture were refused.

use std::path::{Path, PathBuf};

use crate::ingest::FileError;

/// Where in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// A line, from 1.
    Line(usize),
    /// A byte, from 0.
    Byte(usize),
    /// A field of JSON, as `frames[3].transform_matrix`.
    Field(String),
    File,
}

/// Why the poses of a capture were refused.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// A file cannot be read.
    #[error("{}: {cause}", path.display())]
    File { path: PathBuf, cause: FileError },
    /// There is no COLMAP model.
    #[error(
        "{} has no COLMAP model: expected cameras.bin and images.bin, or cameras.txt and images.txt, in it or in \
         sparse/0; `colmap model_converter` writes them",
        dir.display()
    )]
    NoModel { dir: PathBuf },
    /// The content of a file.
    #[error("{}{place}: {reason}", path.display())]
    Content {
        path: PathBuf,
        place: Place,
        /// The error, and what to do.
        reason: String,
    },
}

impl CaptureError {
    pub(super) fn at(path: &Path, place: Place, reason: impl Into<String>) -> Self {
        Self::Content { path: path.to_owned(), place, reason: reason.into() }
    }
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Line(line) => write!(f, ":{line}"),
            Self::Byte(byte) => write!(f, ", byte {byte}"),
            Self::Field(field) => write!(f, ", {field}"),
            Self::File => Ok(()),
        }
    }
}
