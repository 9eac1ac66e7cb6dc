//! Why a file was refused.

use std::io;

use crate::limits;
use wildcity_scene::sky::SkyError;
use wildcity_scene::validate::BadGaussians;

use super::file::FileError;
use super::unpack_budget::limit_bytes;

/// Why a file was refused.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// It cannot be read, or is not a regular file.
    #[error(transparent)]
    File(#[from] FileError),
    /// It has none of the known formats.
    #[error(
        "the file starts with {start:?}, which is none of the formats that can be read: PLY, safetensors, SPZ, \
         SOG, KHR_gaussian_splatting, NuRec, \
         .ksplat, .splat; convert it to one of them, or copy it again"
    )]
    UnknownFormat {
        /// Its first bytes, as text.
        start: String,
    },
    /// A file that the given one names.
    #[error("part {name:?}: {cause}")]
    Part {
        /// The name in the file that refers to it.
        name: String,
        /// Why it cannot be read.
        cause: FileError,
    },
    /// A header cannot be parsed, or is not that of a Gaussian scene.
    #[error("{format} header, {place}: {reason}")]
    Header {
        format: &'static str,
        /// Where in the header, such as `line 3` or `tensor means`.
        place: String,
        /// The error, and the accepted values.
        reason: String,
    },
    /// The header implies another file size.
    #[error(
        "{format} body: the header promises {promised} bytes ({content}), the file holds {held}; \
         it is {}: write or copy it again",
        if held < promised { "truncated" } else { "oversized" }
    )]
    Size {
        format: &'static str,
        /// Bytes that must follow the header.
        promised: u128,
        /// Bytes that follow it.
        held: u128,
        /// The counts and sizes that `promised` was computed from.
        content: String,
    },
    /// The body contradicts its header or itself.
    #[error("{format} body, {place}: {reason}")]
    Body {
        format: &'static str,
        /// Where in the body, such as `positions` or `means_l.webp`.
        place: String,
        /// The error, and the accepted values.
        reason: String,
    },
    /// Compressed data expands to more than any scene does.
    #[error(
        "{format}, {place}: {packed} bytes unpack to {unpacked}; for a scene at most {} are expected: \
         convert it to PLY, if it is one",
        limit_bytes(*packed)
    )]
    DecompressionBomb {
        format: &'static str,
        /// Where in the file.
        place: String,
        packed: u64,
        /// Bytes that they would unpack to.
        unpacked: u128,
    },
    /// The content needs more memory than the reader may use.
    #[error("unpacking it takes {needed} bytes of memory; {limit} may be used: split the scene")]
    TooMuchMemory {
        /// Bytes that it needs, as far as known.
        needed: u128,
        /// Bytes that may be used.
        limit: u64,
    },
    /// A level of detail was asked for, of a file that has none.
    #[error(
        "level {level} is asked for, and only a streamed SOG (lod-meta.json) has levels: leave it out"
    )]
    NoLevels { level: u32 },
    /// A level of detail was asked for that a streamed SOG does not have.
    #[error("there is no level {level}; the levels are {}, 0 being the finest", names(levels))]
    NoLevel {
        level: u32,
        /// Those that there are, in order.
        levels: Vec<u32>,
    },
    /// Reading was to stop.
    #[error("reading was stopped")]
    Stopped,
    /// More Gaussians than a twin can hold.
    #[error(
        "{count} Gaussians; at most {} fit one import: split the scene",
        limits::IMPORT_GAUSSIANS
    )]
    TooMany { count: u64 },
    /// Gaussians that no renderer can draw.
    #[error(transparent)]
    Values(#[from] BadGaussians),
    /// Gaussians that cannot be drawn were to be left out, and there are no others.
    #[error("none of its {count} Gaussians can be drawn, so that leaving them out leaves nothing")]
    AllDropped { count: u64 },
    /// A sky that cannot be drawn.
    #[error("sky: {0}")]
    Sky(SkyError),
    /// `--axes` or `--scale` cannot be used.
    #[error("{option} {given:?}: {reason}")]
    InvalidAxes {
        option: &'static str,
        given: String,
        /// The error, and the accepted values.
        reason: String,
    },
}

fn names(levels: &[u32]) -> String {
    levels.iter().map(u32::to_string).collect::<Vec<_>>().join(", ")
}

// Not `#[from]`, which would make it the source, too, and a message with its sources would say it
// twice.
impl From<SkyError> for IngestError {
    fn from(error: SkyError) -> Self {
        Self::Sky(error)
    }
}

impl From<io::Error> for IngestError {
    fn from(error: io::Error) -> Self {
        Self::File(error.into())
    }
}

/// Checks that a twin can hold this many Gaussians.
///
/// # Errors
/// [`IngestError::TooMany`].
pub(super) fn check_count(count: u64) -> Result<usize, IngestError> {
    match usize::try_from(count) {
        Ok(fits) if count <= limits::IMPORT_GAUSSIANS => Ok(fits),
        _ => Err(IngestError::TooMany { count }),
    }
}
