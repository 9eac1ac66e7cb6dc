//! Reads scenes, skies, and camera lists from the formats of other programs, one module per format.
//! The format is detected from the first bytes of a file, not from its name.
//!
//! Formats that can be streamed are read in one pass, through small buffers, into [`Gaussians`].
//! Archives, images, and glTF buffers are held in memory whole, up to limits. Every Gaussian is
//! checked before it is returned. In memory, Gaussians take about as much as in an uncompressed
//! file: a compressed PLY of 16 bytes per Gaussian becomes columns of 68 bytes.
//!
//! Files are read through a buffer, not memory-mapped: the one pass that fills the columns also
//! finds damage and computes the hash, and a file that another process shortens cannot kill this
//! one. So no `unsafe` is needed.

mod activation;
mod archive;
pub mod axes;
pub mod cameras;
pub mod capture;
mod classes;
mod error;
mod file;
mod gltf;
mod hash_reader;
mod ksplat;
mod notes;
mod nurec;
mod objects;
mod ply;
mod progress;
mod read_limits;
mod safetensors;
mod scene_files;
pub mod sky;
mod sog;
mod splat;
mod spz;
mod tracked;
mod unpack_budget;

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::Path;

use crate::limits::{SCENE_JSON_BYTES, SCENE_PART_BYTES};
use wildcity_scene::Gaussians;

pub use axes::Axes;
pub use error::IngestError;
pub use file::{FileError, read_whole};
pub use notes::{Antialiasing, FileAxes, FileNotes};
pub use objects::TrackedObject;
pub use ply::write_ply;
pub use progress::Progress;
pub use read_limits::{ReadLimits, StopFlag};
pub use scene_files::{ListedFiles, is_below_folder};
pub use sog::{DESCRIPTIONS as SOG_DESCRIPTIONS, SogFiles};
pub use tracked::read_tracked;
pub use wildcity_scene::validate::{self, BadGaussian, BadGaussians};

use error::check_count;
use hash_reader::HashReader;
use notes::Reading;
use progress::ProgressReader;
use scene_files::PartFiles;
use unpack_budget::UnpackBudget;

/// Reads a scene of any of the formats.
///
/// Axes and unit stay the file's; [`Axes::apply`] changes them.
///
/// # Errors
/// The file is of no known format, damaged, or holds a Gaussian outside [`validate`]'s bounds.
pub fn read(path: &Path, progress: Progress<'_>) -> Result<Gaussians, IngestError> {
    read_hashed(path, progress).map(|(gaussians, _)| gaussians)
}

/// As [`read`], and the BLAKE3 of the bytes that were read, 64 lower-case hex digits. It identifies
/// the source of a twin, even if the file is changed later.
///
/// For a scene in several files it is the BLAKE3 of their hashes in hex, one per line: first the
/// given file, then the files that it names, in the order in which they are first named. `b3sum
/// --no-names FILE.. | b3sum` prints the same.
///
/// # Errors
/// As [`read`].
pub fn read_hashed(
    path: &Path,
    progress: Progress<'_>,
) -> Result<(Gaussians, String), IngestError> {
    let limits = ReadLimits::for_own_file();
    read_limited(path, &limits, progress).map(|read| (read.gaussians, read.hash))
}

/// A scene that was read.
#[derive(Debug)]
pub struct ReadScene {
    /// The Gaussians, in the axes and unit of the file.
    pub gaussians: Gaussians,
    /// BLAKE3 of what was read; see [`read_hashed`].
    pub hash: String,
    /// The names of the files that the given one names.
    pub parts: BTreeSet<String>,
    /// What the files say besides the Gaussians.
    pub notes: FileNotes,
}

/// As [`read_hashed`], within limits.
///
/// # Errors
/// As [`read`], and what exceeds a limit.
pub fn read_limited(
    path: &Path,
    limits: &ReadLimits<'_>,
    progress: Progress<'_>,
) -> Result<ReadScene, IngestError> {
    let (file, file_bytes) = file::open(path)?;
    // The hash is computed of the bytes as they pass, so that it is of what was read even if the
    // file changes.
    let mut input =
        BufReader::with_capacity(BUFFER_BYTES, HashReader::new(file, limits.stop.clone()));
    let mut reading = Reading::new(limits);
    let reader = &mut reading;
    // Only looks into the buffer: the reader of the format sees the file from its first byte.
    let format = Format::detect(input.fill_buf()?)?;
    format.check_level(limits.level)?;
    let gaussians = match format {
        Format::Json => {
            let parts = PartFiles::new(path, limits, progress);
            return read_parts(input, file_bytes, parts, reading, MultiFileFormat::Json);
        }
        Format::Glb => {
            let parts = PartFiles::new(path, limits, progress);
            return read_parts(input, file_bytes, parts, reading, MultiFileFormat::Glb);
        }
        Format::Ply => ply::read(&mut input, file_bytes, reader, progress)?,
        Format::Safetensors => safetensors::read(&mut input, file_bytes, reader, progress)?,
        Format::Spz => {
            let input = ProgressReader::new(&mut input, file_bytes, progress);
            spz::read(input, file_bytes, UnpackBudget::new(limits), reader)?
        }
        Format::Gzip => {
            let input = ProgressReader::new(&mut input, file_bytes, progress);
            spz::read_gzip(input, file_bytes, UnpackBudget::new(limits), reader)?
        }
        Format::Splat => {
            let input = ProgressReader::new(&mut input, file_bytes, progress);
            splat::read(input, file_bytes, reader)?
        }
        Format::Ksplat => {
            let input = ProgressReader::new(&mut input, file_bytes, progress);
            ksplat::read(input, file_bytes, reader)?
        }
        Format::Zip => {
            let input = ProgressReader::new(&mut input, file_bytes, progress);
            let bytes = file::read_at_most(input, file_bytes, SCENE_PART_BYTES)?;
            archive::read(bytes, UnpackBudget::new(limits), reader)?
        }
    };
    // Readers may stop before the end of the file, and the hash is of all of it.
    io::copy(&mut input, &mut io::sink())?;
    let hash = input.into_inner().finish();
    let notes = check_dropped(&gaussians, reading)?;
    Ok(ReadScene { gaussians, hash, parts: BTreeSet::new(), notes })
}

