//! The episodes of a directory.

use std::fs;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use crate::export::mcap_path;
use crate::file::open_record;
use crate::limits;

/// A file of an episode.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// The name of the episode: `SESSION-NUMBER`.
    pub name: String,
    pub path: PathBuf,
    /// Its size, in bytes.
    pub bytes: u64,
    /// Size of its MCAP file, in bytes; `None` without one.
    pub mcap_bytes: Option<u64>,
    /// When it was last written.
    pub modified: Option<SystemTime>,
}

/// The episodes of a directory, newest first, at most [`limits::LISTED`]. A directory that does not
/// exist has none.
///
/// # Errors
/// The directory cannot be read.
pub fn list(dir: &Path) -> io::Result<Vec<Listed>> {
    let mut listed = list_all(dir)?;
    // Cut after sorting: which episodes are the newest is not known before.
    listed.truncate(limits::LISTED);
    Ok(listed)
}

/// The same without a limit.
pub(crate) fn list_all(dir: &Path) -> io::Result<Vec<Listed>> {
    let entries = match fs::read_dir(dir) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error),
    };
    let mut listed = Vec::new();
    for entry in entries {
        let path = entry?.path();
        if path.extension().is_none_or(|extension| extension != "jsonl") {
            continue;
        }
        // A file may be removed meanwhile.
        let Ok(metadata) = fs::metadata(&path) else { continue };
        let name = path.file_stem().map(|name| name.to_string_lossy().into_owned());
        listed.push(Listed {
            name: name.unwrap_or_default(),
            bytes: metadata.len(),
            mcap_bytes: fs::metadata(mcap_path(&path))
                .ok()
                .filter(fs::Metadata::is_file)
                .map(|mcap| mcap.len()),
            modified: metadata.modified().ok(),
            path,
        });
    }
    // Names break ties, so that the list does not depend on the order in the directory. An episode
    // without a time counts as the oldest.
    listed.sort_by(|a, b| b.modified.cmp(&a.modified).then_with(|| a.name.cmp(&b.name)));
    Ok(listed)
}

/// The size of a record, in bytes; 0 if it cannot be read.
pub fn record_bytes(record: &Path) -> u64 {
    fs::metadata(record).map_or(0, |metadata| metadata.len())
}

/// The MCAP file of a record; `None` if it has more than `most` bytes.
///
/// # Errors
/// There is no such file, or it cannot be read.
pub fn read_mcap(record: &Path, most: u64) -> io::Result<Option<Vec<u8>>> {
    let path = mcap_path(record);
    // A link is not followed: it could lead out of the directory of the records.
    let found = fs::symlink_metadata(&path)?;
    if !found.is_file() {
        return Err(io::Error::other("it is not a regular file"));
    }
    if found.len() > most { Ok(None) } else { fs::read(path).map(Some) }
}

/// The text of an episode's file; none if it has more than `most` bytes. An incomplete last line,
/// which a session may be writing, is left out.
///
/// # Errors
/// The file cannot be read.
pub fn read_text(path: &Path, most: u64) -> io::Result<Option<Vec<u8>>> {
    // Tested before the file is read into memory. It may grow by a few lines in between.
    let mut file = open_record(path)?;
    if file.metadata()?.len() > most {
        return Ok(None);
    }
    let mut text = Vec::new();
    file.read_to_end(&mut text)?;
    // Without any line break nothing is complete.
    let complete = text.iter().rposition(|&byte| byte == b'\n').map_or(0, |last| last + 1);
    text.truncate(complete);
    Ok(Some(text))
}
