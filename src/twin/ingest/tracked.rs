//! Tracked objects: Gaussians of each moving object of a recorded drive, in the object's own axes.
//!
//! Two formats have them. NuRec has layers with `gaussian_cuboid_ids`, the index of each Gaussian's
//! track in `obj_track_ids`; their positions are relative to the middle of the track's cuboid (x
//! forward, y left, z up). And drivestudio has RigidNodes, which
//! `python -m wildcity.convert --model RigidNodes` writes as safetensors with the tensor
//! `point_ids`. A static reading of the file leaves them out, since they have no fixed place.

use std::io::BufReader;
use std::path::Path;

use super::hash_reader::HashReader;
use super::objects::{self, TrackedObject};
use super::unpack_budget::UnpackBudget;
use super::{BUFFER_BYTES, Format, IngestError, Progress, ReadLimits, archive, file, safetensors};
use crate::limits::SCENE_PART_BYTES;

/// Reads the tracked objects of a file, in order of their tracks, and the file's BLAKE3 in hex.
///
/// # Errors
/// The file has none, is of a format without them, or is damaged.
pub fn read_tracked(
    path: &Path,
    progress: Progress<'_>,
) -> Result<(Vec<TrackedObject>, String), IngestError> {
    let limits = ReadLimits::for_own_file();
    let (opened, file_bytes) = file::open(path)?;
    let mut input =
        BufReader::with_capacity(BUFFER_BYTES, HashReader::new(opened, limits.stop.clone()));
    let found = match Format::detect(std::io::BufRead::fill_buf(&mut input)?)? {
        Format::Safetensors => {
            let (gaussians, ids) = safetensors::read_tracked(&mut input, file_bytes, progress)?;
            objects::split(&gaussians, &ids, |id| Some(id.to_string()))
        }
        Format::Zip => {
            let bytes = file::read_at_most(&mut input, file_bytes, SCENE_PART_BYTES)?;
            progress(file_bytes, file_bytes);
            archive::read_tracked(bytes, UnpackBudget::new(&limits))?
        }
        _ => Vec::new(),
    };
    // The hash is of all bytes, and a reader may stop before the end.
    std::io::copy(&mut input, &mut std::io::sink())?;
    if found.is_empty() {
        return Err(IngestError::Body {
            format: "file",
            place: "tracked objects".into(),
            reason: "there are none; NuRec (.usdz) and safetensors with point_ids may have some"
                .into(),
        });
    }
    Ok((found, input.into_inner().finish()))
}
