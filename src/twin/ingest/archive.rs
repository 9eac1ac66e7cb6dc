//! Scenes in a zip archive: SOG (one scene, or streamed) and NuRec's USDZ.

use std::io::{Cursor, Read};

use zip::ZipArchive;
use zip::result::ZipError;

use crate::limits;
use wildcity_scene::Gaussians;

use super::notes::Reading;
use super::objects::TrackedObject;
use super::scene_files::SceneFiles;
use super::unpack_budget::UnpackBudget;
use super::{IngestError, nurec, sog};

/// Reads the scene of an archive within a budget of nothing read, found by the first file in it of
/// a known name.
pub(super) fn read(
    bytes: Vec<u8>,
    budget: UnpackBudget,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let mut archive = Archive::open(bytes, budget)?;
    if let Some(name) = archive.find(|name| name.ends_with(".nurec")) {
        let payload = archive.read(&name, limits::SCENE_PART_BYTES)?;
        return nurec::read(&payload, archive.budget(), reading);
    }
    let Some(name) = archive.find(|name| sog::DESCRIPTIONS.contains(&name)) else {
        let reason = match archive.find(|name| name == "data.pkl") {
            Some(_) => "it is a checkpoint of PyTorch: convert it to safetensors with \
                        python -m wildcity.convert"
                .into(),
            None => "it holds no meta.json or lod-meta.json, as SOG does, and no .nurec, as USDZ of NuRec \
                     does".into(),
        };
        return Err(error("directory", reason));
    };
    let folder = name.rfind('/').map_or("", |slash| &name[..=slash]).to_owned();
    let json = archive.read(&name, limits::SCENE_JSON_BYTES)?;
    sog::read(&json, &folder, &mut archive, reading)
}

/// Reads the tracked objects of a NuRec archive; none of any other archive.
pub(super) fn read_tracked(
    bytes: Vec<u8>,
    budget: UnpackBudget,
) -> Result<Vec<TrackedObject>, IngestError> {
    let mut archive = Archive::open(bytes, budget)?;
    let Some(name) = archive.find(|name| name.ends_with(".nurec")) else { return Ok(Vec::new()) };
    let payload = archive.read(&name, limits::SCENE_PART_BYTES)?;
    nurec::read_tracked(&payload, archive.budget())
}

/// An archive in memory.
struct Archive {
    zip: ZipArchive<Cursor<Vec<u8>>>,
    budget: UnpackBudget,
}

impl Archive {
    fn open(bytes: Vec<u8>, mut budget: UnpackBudget) -> Result<Self, IngestError> {
        budget.read(bytes.len() as u64);
        check_end(&bytes)?;
        let zip =
            ZipArchive::new(Cursor::new(bytes)).map_err(|e| error("directory", damaged(&e)))?;
        Ok(Self { zip, budget })
    }

    /// The file with a name that, without folders, satisfies the condition; of several, the one in
    /// the fewest folders.
    fn find(&self, is_wanted: impl Fn(&str) -> bool) -> Option<String> {
        let names = self.zip.file_names();
        let wanted = names.filter(|name| is_wanted(name.rsplit('/').next().unwrap_or(name)));
        wanted.min_by_key(|name| (name.matches('/').count(), *name)).map(str::to_owned)
    }
}

impl SceneFiles for Archive {
    fn read(&mut self, name: &str, limit_bytes: u64) -> Result<Vec<u8>, IngestError> {
        let file = self.zip.by_name(name).map_err(|e| error(name, damaged(&e)))?;
        let size = file.size();
        if size > limit_bytes {
            return Err(error(name, format!("{size} bytes; at most {limit_bytes} are read")));
        }
        self.budget.unpack("zip", name, size.into())?;
        let mut bytes = Vec::new();
        // One byte more, so that the checksum is compared, and a file longer than its entry says is
        // refused.
        let read = file.take(size + 1).read_to_end(&mut bytes);
        read.map_err(|e| error(name, format!("it is damaged: {e}; copy the archive again")))?;
        if bytes.len() as u64 != size {
            let held = bytes.len();
            return Err(error(name, format!("the directory says {size} bytes, there are {held}")));
        }
        Ok(bytes)
    }

    fn budget(&mut self) -> &mut UnpackBudget {
        &mut self.budget
    }
}

/// Checks that nothing follows the archive: the file ends with its last record, whose comment has
/// the stated length.
fn check_end(bytes: &[u8]) -> Result<(), IngestError> {
    const RECORD_BYTES: usize = 22;
    let is_record_at = |at: usize| {
        let record = &bytes[at..];
        let comment = usize::from(u16::from_le_bytes([record[20], record[21]]));
        record.starts_with(b"PK\x05\x06") && record.len() == RECORD_BYTES + comment
    };
    let last = bytes.len().saturating_sub(RECORD_BYTES);
    let first = last.saturating_sub(usize::from(u16::MAX));
    if bytes.len() >= RECORD_BYTES && (first..=last).rev().any(is_record_at) {
        Ok(())
    } else {
        let reason = "is not at the end of the file: the file is truncated, or something follows the archive";
        Err(error("the end of the directory", reason.into()))
    }
}

fn damaged(cause: &ZipError) -> String {
    match cause {
        ZipError::FileNotFound => "is not in the archive".into(),
        cause => format!("{cause}; copy the archive again"),
    }
}

fn error(place: &str, reason: String) -> IngestError {
    IngestError::Body { format: "zip", place: place.into(), reason }
}
