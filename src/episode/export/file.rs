//! The MCAP file of a record: written under another name first, so that a reader never finds half a file.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write as _};
use std::path::{Path, PathBuf};

use crate::file::EpisodeFile;

use super::write::{ExportError, Exported, export};

/// The place of the MCAP file beside a record: `a-1.mcap` beside `a-1.jsonl`.
pub fn mcap_of(record: &Path) -> PathBuf {
    record.with_extension("mcap")
}

/// Exports a record to a file. It is on disk when it gets its name; until then it is `mcap` with `.tmp` behind it.
///
/// # Errors
/// The record cannot be read or has no frame, or the file cannot be written: then nothing is left of it.
pub fn export_file(record: &Path, mcap: &Path) -> Result<Exported, ExportError> {
    let episode = EpisodeFile::read(record)?;
    let rig = EpisodeFile::rig(record)?;
    write_whole(mcap, |out| export(&episode, rig.as_ref(), out))
}

/// Lets `write` write a file, and gives it its name when it is whole and on disk.
///
/// # Errors
/// The file cannot be created, `write` fails, or the file cannot be renamed: then nothing is left of it.
pub fn write_whole<T>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<T, ExportError>,
) -> Result<T, ExportError> {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".tmp");
    let temporary = PathBuf::from(temporary);
    let failed = |cause| ExportError::Io { path: path.to_owned(), cause };
    let mut out = BufWriter::new(File::create(&temporary).map_err(failed)?);
    let written = write(&mut out).and_then(|written| {
        name_whole(out, &temporary, path).map_err(failed)?;
        Ok(written)
    });
    if written.is_err() {
        // The first error is the one to report.
        let _ = fs::remove_file(&temporary);
    }
    written
}

/// Brings a file to disk and gives it its name, also on disk.
fn name_whole(mut out: BufWriter<File>, temporary: &Path, path: &Path) -> io::Result<()> {
    out.flush()?;
    out.get_ref().sync_all()?;
    fs::rename(temporary, path)?;
    #[cfg(unix)]
    if let Some(dir) = path.parent() {
        let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
        File::open(dir)?.sync_all()?;
    }
    Ok(())
}
