//! Why an episode could not be recorded.

use std::io;
use std::path::PathBuf;

/// Why an episode could not be recorded.
#[derive(Debug, thiserror::Error)]
#[error("cannot record the episode in {}: {cause}", path.display())]
pub struct RecordError {
    /// The file or directory.
    pub path: PathBuf,
    /// The operating system's error.
    pub cause: io::Error,
}
