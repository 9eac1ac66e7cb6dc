//! Outside formats: one file each, picked by what a file starts with, never by its name.
//!
//! What can be streamed is, in one pass, through small buffers, into [`Gaussians`]; archives, images
//! and glTF buffers are held whole, up to limits. Every Gaussian is checked before anyone sees one.
//! In memory they take about what an uncompressed file takes; a compressed PLY of 16 bytes per
//! Gaussian becomes columns of 68, as if the scene came uncompressed.

mod activation;
mod archive;
pub mod axes;
pub mod cameras;
mod file;
mod gltf;
mod hash_reader;
mod ksplat;
mod nurec;
mod ply;
mod progress;
mod safetensors;
mod scene_files;
pub mod sky;
mod sog;
mod splat;
mod spz;
mod unpack_budget;

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;

use crate::limits;
use wildcity_scene::Gaussians;
use wildcity_scene::sky::SkyError;

pub use axes::Axes;
pub use file::{FileError, read_whole};
pub use wildcity_scene::validate::{self, BadGaussian, BadGaussians};

use hash_reader::HashReader;
use progress::ProgressReader;
use scene_files::Folder;

/// Called with bytes done and bytes in all.
pub type Progress<'a> = &'a mut dyn FnMut(u64, u64);

/// Why a file was refused.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// It cannot be read, or is no regular file.
    #[error(transparent)]
    File(#[from] FileError),
    /// None of the formats.
    #[error(
        "the file starts with {start:?}, as no format does that is read: PLY, safetensors, SPZ, \
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
        /// As it is named.
        name: String,
        /// Why it cannot be read.
        cause: FileError,
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
    /// The body contradicts its header or itself.
    #[error("{format} body, {place}: {reason}")]
    Body {
        /// The format.
        format: &'static str,
        /// Where in the body, as `positions` or `means_l.webp`.
        place: String,
        /// What is wrong and what must hold instead.
        reason: String,
    },
    /// Compressed further than any scene.
    #[error(
        "{format}, {place}: {packed} bytes unpack to {unpacked}; of so few at most {} do in a scene: \
         convert it to PLY, if it is one",
        unpack_budget::limit_bytes(*packed)
    )]
    DecompressionBomb {
        /// The format.
        format: &'static str,
        /// Where in the file.
        place: String,
        /// Compressed bytes.
        packed: u64,
        /// Bytes that would come of them.
        unpacked: u128,
    },
    /// More than a twin can order.
    #[error(
        "{count} Gaussians; at most {} fit one import: split the scene",
        limits::IMPORT_GAUSSIANS
    )]
    TooMany {
        /// How many.
        count: u64,
    },
    /// Gaussians that no renderer can draw.
    #[error("{0}")]
    Values(#[from] BadGaussians),
    /// A sky that cannot be drawn.
    #[error("sky: {0}")]
    Sky(#[from] SkyError),
    /// `--axes` or `--scale` cannot be used.
    #[error("{option} {given:?}: {reason}")]
    InvalidAxes {
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

/// Reads a scene of any of the formats.
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
/// Of a scene in several files it is the BLAKE3 of their hashes in hex, a line each: first the given
/// file, then those that it names, in the order in which they are named. `b3sum --no-names FILE.. |
/// b3sum` says the same.
///
/// # Errors
/// As [`read`].
pub fn read_hashed(
    path: &Path,
    progress: Progress<'_>,
) -> Result<(Gaussians, String), IngestError> {
    let (file, file_bytes) = file::open(path)?;
    let mut input = BufReader::with_capacity(BUFFER_BYTES, HashReader::new(file));
    let gaussians = match Format::of(input.fill_buf()?)? {
        Format::Json => return read_parts(path, input, progress, MultiFileFormat::Json),
        Format::Glb => return read_parts(path, input, progress, MultiFileFormat::Glb),
        Format::Ply => ply::read(&mut input, file_bytes, progress)?,
        Format::Safetensors => safetensors::read(&mut input, file_bytes, progress)?,
        Format::Spz => {
            spz::read(ProgressReader::new(&mut input, file_bytes, progress), file_bytes)?
        }
        Format::Gzip => {
            spz::read_gzip(ProgressReader::new(&mut input, file_bytes, progress), file_bytes)?
        }
        Format::Splat => {
            splat::read(ProgressReader::new(&mut input, file_bytes, progress), file_bytes)?
        }
        Format::Ksplat => {
            ksplat::read(ProgressReader::new(&mut input, file_bytes, progress), file_bytes)?
        }
        Format::Zip => {
            let archive = read_whole_part(ProgressReader::new(&mut input, file_bytes, progress))?;
            archive::read(archive)?
        }
    };
    io::copy(&mut input, &mut io::sink())?;
    Ok((gaussians, input.into_inner().finish()))
}

/// What may name other files.
enum MultiFileFormat {
    Json,
    Glb,
}

/// Reads a scene whose first file may name others.
fn read_parts(
    path: &Path,
    mut input: BufReader<HashReader<File>>,
    progress: Progress<'_>,
    format: MultiFileFormat,
) -> Result<(Gaussians, String), IngestError> {
    let limit_bytes = match format {
        MultiFileFormat::Json => limits::SCENE_JSON_BYTES,
        MultiFileFormat::Glb => limits::SCENE_PART_BYTES,
    };
    let first = file::read_at_most(&mut input, limit_bytes)?;
    let mut folder = Folder::new(path, first.len() as u64, input.into_inner().finish(), progress);
    let gaussians = match format {
        MultiFileFormat::Glb => gltf::read_glb(&first, &mut folder)?,
        MultiFileFormat::Json if gltf::is_likely(&first) => gltf::read(&first, None, &mut folder)?,
        MultiFileFormat::Json => sog::read(&first, "", &mut folder)?,
    };
    Ok((gaussians, folder.finish()))
}

/// Everything that is left, held in memory.
fn read_whole_part(input: impl Read) -> Result<Vec<u8>, IngestError> {
    Ok(file::read_at_most(input, limits::SCENE_PART_BYTES)?)
}

/// What a file is.
#[derive(Clone, Copy, Debug)]
enum Format {
    Ply,
    Safetensors,
    Spz,
    Gzip,
    Splat,
    Ksplat,
    Zip,
    Json,
    Glb,
}

impl Format {
    /// From the first bytes of a file.
    fn of(start: &[u8]) -> Result<Self, IngestError> {
        Ok(match start {
            [b'p', b'l', b'y', b'\n' | b'\r', ..] => Self::Ply,
            [b'N', b'G', b'S', b'P', ..] => Self::Spz,
            [0x1f, 0x8b, ..] => Self::Gzip,
            [b'P', b'K', 3, 4, ..] => Self::Zip,
            [b'g', b'l', b'T', b'F', ..] => Self::Glb,
            // Version 0.1, and two bytes that are not used.
            [0, 1, 0, 0, ..] => Self::Ksplat,
            // A safetensors file starts with a length, of which at most three bytes are not zero.
            _ if start.trim_ascii_start().starts_with(b"{")
                && !start.iter().take(8).any(|&b| b == 0) =>
            {
                Self::Json
            }
            _ if start.get(8) == Some(&b'{') => Self::Safetensors,
            // It has no magic number, so it comes last.
            _ if splat::is_likely(start) => Self::Splat,
            _ => {
                let start = String::from_utf8_lossy(&start[..start.len().min(9)]).into_owned();
                return Err(IngestError::UnknownFormat { start });
            }
        })
    }
}

/// Bytes read at once.
const BUFFER_BYTES: usize = 256 << 10;

/// Refuses counts that a twin could not order.
fn check_count(count: u64) -> Result<usize, IngestError> {
    match usize::try_from(count) {
        Ok(fits) if count <= limits::IMPORT_GAUSSIANS => Ok(fits),
        _ => Err(IngestError::TooMany { count }),
    }
}