/// The notes of a scene that was read.
///
/// # Errors
/// All of its Gaussians were left out: the file is no scene, or of another kind than it says. A
/// level is asked for, and the file has none.
fn check_dropped(gaussians: &Gaussians, reading: Reading) -> Result<FileNotes, IngestError> {
    let notes = reading.into_notes()?;
    if gaussians.is_empty() && notes.dropped > 0 {
        return Err(IngestError::AllDropped { count: notes.dropped });
    }
    Ok(notes)
}

/// Whether a file is of a format in which it may name others.
///
/// # Errors
/// It cannot be read, or is not a regular file.
pub fn may_name_others(path: &Path) -> Result<bool, FileError> {
    let (file, _) = file::open(path)?;
    let mut input = BufReader::new(file);
    Ok(matches!(Format::detect(input.fill_buf()?), Ok(Format::Json | Format::Glb)))
}

/// A format in which the first file may name others.
enum MultiFileFormat {
    Json,
    Glb,
}

/// Reads a scene in such a format.
fn read_parts(
    mut input: BufReader<HashReader<File>>,
    file_bytes: u64,
    mut parts: PartFiles<'_>,
    mut reading: Reading,
    format: MultiFileFormat,
) -> Result<ReadScene, IngestError> {
    // JSON is parsed as a whole, so its limit is lower than that of a file with buffers of numbers.
    let limit_bytes = match format {
        MultiFileFormat::Json => SCENE_JSON_BYTES,
        MultiFileFormat::Glb => SCENE_PART_BYTES,
    };
    let first = file::read_at_most(&mut input, file_bytes, limit_bytes)?;
    parts.add(first.len() as u64, input.into_inner().finish());
    let gaussians = match format {
        MultiFileFormat::Glb => gltf::read_glb(&first, &mut parts, &mut reading)?,
        // glTF and SOG are both JSON, and their keys tell them apart.
        MultiFileFormat::Json if gltf::is_likely(&first) => {
            gltf::read(&first, None, &mut parts, &mut reading)?
        }
        MultiFileFormat::Json => sog::read(&first, "", &mut parts, &mut reading)?,
    };
    let notes = check_dropped(&gaussians, reading)?;
    Ok(ReadScene { gaussians, hash: parts.hash(), parts: parts.into_names(), notes })
}

/// The format of a file.
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
    /// Detects the format from the first bytes of a file.
    fn detect(start: &[u8]) -> Result<Self, IngestError> {
        Ok(match start {
            [b'p', b'l', b'y', b'\n' | b'\r', ..] => Self::Ply,
            [b'N', b'G', b'S', b'P', ..] => Self::Spz,
            // The magic number, and the one method of compression.
            [0x1f, 0x8b, 8, ..] => Self::Gzip,
            [b'P', b'K', 3, 4, ..] => Self::Zip,
            [b'g', b'l', b'T', b'F', ..] => Self::Glb,
            // Version 0.1, and two unused bytes.
            [0, 1, 0, 0, ..] => Self::Ksplat,
            _ if is_json(start) => Self::Json,
            _ if is_safetensors(start) => Self::Safetensors,
            // Last, because it has no magic number.
            _ if splat::is_likely(start) => Self::Splat,
            _ => {
                let start = String::from_utf8_lossy(&start[..start.len().min(9)]).into_owned();
                return Err(IngestError::UnknownFormat { start });
            }
        })
    }

    /// Refuses a level of detail, before all of the file is read, if the format has none. A JSON
    /// file or an archive may still be another scene than a streamed SOG.
    fn check_level(self, level: Option<u32>) -> Result<(), IngestError> {
        match (self, level) {
            (_, None) | (Self::Json | Self::Zip, _) => Ok(()),
            (_, Some(level)) => Err(IngestError::NoLevels { level }),
        }
    }
}

/// Whether a file that starts like this is a JSON object: text that begins with a brace, and a name
/// or another brace. A number of a `.splat` file may begin with the same bytes, but 64 bytes of
/// numbers, colours and rotations are not text.
fn is_json(start: &[u8]) -> bool {
    let object = start.trim_ascii_start().strip_prefix(b"{").map(<[u8]>::trim_ascii_start);
    object.is_some_and(|object| matches!(object, [] | [b'"' | b'}', ..]))
        && is_text(&start[..start.len().min(64)])
}

/// Whether bytes are UTF-8 without control characters but white space. The last character may be
/// cut.
fn is_text(bytes: &[u8]) -> bool {
    let is_utf8 = match std::str::from_utf8(bytes) {
        Ok(_) => true,
        Err(error) => error.error_len().is_none(),
    };
    is_utf8 && bytes.iter().all(|byte| !byte.is_ascii_control() || byte.is_ascii_whitespace())
}

/// Whether a file that starts like this is a safetensors file: a length in eight bytes, and JSON of
/// that length.
fn is_safetensors(start: &[u8]) -> bool {
    start.split_first_chunk().is_some_and(|(length, rest)| {
        let length = usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX);
        is_json(&rest[..rest.len().min(length)])
    })
}

/// Size of the read buffer, in bytes.
const BUFFER_BYTES: usize = 256 << 10;
