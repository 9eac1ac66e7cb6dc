//! Opens files that a user named: regular files only, up to a size limit.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::Path;

/// Why a file was refused before its content was read.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// An I/O operation failed.
    #[error("cannot read: {0}")]
    Io(io::Error),
    /// A pipe or a device has no size to check and may never end.
    #[error(
        "not a regular file but a pipe, a socket or a device; copy its content into a file, and give that"
    )]
    NotRegular,
    /// A folder has no bytes.
    #[error(
        "a folder; give a file in it, of a scene in a folder its meta.json, lod-meta.json or .gltf"
    )]
    Folder,
    /// Another file names it, and it is not within that file's folder.
    #[error("is not a plain path below the folder of the file that names it; move it there")]
    OutsideFolder,
    /// A scene of a push names it, and the push has none or several files of this name.
    #[error(
        "is not the name of exactly one file of this push; push it together with the file that names it, or all of a \
         SOG as one .zip"
    )]
    NotListed,
    /// The scene names it again.
    #[error("is named more than once; each file of a scene is read once")]
    Repeated,
    /// The scene has more files than are read.
    #[error("the scene has more than {limit} files; split it")]
    TooMany {
        /// The most files that are read.
        limit: usize,
    },
    /// Larger than the limit for such a file.
    #[error("larger than {limit_bytes} bytes")]
    TooLarge {
        /// The most bytes that are read.
        limit_bytes: u64,
    },
}

impl From<io::Error> for FileError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Opens a regular file. Also returns its size in bytes.
pub(super) fn open(path: &Path) -> Result<(File, u64), FileError> {
    // Checked before opening, because opening a pipe waits until another process writes to it.
    check_regular(&fs::metadata(path)?)?;
    let file = File::open(path)?;
    let metadata = file.metadata()?;
    check_regular(&metadata)?;
    Ok((file, metadata.len()))
}

/// Reads a whole file of at most `limit_bytes`.
///
/// # Errors
/// It cannot be read, is not a regular file, or is larger.
pub fn read_whole(path: &Path, limit_bytes: u64) -> Result<Vec<u8>, FileError> {
    let (file, file_bytes) = open(path)?;
    read_at_most(file, file_bytes, limit_bytes)
}

/// Reads to the end, which must come within `limit_bytes`. `expected_bytes` is the size of the
/// file: a buffer that grows while it is filled could take twice as much.
pub(super) fn read_at_most(
    input: impl Read,
    expected_bytes: u64,
    limit_bytes: u64,
) -> Result<Vec<u8>, FileError> {
    if expected_bytes > limit_bytes {
        return Err(FileError::TooLarge { limit_bytes });
    }
    let mut bytes = Vec::with_capacity(expected_bytes as usize);
    // One byte more, to distinguish a file of exactly the limit from a larger one.
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
        (_, true) => Err(FileError::Folder),
        _ => Err(FileError::NotRegular),
    }
}
