//! A scene of many files as one archive. A push has at most 256 files, and a streamed SOG has nine for each block.

use std::fs::{self, File};
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use tempfile::TempDir;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use wildcity_twin::ingest::SOG_DESCRIPTIONS;

/// Endings of the files that a SOG consists of.
const ENDINGS: [&str; 2] = ["json", "webp"];
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

/// Packs the SOG in a folder, if `path` is a folder, or the only file of a push and describes a SOG. None for any other
/// file. The same files give the same bytes, so that an upload continues where it stopped.
///
/// # Errors
/// The folder has no SOG, or cannot be read; the archive cannot be written.
pub(super) fn pack(path: &Path, is_only: bool) -> anyhow::Result<Option<PackedFolder>> {
    let is_description = path
        .file_name()
        .is_some_and(|name| SOG_DESCRIPTIONS.iter().any(|description| name == *description));
    let folder = match path {
        path if path.is_dir() => path.to_owned(),
        path if is_only && is_description && path.is_file() => {
            path.parent().filter(|folder| *folder != "").unwrap_or(Path::new(".")).to_owned()
        }
        _ => return Ok(None),
    };
    anyhow::ensure!(
        SOG_DESCRIPTIONS.iter().any(|description| folder.join(description).is_file()),
        "{} is a folder without {}: give a scene file, and the files that it names",
        folder.display(),
        SOG_DESCRIPTIONS.join(" or ")
    );
    let packed = write(&folder).with_context(|| format!("cannot pack {}", folder.display()))?;
    Ok(Some(packed))
}

fn write(folder: &Path) -> anyhow::Result<PackedFolder> {
    let mut names = Vec::new();
    collect(folder, "", &mut names)?;
    names.sort_unstable();
    let dir = tempfile::tempdir()?;
    // The name of the folder, also if it is given as `.`.
    let whole = fs::canonicalize(folder)?;
    let name = whole.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let path = dir.path().join(format!("{name}.zip"));
    let mut archive = ZipWriter::new(BufWriter::new(File::create(&path)?));
    for name in names {
        let mut file = File::open(folder.join(&name)).with_context(|| name.clone())?;
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

/// The names of the files below a folder, with `/`. Links to folders are not followed.
fn collect(folder: &Path, prefix: &str, names: &mut Vec<String>) -> anyhow::Result<()> {
    for entry in fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let entry = entry?;
        let path = entry.path();
        let is_part = ENDINGS.iter().any(|ending| path.extension().is_some_and(|e| e == *ending));
        let is_folder = entry.file_type()?.is_dir();
        if !is_part && !is_folder {
            continue;
        }
        let name = entry.file_name().into_string();
        let name =
            name.map_err(|_| anyhow::anyhow!("the name of {} is not UTF-8", path.display()))?;
        if is_folder {
            collect(&path, &format!("{prefix}{name}/"), names)?;
        } else if path.is_file() {
            names.push(format!("{prefix}{name}"));
        }
    }
    Ok(())
}
