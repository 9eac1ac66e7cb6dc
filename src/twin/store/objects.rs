//! What a place of twins can do, be it a directory or an object store, and what lies where in it.

use std::collections::BTreeSet;
use std::fmt::Debug;
use std::io::{self, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::limits;

use super::StoreError;
use super::local::staging::Staging as LocalStaging;
use super::remote::staging::Staging as RemoteStaging;

/// A place of twins. Names of twins are checked before they get here, and so are hashes.
pub(super) trait ObjectBackend: Debug + Send + Sync {
    /// The directory, or the URL.
    fn root(&self) -> &Path;

    /// Names of the twins that have a version, sorted.
    fn names(&self) -> Result<Vec<String>, StoreError>;

    /// Numbers of the versions in a twin's log, rising; none for an unknown twin.
    fn numbers(&self, name: &str) -> Result<Vec<u64>, StoreError>;

    /// Reads one log record, or as much as a record may have.
    fn record(&self, name: &str, number: u64) -> Result<Vec<u8>, StoreError>;

    /// Reads an object whole and compares it with its hash.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] for one that is longer than `limit_bytes`, too.
    fn read_object(&self, name: &str, hash: &str, limit_bytes: u64) -> Result<Vec<u8>, StoreError>;

    /// Reads an object whole, whatever its size, compares it with its hash, and returns its first
    /// bytes, at most `most_bytes`.
    fn read_start(&self, name: &str, hash: &str, most_bytes: usize) -> Result<Vec<u8>, StoreError>;

    /// Reads a part of an object and compares it with a hash of its own.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if the object ends before the part does; nothing is allocated for it.
    fn read_range(
        &self,
        name: &str,
        object: &str,
        bytes: Range<u64>,
        hash: &[u8; 32],
    ) -> Result<Vec<u8>, StoreError>;

    /// Reads an object to its end and keeps none of it. Returns how many bytes it has.
    fn read_and_discard(&self, name: &str, hash: &str) -> Result<u64, StoreError>;

    /// Whether an object is there, and as long as it should be; its bytes are not looked at.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it is shorter or longer.
    fn check_present(&self, name: &str, hash: &str, bytes: u64) -> Result<(), StoreError>;

    /// Begins a commit.
    fn stage(&self, name: &str, commit: &str) -> Result<Staging, StoreError>;

    /// Names of the twins with a commit that was begun and not ended: it runs, or it was killed.
    fn unfinished_commits(&self) -> Result<Vec<String>, StoreError>;

    /// Clears away what killed commits of a twin left: their staging, and objects they had placed
    /// and `named` does not name. Commits that run stay.
    fn remove_abandoned(
        &self,
        name: &str,
        named: &dyn Fn() -> Option<BTreeSet<String>>,
    ) -> Result<(), StoreError>;

    /// All objects of a twin, in order of their hashes.
    fn list(&self, name: &str) -> Result<Vec<ListedObject>, StoreError>;

    /// Removes the objects that `which` names, while nobody publishes where that can be had: from
    /// before it is asked.
    fn remove(
        &self,
        name: &str,
        which: &mut dyn FnMut() -> Result<Vec<String>, StoreError>,
    ) -> Result<(), StoreError>;

    /// Names of a twin's notes in a folder: what is not part of any version, as leases.
    fn list_side_files(&self, name: &str, folder: &str) -> Result<Vec<String>, StoreError>;

    /// Reads a note of at most [`limits::SIDE_FILE_BYTES`]; none if there is none.
    fn read_side_file(&self, name: &str, note: &str) -> Result<Option<Vec<u8>>, StoreError>;

    /// Writes a note, in place of one of that name.
    ///
    /// # Errors
    /// [`StoreError::SideFileSize`] for one that could not be read again.
    fn write_side_file(&self, name: &str, note: &str, bytes: &[u8]) -> Result<(), StoreError>;

    /// Removes a note, if it is there.
    fn remove_side_file(&self, name: &str, note: &str) -> Result<(), StoreError>;

    /// Where one log record lies.
    fn record_path(&self, name: &str, number: u64) -> PathBuf {
        self.root().join(record_key(name, number))
    }

    /// Where an object lies.
    fn path(&self, name: &str, hash: &str) -> PathBuf {
        self.root().join(object_key(name, hash))
    }
}

/// An object that is there.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ListedObject {
    pub(super) hash: String,
    pub(super) bytes: u64,
    /// When it was last written, in microseconds since 1970.
    pub(super) written_us: i64,
}

