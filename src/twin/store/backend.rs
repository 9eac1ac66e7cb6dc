//! The interface of the store to a directory or an object store.

use std::collections::BTreeSet;
use std::fmt::Debug;
use std::io::{self, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::StoreError;
use super::disk::Lock;
use super::layout::{object_key, record_key};

/// A directory or an object store with twins. Callers must check names of twins and hashes before
/// they pass them.
pub(super) trait ObjectBackend: Debug + Send + Sync {
    /// The directory, or the URL.
    fn root(&self) -> &Path;

    /// Names of the twins that have a version, sorted.
    fn twin_names(&self) -> Result<Vec<String>, StoreError>;

    /// Version numbers in a twin's log, ascending; none for an unknown twin.
    fn version_numbers(&self, name: &str) -> Result<Vec<u64>, StoreError>;

    /// Reads one log record, up to the largest size of a record.
    fn read_record(&self, name: &str, number: u64) -> Result<Vec<u8>, StoreError>;

    /// Reads an object and compares it with its hash.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] for another hash, and for an object longer than `limit_bytes`.
    fn read_object(&self, name: &str, hash: &str, limit_bytes: u64) -> Result<Vec<u8>, StoreError>;

    /// Reads an object of any size. Returns its first bytes, at most `most_bytes`, and the hash of
    /// all of them.
    fn read_and_hash(
        &self,
        name: &str,
        hash: &str,
        most_bytes: usize,
    ) -> Result<HashedStart, StoreError>;

    /// As [`ObjectBackend::read_and_hash`], and compares the object with its hash.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] for another hash.
    fn read_start(&self, name: &str, hash: &str, most_bytes: usize) -> Result<Vec<u8>, StoreError> {
        let HashedStart { start, hash: found } = self.read_and_hash(name, hash, most_bytes)?;
        if found == hash {
            return Ok(start);
        }
        let path = self.object_path(name, hash);
        Err(StoreError::Damaged { path, reason: format!("its bytes hash to {found}") })
    }

    /// Reads a range of an object and compares it with a hash of that range.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if the object ends before the range does; nothing is allocated for
    /// it then.
    fn read_range(
        &self,
        name: &str,
        object: &str,
        bytes: Range<u64>,
        hash: &[u8; 32],
    ) -> Result<Vec<u8>, StoreError>;

    /// Reads an object to its end without keeping it. Returns its size in bytes.
    fn read_and_discard(&self, name: &str, hash: &str) -> Result<u64, StoreError>;

    /// Checks that an object exists and has the right size, without reading its content.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it is shorter or longer.
    fn check_present(&self, name: &str, hash: &str, bytes: u64) -> Result<(), StoreError>;

    /// Begins a commit: what it stages is no part of the twin before it is published.
    fn begin_staging(&self, name: &str, commit: &str) -> Result<Box<dyn Staging>, StoreError>;

    /// Names of the twins with a commit that has begun and not ended: it runs, or it was killed.
    fn unfinished_commits(&self) -> Result<Vec<String>, StoreError>;

    /// Removes the remains of killed commits of a twin: their staging, and objects that they placed
    /// and that `named` does not contain. Running commits are not affected.
    fn remove_abandoned(
        &self,
        name: &str,
        named: &dyn Fn() -> Option<BTreeSet<String>>,
    ) -> Result<(), StoreError>;

    /// Renames a log record, so that it is part of the log no more. Returns the path that it has
    /// then.
    ///
    /// # Errors
    /// The record does not exist, or the backend cannot rename.
    fn set_record_aside(&self, name: &str, number: u64) -> Result<PathBuf, StoreError>;

    /// All objects of a twin, and whatever else has the name of an object.
    ///
    /// # Errors
    /// Nothing can be listed. Parts that cannot be listed are in the result.
    fn list_objects(&self, name: &str) -> Result<ObjectListing, StoreError>;

    /// Removes the objects that `which` returns. Where the backend has locks, publishing is locked
    /// from before `which` is called.
    fn remove_objects(
        &self,
        name: &str,
        which: &mut dyn FnMut() -> Result<Vec<String>, StoreError>,
    ) -> Result<(), StoreError>;

    /// Removes a twin: its objects, its side files and then its log. `mark` is called first, where
    /// the backend has locks with publishing locked; if it fails, nothing is removed.
    fn remove_twin(
        &self,
        name: &str,
        mark: &mut dyn FnMut() -> Result<(), StoreError>,
    ) -> Result<(), StoreError>;

    /// File names in a folder of a twin's side files. A side file is small and not part of any
    /// version: a lease, or the state of garbage collection.
    fn list_side_files(&self, name: &str, folder: &str) -> Result<Vec<String>, StoreError>;

    /// Reads a side file of at most [`limits::SIDE_FILE_BYTES`](crate::limits::SIDE_FILE_BYTES);
    /// `None` if it does not exist.
    fn read_side_file(&self, name: &str, file: &str) -> Result<Option<Vec<u8>>, StoreError>;

    /// Writes a side file, in place of an older one of that name.
    ///
    /// # Errors
    /// [`StoreError::SideFileSize`] for one too large to be read again.
    fn write_side_file(&self, name: &str, file: &str, bytes: &[u8]) -> Result<(), StoreError>;

    /// Removes a side file, if it exists.
    fn remove_side_file(&self, name: &str, file: &str) -> Result<(), StoreError>;

    /// Removes what stopped processes left in a folder of side files, if it was written before a
    /// time: files that were being written, and locks without their side file.
    fn remove_leftovers(&self, name: &str, folder: &str, before_us: i64) -> Result<(), StoreError>;

    /// Keeps a side file locked until the lock is dropped, or the process ends. `None` where the
    /// backend has no locks.
    fn hold(&self, name: &str, file: &str) -> Result<Option<Lock>, StoreError>;

    /// Whether a process keeps a side file locked.
    fn is_held(&self, name: &str, file: &str) -> Result<bool, StoreError>;

    /// Path or URL of one log record.
    fn record_path(&self, name: &str, number: u64) -> PathBuf {
        self.root().join(record_key(name, number))
    }

    /// Path or URL of an object.
    fn object_path(&self, name: &str, hash: &str) -> PathBuf {
        self.root().join(object_key(name, hash))
    }
}

/// Writes the content of an object.
pub(super) type WriteObject<'a> = Box<dyn FnOnce(&mut dyn Write) -> io::Result<()> + 'a>;

/// Objects of a commit in preparation, which no reader sees yet. Dropping it before it is published
/// removes them where the backend can.
pub(super) trait Staging: Debug + Send {
    /// Writes one object, and names it by its hash.
    fn put(&mut self, write: WriteObject<'_>) -> Result<StoredObject, StoreError>;

    /// Waits until no other commit publishes a version of this twin, and keeps others from
    /// publishing until this is dropped. Does nothing where the backend has no locks.
    fn lock_publishing(&mut self) -> Result<(), StoreError>;

    /// Makes objects visible, and then the log record. The caller has called
    /// [`Staging::lock_publishing`].
    ///
    /// # Errors
    /// [`StoreError::Conflict`] if the number is taken. Nothing is visible then, unless the error
    /// is [`StoreError::NotSynced`].
    fn publish(
        &mut self,
        hashes: &BTreeSet<&str>,
        number: u64,
        record: &[u8],
    ) -> Result<(), StoreError>;

    /// Makes objects visible that no log record names: assets. The caller has called
    /// [`Staging::lock_publishing`].
    fn place_objects(&mut self, hashes: &BTreeSet<&str>) -> Result<(), StoreError>;

    /// Replaces objects of an existing version, which repairs damaged and missing ones, and syncs
    /// its record to the disk. The caller has called [`Staging::lock_publishing`].
    fn restore(&mut self, hashes: &BTreeSet<&str>, number: u64) -> Result<(), StoreError>;

    /// Where its objects lie, for messages.
    fn dir(&self) -> &Path;
}

/// The start of an object.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct HashedStart {
    pub(super) start: Vec<u8>,
    /// BLAKE3 of the whole object, 64 lower-case hex digits.
    pub(super) hash: String,
}

/// The objects of a twin.
#[derive(Debug, Default)]
pub(super) struct ObjectListing {
    /// The objects that were found, in order of their hashes.
    pub(super) objects: Vec<ListedObject>,
    /// Objects that cannot be listed.
    pub(super) unlisted: Vec<UnlistedObjects>,
}

impl ObjectListing {
    /// The objects. An entry that is not a folder has none.
    ///
    /// # Errors
    /// The disk fails to list some.
    pub(super) fn whole(self) -> Result<Vec<ListedObject>, StoreError> {
        // An entry that is no folder is `Damaged`. It holds no objects, so that the list is
        // complete without it.
        let is_failure = |one: &UnlistedObjects| matches!(one.error, StoreError::Io { .. });
        match self.unlisted.into_iter().find(is_failure) {
            None => Ok(self.objects),
            Some(UnlistedObjects { error, .. }) => Err(error),
        }
    }
}

/// Objects that cannot be listed: one, or all of a folder.
#[derive(Debug)]
pub(super) struct UnlistedObjects {
    /// The hash of the object, or the first two digits of the hashes in a folder.
    pub(super) digits: String,
    /// [`StoreError::Io`] if the disk fails, [`StoreError::Damaged`] if it is not a folder.
    pub(super) error: StoreError,
}

/// An object in a listing.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ListedObject {
    pub(super) hash: String,
    pub(super) bytes: u64,
    /// Whether it is a file, as all objects that a commit writes are: no link, pipe or directory.
    pub(super) is_file: bool,
    /// When it was last written, in microseconds since 1970.
    pub(super) written_us: i64,
}

/// An object that was written.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct StoredObject {
    /// Its BLAKE3, 64 lower-case hex digits.
    pub(super) hash: String,
    pub(super) bytes: u64,
}
