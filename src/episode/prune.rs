//! Removing old records.

use std::fs::{self, File};
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use crate::export::mcap_path;
use crate::limits;
use crate::listing::{Listed, list_all};

/// Which records stay. A limit that is `None` keeps all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Keep {
    /// The newest ones, by number.
    pub records: Option<usize>,
    /// Those that were written to within this time.
    pub age: Option<Duration>,
    /// The newest ones that have so many bytes together, with their MCAP files.
    pub bytes: Option<u64>,
}

/// What was removed, or would be.
#[derive(Debug, Default)]
pub struct Pruned {
    /// Names of the episodes, the newest first.
    pub removed: Vec<String>,
    /// Their bytes, with those of their MCAP files.
    pub bytes: u64,
    /// Records that are left.
    pub kept: usize,
    /// Of these, how many are beyond a limit and stay because a session may be writing them.
    pub unfinished: usize,
    /// Files that could not be removed, with the reason.
    pub failed: Vec<(PathBuf, io::Error)>,
}

impl Keep {
    /// Whether no limit is set.
    pub fn keeps_all(&self) -> bool {
        *self == Self::default()
    }
}

/// Removes the records of a directory that are beyond a limit, each with its MCAP file. A record
/// without an end stays for [`limits::UNFINISHED_AGE`] after it was last written to, and every one
/// for [`limits::FRESH_AGE`], because it may be exported at this moment. With `is_dry`, nothing is
/// removed.
///
/// # Errors
/// The directory cannot be read. A file that cannot be removed is in the result.
pub fn prune(dir: &Path, keep: Keep, now: SystemTime, is_dry: bool) -> io::Result<Pruned> {
    let mut pruned = Pruned::default();
    let mut held = 0_u64;
    // From the newest to the oldest: each limit keeps a first part of the list.
    for (index, record) in list_all(dir)?.into_iter().enumerate() {
        let bytes = record.bytes + record.mcap_bytes.unwrap_or(0);
        held = held.saturating_add(bytes);
        // A time in the future counts as now.
        let written = record.modified.and_then(|modified| now.duration_since(modified).ok());
        let age = written.unwrap_or_default();
        let is_beyond = keep.records.is_some_and(|most| index >= most)
            || keep.age.is_some_and(|most| age > most)
            || keep.bytes.is_some_and(|most| held > most);
        if !is_beyond {
            pruned.kept += 1;
            continue;
        }
        if !is_over(&record, age) {
            pruned.kept += 1;
            pruned.unfinished += 1;
            continue;
        }
        if !is_dry && let Err((path, error)) = remove(&record.path) {
            pruned.kept += 1;
            pruned.failed.push((path, error));
            continue;
        }
        pruned.bytes += bytes;
        pruned.removed.push(record.name);
    }
    Ok(pruned)
}

/// Whether no session and no export uses a record any more.
fn is_over(record: &Listed, age: Duration) -> bool {
    let has_end = ends(&record.path).unwrap_or(false);
    age >= if has_end { limits::FRESH_AGE } else { limits::UNFINISHED_AGE }
}

/// Whether the last line of a record is that of its end, which is short.
fn ends(path: &Path) -> io::Result<bool> {
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    let start = length.saturating_sub(limits::TAIL_BYTES[0]);
    file.seek(SeekFrom::Start(start))?;
    let mut tail = Vec::new();
    file.take(limits::TAIL_BYTES[0]).read_to_end(&mut tail)?;
    let Some(line) = tail.strip_suffix(b"\n") else { return Ok(false) };
    let line = line.rsplit(|&byte| byte == b'\n').next().unwrap_or_default();
    let parsed: Result<serde_json::Value, _> = serde_json::from_slice(line);
    Ok(parsed.is_ok_and(|line| line["kind"] == "end"))
}

/// The MCAP file first: without its record, nothing would ever look for it.
fn remove(record: &Path) -> Result<(), (PathBuf, io::Error)> {
    for path in [mcap_path(record), record.to_owned()] {
        match fs::remove_file(&path) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err((path, error)),
        }
    }
    Ok(())
}
