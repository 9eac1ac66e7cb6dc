//! Opening what somebody named: regular files only, of which no more is read than is allowed.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::Path;

/// Why a file was refused before its content counted.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system refused.
    #[error("cannot read: {0}")]
    Io(io::Error),
    /// A pipe or a device has no size to check and may never end; a directory holds no bytes.
    #[error("not a regular file but {found}; copy what it holds into a file, and give that")]
    NotRegular {
        /// What it is.
        found: &'static str,
    },
    /// Named by another file, and not within its folder.
    #[error("is not a plain path below the folder of the file that names it; move it there")]
    OutsideFolder,
    /// One of more files than are read for one scene.
    #[error("one more than the {limit} files that a scene may have; split the scene")]
    TooMany {
        /// The most that are read.
        limit: usize,
    },
    /// Larger than any honest one.
    #[error("larger than {limit_bytes} bytes")]
    TooLarge {
        /// The most that is read.
        limit_bytes: u64,
    },
}

impl From<io::Error> for FileError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Opens a regular file, and tells its size in bytes.
pub(super) fn open(path: &Path) -> Result<(File, u64), FileError> {
    // Before opening: that alone waits for ever on a pipe that nobody writes to.
    check_regular(&fs::metadata(path)?)?;
    let file = File::open(path)?;
    let metadata = file.metadata()?;
    check_regular(&metadata)?;
    Ok((file, metadata.len()))
}

/// Reads a whole file of at most so many bytes.
///
/// # Errors
/// It cannot be read, is not a regular file, or is larger.
pub fn read_whole(path: &Path, limit_bytes: u64) -> Result<Vec<u8>, FileError> {
    let (file, _) = open(path)?;
    read_at_most(file, limit_bytes)
}

/// Reads to the end, which must come within so many bytes.
pub(super) fn read_at_most(input: impl Read, limit_bytes: u64) -> Result<Vec<u8>, FileError> {
    let mut bytes = Vec::new();
    // One more, to tell a file of the limit from a larger one.
    input.take(limit_bytes + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit_bytes {
        return Err(FileError::TooLarge { limit_bytes });
    }
    Ok(bytes)
}

fn check_regular(metadata: &fs::Metadata) -> Result<(), FileError> {
    let kind = metadata.file_type();
    match (kind.is_file(), kind.is_dir()) {
        (true, _) => Ok(()),
        (_, true) => Err(FileError::NotRegular { found: "a directory" }),
        _ => Err(FileError::NotRegular { found: "a pipe, a socket or a device" }),
    }
}
