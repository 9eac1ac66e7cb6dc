//! The MCAP file of a record: written under another name first, so that a reader never finds half a
//! file.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use tempfile::NamedTempFile;

#[cfg(feature = "mcap")]
use crate::file::EpisodeFile;
use crate::limits;

#[cfg(feature = "mcap")]
use super::export;
use super::{ExportError, Exported};

/// Ending of the files of records.
const ENDING: &str = ".mcap";
/// Ending of the name that a file has while it is written: `a-1.mcap.RANDOM.tmp` becomes
/// `a-1.mcap`.
const TEMPORARY: &str = ".tmp";

/// Path of the MCAP file of a record: `a-1.mcap` for `a-1.jsonl`.
pub fn mcap_path(record: &Path) -> PathBuf {
    record.with_extension("mcap")
}

/// In the place of the export, in a build without `mcap`.
///
/// # Errors
/// Always: it says what to build.
#[cfg(not(feature = "mcap"))]
pub fn export_file(_: &Path, _: &Path) -> Result<Exported, ExportError> {
    Err(ExportError::LeftOut)
}

/// Exports a record to a file, as [`write_whole`] does.
///
/// # Errors
/// The record cannot be read or has no frame, or the file cannot be written: no file is left then.
#[cfg(feature = "mcap")]
pub fn export_file(record: &Path, mcap: &Path) -> Result<Exported, ExportError> {
    let episode = EpisodeFile::read(record)?;
    let rig = EpisodeFile::rig(record)?;
    write_whole(mcap, |out| export(&episode, rig.as_ref(), out))
}

/// Lets `write` write a file under a temporary name, and renames it when it is complete and on
/// disk. Temporary names are unique, so that two exports to one path do not conflict: the last one
/// stays.
///
/// # Errors
/// The file cannot be created, `write` fails, or the file cannot be renamed: no file is left then.
pub fn write_whole<T>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> Result<T, ExportError>,
) -> Result<T, ExportError> {
    let failed = |cause| ExportError::Io { path: path.to_owned(), cause };
    // The parent of a bare file name is the empty path, which is no directory that can be opened.
    let dir = match path.parent() {
        Some(dir) if !dir.as_os_str().is_empty() => dir,
        _ => Path::new("."),
    };
    // Removed when it is dropped without its name.
    let mut temporary = create(dir, path).map_err(failed)?;
    let mut out = BufWriter::new(temporary.as_file_mut());
    let written = write(&mut out)?;
    // A dropped `BufWriter` ignores an error of its last write, so that it is flushed here.
    out.flush().map_err(failed)?;
    drop(out);
    name_whole(temporary, dir, path).map_err(failed)?;
    Ok(written)
}

/// Creates the file under its temporary name, with the rights of any new file.
fn create(dir: &Path, path: &Path) -> io::Result<NamedTempFile> {
    let name = path.file_name().ok_or_else(|| io::Error::other("the path has no file name"))?;
    let mut prefix = name.to_owned();
    prefix.push(".");
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(TEMPORARY);
    // The default of tempfile is 0600, with which other users could not read the export. The umask
    // still applies.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(dir)
}

/// Brings a file to disk and gives it its name, also on disk.
fn name_whole(temporary: NamedTempFile, dir: &Path, path: &Path) -> io::Result<()> {
    // Contents first, name second: after a power cut, no name leads to half a file.
    temporary.as_file().sync_all()?;
    temporary.persist(path).map_err(|error| error.error)?;
    // The new name is part of the directory, and on disk only when the directory is.
    #[cfg(unix)]
    File::open(dir)?.sync_all()?;
    Ok(())
}

/// Removes the temporary files of killed exports from a directory: files that were not written to
/// for [`limits::LEFTOVER_AGE`] before `now`. The directory need not exist. Returns how many were
/// removed.
///
/// # Errors
/// The directory cannot be read, or a file cannot be removed: returns the first error, and still
/// removes the other files.
pub fn remove_leftovers(dir: &Path, now: SystemTime) -> io::Result<usize> {
    let entries = match fs::read_dir(dir) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(0),
        Err(error) => return Err(error),
    };
    let mut removed = 0;
    let mut failed = None;
    for entry in entries {
        let entry = entry?;
        if !is_temporary(&entry.file_name()) {
            continue;
        }
        // A file may get its name meanwhile.
        let Ok(metadata) = entry.metadata() else { continue };
        let Ok(modified) = metadata.modified() else { continue };
        // A time in the future, after the clock was set back, is an error here and counts as young.
        let is_old = now.duration_since(modified).is_ok_and(|age| age >= limits::LEFTOVER_AGE);
        if !metadata.is_file() || !is_old {
            continue;
        }
        match fs::remove_file(entry.path()) {
            Ok(()) => removed += 1,
            // Another server removed it.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => failed = failed.or(Some(error)),
        }
    }
    failed.map_or(Ok(removed), Err)
}

/// Whether a name is one of [`write_whole`]; earlier builds wrote no random part.
fn is_temporary(name: &OsStr) -> bool {
    let Some(name) = name.to_str().and_then(|name| name.strip_suffix(TEMPORARY)) else {
        return false;
    };
    // `a-1.mcap`, or `a-1.mcap` with a random part behind it.
    name.ends_with(ENDING) || name.rsplit_once('.').is_some_and(|(of, _)| of.ends_with(ENDING))
}
