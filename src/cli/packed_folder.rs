//! A scene of many files as one archive. A push has at most 256 files, and a streamed SOG has nine
//! for each block.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use tempfile::TempDir;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use wildcity_twin::ingest::{SOG_DESCRIPTIONS, SogFiles, is_below_folder, read_whole};
use wildcity_twin::limits::SCENE_JSON_BYTES;

/// Size from which an entry needs the fields of zip64, in bytes.
const LARGE_BYTES: u64 = u32::MAX as u64;

/// An archive that exists until this is dropped.
pub(super) struct PackedFolder {
    path: PathBuf,
    _dir: TempDir,
}

impl PackedFolder {
    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

/// Packs the SOG in a folder, if `path` is a folder, or the only file of a push and describes a
/// SOG. None for any other file. The same files give the same bytes, so that an upload continues
/// where it stopped.
///
/// # Errors
/// The folder has no SOG, or a description in it cannot be read; the archive cannot be written.
pub(super) fn pack(path: &Path, is_only: bool) -> anyhow::Result<Option<PackedFolder>> {
    let described = path.file_name().and_then(|name| SOG_DESCRIPTIONS.iter().find(|d| name == **d));
    let (folder, description) = if path.is_dir() {
        (path, description_in(path)?)
    } else if let Some(name) = described.filter(|_| is_only && path.is_file()) {
        let folder = path.parent().filter(|folder| *folder != "").unwrap_or(Path::new("."));
        (folder, *name)
    } else {
        return Ok(None);
    };
    let packed = write(folder, description);
    Ok(Some(packed.with_context(|| format!("cannot pack {}", folder.display()))?))
}

/// The scene file at a path; for a folder, the description of the SOG in it.
///
/// # Errors
/// The folder has no SOG.
pub(super) fn scene_file(path: PathBuf) -> anyhow::Result<PathBuf> {
    if path.is_dir() { Ok(path.join(description_in(&path)?)) } else { Ok(path) }
}

fn description_in(folder: &Path) -> anyhow::Result<&'static str> {
    let found = SOG_DESCRIPTIONS.iter().find(|name| folder.join(name).is_file());
    found.copied().with_context(|| {
        let names = SOG_DESCRIPTIONS.join(" or ");
        let folder = folder.display();
        format!("{folder} is a folder without {names}: give the scene's file")
    })
}

fn write(folder: &Path, description: &str) -> anyhow::Result<PackedFolder> {
    // It has a name also if the folder is given as `.`.
    let whole = fs::canonicalize(folder)?;
    let names = named_files(&whole, description)?;
    let dir = tempfile::tempdir()?;
    let name = whole.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let path = dir.path().join(format!("{name}.zip"));
    let mut archive = ZipWriter::new(BufWriter::new(File::create(&path)?));
    for name in names {
        let mut file = File::open(whole.join(&name)).with_context(|| name.clone())?;
        // Without a time of the file system. The images are compressed already.
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .large_file(file.metadata()?.len() >= LARGE_BYTES);
        archive.start_file(&*name, options)?;
        io::copy(&mut file, &mut archive).with_context(|| name.clone())?;
    }
    archive.finish()?.into_inner()?;
    Ok(PackedFolder { path, _dir: dir })
}

/// The description and the files that it names, and those that these name, relative to `folder`,
/// which must be canonical. Named files that do not exist are left out: a server needs only the
/// finest blocks, and reports missing files.
fn named_files(folder: &Path, description: &str) -> anyhow::Result<BTreeSet<String>> {
    let mut names = BTreeSet::from([description.to_owned()]);
    let mut unread = vec![description.to_owned()];
    while let Some(name) = unread.pop() {
        let json =
            read_whole(&folder.join(&name), SCENE_JSON_BYTES).with_context(|| name.clone())?;
        let SogFiles { descriptions, images } = SogFiles::from_json(&json, &name)?;
        for description in descriptions {
            if let Some(path) = existing(folder, &name, &description)?
                && names.insert(path.clone())
            {
                unread.push(path);
            }
        }
        for image in images {
            names.extend(existing(folder, &name, &image)?);
        }
    }
    Ok(names)
}

/// The path, relative to `folder`, of a file that a description in it names; `None` if there is no
/// such file.
fn existing(folder: &Path, description: &str, named: &str) -> anyhow::Result<Option<String>> {
    anyhow::ensure!(
        is_below_folder(named),
        "{description} names {named:?}, which is not below its folder"
    );
    let beside = description.rfind('/').map_or("", |slash| &description[..=slash]);
    let path = format!("{beside}{named}");
    let file = folder.join(&path);
    if !file.is_file() {
        return Ok(None);
    }
    anyhow::ensure!(
        fs::canonicalize(&file)?.starts_with(folder),
        "{description} names {named:?}, a link that leads out of the folder"
    );
    Ok(Some(path))
}
