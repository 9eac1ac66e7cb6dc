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
use super::{IngestError, check_count, nurec, sog};

/// Reads the scene of an archive within a budget of nothing read: all payloads of NuRec in it, or
/// else the SOG whose description is in the fewest folders.
pub(super) fn read(
    bytes: Vec<u8>,
    budget: UnpackBudget,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let mut archive = Archive::open(bytes, budget)?;
    let payloads = archive.payloads();
    if !payloads.is_empty() {
        archive.warn_layers(reading)?;
        // 3dgrut splits a large scene into partitions, one payload each.
        let mut all = Gaussians::default();
        for name in payloads {
            let payload = archive.read(&name, limits::SCENE_PART_BYTES)?;
            all.append(&nurec::read(&payload, archive.budget(), reading)?);
            check_count(all.len() as u64)?;
        }
        return Ok(all);
    }
    let descriptions = archive.find(|name| sog::DESCRIPTIONS.contains(&name));
    let Some(name) = descriptions.first() else {
        let reason = match archive.find(|name| name == "data.pkl")[..] {
            [_, ..] => "it is a checkpoint of PyTorch: convert it to safetensors with \
                        python -m wildcity.convert CKPT.pt OUT.safetensors, and read OUT.safetensors"
                .into(),
            [] => "it holds no meta.json or lod-meta.json, as SOG does, and no .nurec, as USDZ of NuRec \
                     does".into(),
        };
        return Err(error("directory", reason));
    };
    check_one_scene(name, &descriptions[1..], reading)?;
    let folder = name.rfind('/').map_or("", |slash| &name[..=slash]).to_owned();
    let json = archive.read(name, limits::SCENE_JSON_BYTES)?;
    sog::read(&json, &folder, &mut archive, reading)
}

/// Reads the tracked objects of a NuRec archive; none of any other archive.
pub(super) fn read_tracked(
    bytes: Vec<u8>,
    budget: UnpackBudget,
) -> Result<Vec<TrackedObject>, IngestError> {
    let mut archive = Archive::open(bytes, budget)?;
    let mut objects: Vec<TrackedObject> = Vec::new();
    for name in archive.payloads() {
        let payload = archive.read(&name, limits::SCENE_PART_BYTES)?;
        for object in nurec::read_tracked(&payload, archive.budget())? {
            // Partitions may share an object.
            match objects.iter_mut().find(|known| known.track == object.track) {
                Some(known) => known.gaussians.append(&object.gaussians),
                None => objects.push(object),
            }
        }
    }
    Ok(objects)
}

/// Refuses an archive with several scenes, of which only one would be read; scenes in subfolders of
/// the one that is read are named. Those of a streamed SOG are its parts.
fn check_one_scene(
    name: &str,
    others: &[String],
    reading: &mut Reading,
) -> Result<(), IngestError> {
    let is_streamed = name.ends_with(sog::STREAMED);
    let is_separate = |other: &&String| !is_streamed || other.ends_with(sog::STREAMED);
    let others: Vec<&str> = others.iter().filter(is_separate).map(String::as_str).collect();
    let beside = others.iter().find(|other| depth(other) == depth(name));
    if let Some(beside) = beside {
        let reason = format!("it holds several scenes: {name}, {beside}; give one archive each");
        return Err(error("directory", reason));
    }
    if !others.is_empty() {
        reading.warn_skipped("further scenes in the archive", &others);
    }
    Ok(())
}

/// The number of folders of a name.
fn depth(name: &str) -> usize {
    name.matches('/').count()
}

/// The start of the names of transforms in a USD layer.
const XFORM: &[u8] = b"xformOp:";

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

    /// The files with a name that, without folders, satisfies the condition; first those in the
    /// fewest folders.
    fn find(&self, is_wanted: impl Fn(&str) -> bool) -> Vec<String> {
        let names = self.zip.file_names();
        let wanted = names.filter(|name| is_wanted(name.rsplit('/').next().unwrap_or(name)));
        let mut found: Vec<String> = wanted.map(str::to_owned).collect();
        found.sort_by(|a, b| (depth(a), a).cmp(&(depth(b), b)));
        found
    }

    /// The payloads of NuRec.
    fn payloads(&self) -> Vec<String> {
        self.find(|name| name.ends_with(".nurec"))
    }

    /// Warns of layers of USD that may place the payloads. 3dgrut writes them as text; what a
    /// binary one says is unknown.
    fn warn_layers(&mut self, reading: &mut Reading) -> Result<(), IngestError> {
        let mut placing = self.find(|name| name.ends_with(".usdc") || name.ends_with(".usd"));
        for name in self.find(|name| name.ends_with(".usda")) {
            let bytes = self.read(&name, limits::SCENE_PART_BYTES)?;
            // Searched and not parsed: any transform in the layer is reason enough to warn.
            if bytes.windows(XFORM.len()).any(|part| part == XFORM) {
                placing.push(name);
            }
        }
        if !placing.is_empty() {
            let names: Vec<&str> = placing.iter().map(String::as_str).collect();
            reading.warn_skipped("transforms of USD layers (the axes are the payload's)", &names);
        }
        Ok(())
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
        // Grows with what is read, because the size in the directory is only a claim.
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
    // The comment of the record takes at most 65,535 bytes.
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
