//! Outside formats: one file each, picked by what a file starts with, never by its name.
//!
//! Everything is streamed in one pass, through small buffers, into [`Gaussians`], and every Gaussian
//! is checked before anyone sees one. In memory they take about what an uncompressed file takes; a
//! compressed PLY of 16 bytes per Gaussian becomes columns of 68, as if the scene came uncompressed.

pub mod axes;
pub mod cameras;
mod file;
mod hashing;
mod ply;
mod safetensors;
pub mod validate;

use std::io::{self, BufRead, BufReader};
use std::path::Path;

use crate::config;
use crate::scene::Gaussians;

pub use axes::Axes;
pub use file::{FileError, read_whole};

use hashing::Hashing;

/// Told about bytes done and bytes in all.
pub type Progress<'a> = &'a mut dyn FnMut(u64, u64);

/// Why a file was refused.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// It cannot be read, or is no regular file.
    #[error(transparent)]
    File(#[from] FileError),
    /// Neither of the formats.
    #[error(
        "the file starts with {start:?}: neither PLY (\"ply\") nor safetensors (header length, \
         \"{{\"); convert it to one of them"
    )]
    UnknownFormat {
        /// Its first bytes, as text.
        start: String,
    },
    /// A header cannot be understood or is not that of a Gaussian scene.
    #[error("{format} header, {place}: {reason}")]
    Header {
        /// The format.
        format: &'static str,
        /// Where in the header, as `line 3` or `tensor means`.
        place: String,
        /// What is wrong and what must hold instead.
        reason: String,
    },
    /// The header promises another file size.
    #[error(
        "{format} body: the header promises {promised} bytes ({content}), the file holds {held}; \
         it is {}: write or copy it again",
        if held < promised { "truncated" } else { "oversized" }
    )]
    Size {
        /// The format.
        format: &'static str,
        /// Bytes that must follow the header.
        promised: u128,
        /// Bytes that do.
        held: u128,
        /// The count and size that led to the promise.
        content: String,
    },
    /// More than a twin can order.
    #[error(
        "{count} Gaussians; at most {} fit one import: split the scene",
        config::IMPORT_GAUSSIANS
    )]
    TooMany {
        /// How many.
        count: u64,
    },
    /// A Gaussian that no renderer can draw.
    #[error("Gaussian {index}: {field} is {value}; {must}")]
    Value {
        /// Which one, from 0.
        index: usize,
        /// The field, as the file calls it.
        field: String,
        /// The refused value.
        value: String,
        /// What must hold instead.
        must: &'static str,
    },
    /// `--axes` or `--scale` cannot be used.
    #[error("{option} {given:?}: {reason}")]
    Frame {
        /// The option.
        option: &'static str,
        /// What was given.
        given: String,
        /// What is wrong and what must hold instead.
        reason: String,
    },
}

impl From<io::Error> for IngestError {
    fn from(error: io::Error) -> Self {
        Self::File(error.into())
    }
}

/// Reads a scene file: INRIA PLY, PlayCanvas compressed PLY, or safetensors with gsplat's names.
///
/// Axes and unit stay the file's; [`Axes::apply`] changes them.
///
/// # Errors
/// The file is of no known format, damaged, or holds a Gaussian outside [`validate`]'s bounds.
pub fn read(path: &Path, progress: Progress<'_>) -> Result<Gaussians, IngestError> {
    read_hashed(path, progress).map(|(gaussians, _)| gaussians)
}

/// The same, and the BLAKE3 of the bytes that were read, 64 lower-case hex digits: which source a
/// twin was made of, whatever happens to the file meanwhile.
///
/// # Errors
/// As [`read`].
pub fn read_hashed(
    path: &Path,
    progress: Progress<'_>,
) -> Result<(Gaussians, String), IngestError> {
    let (file, file_bytes) = file::open(path)?;
    let mut input = BufReader::with_capacity(BUFFER_BYTES, Hashing::new(file));
    let start = input.fill_buf()?;
    let gaussians = if start.starts_with(b"ply\n") || start.starts_with(b"ply\r\n") {
        ply::read(&mut input, file_bytes, progress)?
    } else if start.get(8) == Some(&b'{') {
        safetensors::read(&mut input, file_bytes, progress)?
    } else {
        let start = String::from_utf8_lossy(&start[..start.len().min(9)]).into_owned();
        return Err(IngestError::UnknownFormat { start });
    };
    io::copy(&mut input, &mut io::sink())?;
    Ok((gaussians, input.into_inner().finish()))
}

/// Bytes read at once.
const BUFFER_BYTES: usize = 256 << 10;

/// Refuses counts that a twin could not order.
fn check_count(count: u64) -> Result<usize, IngestError> {
    match usize::try_from(count) {
        Ok(fits) if count <= config::IMPORT_GAUSSIANS => Ok(fits),
        _ => Err(IngestError::TooMany { count }),
    }
}
