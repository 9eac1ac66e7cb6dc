//! The episodes of a directory.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use crate::limits;

/// A file of an episode.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// The name of the episode: `SESSION-NUMBER`.
    pub name: String,
    /// Its file.
    pub path: PathBuf,
    /// Its size, in bytes.
    pub bytes: u64,
    /// When it was last written.
    pub modified: Option<SystemTime>,
}

/// The episodes of a directory, newest first, at most [`limits::LISTED`]. A directory that does not exist has none.
///
/// # Errors
/// The directory cannot be read.
pub fn list(dir: &Path) -> io::Result<Vec<Listed>> {
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
            modified: metadata.modified().ok(),
            path,
        });
    }
    listed.sort_by(|a, b| b.modified.cmp(&a.modified).then_with(|| a.name.cmp(&b.name)));
    listed.truncate(limits::LISTED);
    Ok(listed)
}

/// The text of an episode's file.
///
/// # Errors
/// The file cannot be read.
pub fn text(path: &Path) -> io::Result<Vec<u8>> {
    fs::read(path)
}