/// An object that was written: its hash as 64 hex digits, and its size.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct StoredObject {
    pub(super) hash: String,
    pub(super) bytes: u64,
}

/// ObjectBackend of a commit that nobody sees yet.
#[derive(Debug)]
pub(super) enum Staging {
    Local(LocalStaging),
    Remote(RemoteStaging),
}

impl Staging {
    /// Writes one object, hashing on the way, and names it by its hash.
    pub(super) fn put(
        &mut self,
        write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<StoredObject, StoreError> {
        match self {
            Self::Local(staging) => staging.put(write),
            Self::Remote(staging) => staging.put(write),
        }
    }

    /// Waits until nobody else publishes a version of this twin, where that can be had, and then
    /// nobody does until this is dropped.
    pub(super) fn lock_publishing(&mut self) -> Result<(), StoreError> {
        match self {
            Self::Local(staging) => staging.lock_publishing(),
            Self::Remote(_) => Ok(()),
        }
    }

    /// Makes objects that were put and then the log record visible. Whoever calls has the turn.
    ///
    /// # Errors
    /// [`StoreError::Conflict`] if the number is taken. Nothing is visible, unless it is
    /// [`StoreError::NotSynced`].
    pub(super) fn publish(
        &mut self,
        hashes: &BTreeSet<&str>,
        number: u64,
        record: &[u8],
    ) -> Result<(), StoreError> {
        match self {
            Self::Local(staging) => staging.publish(hashes, number, record),
            Self::Remote(staging) => staging.publish(number, record),
        }
    }

    /// Puts objects in the place of those of a version that is there already, which heals damaged
    /// and lost ones, and sees to it that its record lasts. Whoever calls has the turn.
    pub(super) fn restore(
        &mut self,
        hashes: &BTreeSet<&str>,
        number: u64,
    ) -> Result<(), StoreError> {
        match self {
            Self::Local(staging) => staging.restore(hashes, number),
            Self::Remote(staging) => staging.settle(),
        }
    }

    /// Where its objects lie.
    pub(super) fn dir(&self) -> &Path {
        match self {
            Self::Local(staging) => staging.dir(),
            Self::Remote(staging) => staging.root(),
        }
    }
}

/// Where a log record lies below the root. Ten digits, so that names sort as numbers do.
pub(super) fn record_key(name: &str, number: u64) -> String {
    format!("{name}/log/{number:010}")
}

/// Where an object lies below the root.
pub(super) fn object_key(name: &str, hash: &str) -> String {
    format!("{name}/objects/{}/{hash}", &hash[..2])
}

/// The numbers among the names of a log, rising.
pub(super) fn log_numbers(names: impl IntoIterator<Item = String>) -> Vec<u64> {
    let number = |entry: String| {
        let number: u64 = entry.parse().ok()?;
        // "1" and "+1" are numbers, too, but nobody wrote them here.
        (format!("{number:010}") == entry).then_some(number)
    };
    let mut numbers: Vec<u64> = names.into_iter().filter_map(number).collect();
    numbers.sort_unstable();
    numbers
}

/// Whether a text is 64 lower-case hex digits: it becomes a file name.
pub(super) fn is_hash(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}

/// Whether a note can be read again.
///
/// # Errors
/// [`StoreError::SideFileSize`].
pub(super) fn check_side_file(path: PathBuf, bytes: &[u8]) -> Result<(), StoreError> {
    let (bytes, limit) = (bytes.len() as u64, limits::SIDE_FILE_BYTES);
    if bytes > limit { Err(StoreError::SideFileSize { path, bytes, limit }) } else { Ok(()) }
}

/// Whether bytes are those of a hash.
///
/// # Errors
/// Says what they hash to.
pub(super) fn check_hash(bytes: &[u8], hash: &str) -> Result<(), String> {
    let found = blake3::hash(bytes).to_hex();
    if found.as_str() == hash { Ok(()) } else { Err(format!("its bytes hash to {found}")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_are_written_here_are_versions() {
        let names = ["0000000002", "10000000000", "1", "+1", "+000000003", "00000000004", "x"];
        assert_eq!(log_numbers(names.map(str::to_owned)), [2, 10_000_000_000]);
    }
}
