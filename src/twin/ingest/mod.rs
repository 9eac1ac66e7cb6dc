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
mod error;
mod file;
mod gltf;
mod hash_reader;
mod ksplat;
mod nurec;
mod objects;
mod ply;
mod progress;
mod safetensors;
mod scene_files;
pub mod sky;
mod sog;
mod splat;
mod spz;
mod tracked;
mod unpack_budget;

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;

use crate::limits;
use wildcity_scene::Gaussians;

pub use axes::Axes;
pub use error::IngestError;
pub use file::{FileError, read_whole};
pub use objects::TrackedObject;
pub use progress::Progress;
pub use tracked::read_tracked;
pub use wildcity_scene::validate::{self, BadGaussian, BadGaussians};

use error::check_count;
use hash_reader::HashReader;
use progress::ProgressReader;
use scene_files::Folder;

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
/// given file, then the files that it names, in the order in which they are named. `b3sum
/// --no-names FILE.. | b3sum` prints the same.
///
/// # Errors
/// As [`read`].
pub fn read_hashed(
    path: &Path,
    progress: Progress<'_>,
) -> Result<(Gaussians, String), IngestError> {
    read_with(path, limits::MESH_GAUSSIANS, progress)
}

/// As [`read_hashed`], with about `mesh_gaussians` Gaussians for the triangles of a mesh; triangles smaller than one
/// Gaussian's share add more. Scenes of Gaussians keep theirs.
///
/// # Errors
/// As [`read`].
pub fn read_with(
    path: &Path,
    mesh_gaussians: u32,
    progress: Progress<'_>,
) -> Result<(Gaussians, String), IngestError> {
    let (file, file_bytes) = file::open(path)?;
    let mut input = BufReader::with_capacity(BUFFER_BYTES, HashReader::new(file));
    let gaussians = match Format::of(input.fill_buf()?)? {
        Format::Json => {
            return read_parts(path, input, progress, MultiFileFormat::Json, mesh_gaussians);
        }
        Format::Glb => {
            return read_parts(path, input, progress, MultiFileFormat::Glb, mesh_gaussians);
        }
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

/// A format in which the first file may name others.
enum MultiFileFormat {
    Json,
    Glb,
}

/// Reads a scene in such a format.
fn read_parts(
    path: &Path,
    mut input: BufReader<HashReader<File>>,
    progress: Progress<'_>,
    format: MultiFileFormat,
    mesh_gaussians: u32,
) -> Result<(Gaussians, String), IngestError> {
    let limit_bytes = match format {
        MultiFileFormat::Json => limits::SCENE_JSON_BYTES,
        MultiFileFormat::Glb => limits::SCENE_PART_BYTES,
    };
    let first = file::read_at_most(&mut input, limit_bytes)?;
    let mut folder = Folder::new(path, first.len() as u64, input.into_inner().finish(), progress);
    folder = folder.with_mesh_gaussians(mesh_gaussians);
    let gaussians = match format {
        MultiFileFormat::Glb => gltf::read_glb(&first, &mut folder)?,
        MultiFileFormat::Json if gltf::is_likely(&first) => gltf::read(&first, None, &mut folder)?,
        MultiFileFormat::Json => sog::read(&first, "", &mut folder)?,
    };
    Ok((gaussians, folder.finish()))
}

/// Reads the rest of the input into memory.
fn read_whole_part(input: impl Read) -> Result<Vec<u8>, IngestError> {
    Ok(file::read_at_most(input, limits::SCENE_PART_BYTES)?)
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
    fn of(start: &[u8]) -> Result<Self, IngestError> {
        Ok(match start {
            [b'p', b'l', b'y', b'\n' | b'\r', ..] => Self::Ply,
            [b'N', b'G', b'S', b'P', ..] => Self::Spz,
            [0x1f, 0x8b, ..] => Self::Gzip,
            [b'P', b'K', 3, 4, ..] => Self::Zip,
            [b'g', b'l', b'T', b'F', ..] => Self::Glb,
            // Version 0.1, and two unused bytes.
            [0, 1, 0, 0, ..] => Self::Ksplat,
            // A safetensors file starts with a length of eight bytes, at most three of which are
            // not zero. So JSON has no zero among its first eight bytes, and safetensors has.
            _ if start.trim_ascii_start().starts_with(b"{")
                && !start.iter().take(8).any(|&b| b == 0) =>
            {
                Self::Json
            }
            _ if start.get(8) == Some(&b'{') => Self::Safetensors,
            // Last, because it has no magic number.
            _ if splat::is_likely(start) => Self::Splat,
            _ => {
                let start = String::from_utf8_lossy(&start[..start.len().min(9)]).into_owned();
                return Err(IngestError::UnknownFormat { start });
            }
        })
    }
}

/// Size of the read buffer, in bytes.
const BUFFER_BYTES: usize = 256 << 10;
