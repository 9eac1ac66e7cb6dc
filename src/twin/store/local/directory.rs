//! The directory of twins: the paths of its parts, and the locks on them.

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use crate::store::StoreError;
use crate::store::layout::{object_key, record_key};

use super::files::{create_dirs, entries, open_regular, open_regular_with};

/// Name of the directory for commits in preparation.
pub(super) const STAGING: &str = ".staging";
/// Separates the twin's name from the commit's in the name of a staging directory. Neither contains
/// it.
pub(super) const SEPARATOR: char = '@';
/// The file in a staging directory that its commit keeps locked.
pub(super) const LOCK: &str = "lock";

/// The directory of twins.
#[derive(Clone, Debug)]
pub(in crate::store) struct Local {
    pub(super) root: PathBuf,
}

/// An object's file.
pub(super) struct OpenObject {
    pub(super) path: PathBuf,
    pub(super) file: File,
    pub(super) bytes: u64,
}

/// The file that is locked while a version is published.
pub(super) struct PublishLock {
    pub(super) path: PathBuf,
    pub(super) file: File,
}

impl Local {
    pub(in crate::store) fn new(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    pub(super) fn record_file(&self, name: &str, number: u64) -> PathBuf {
        self.root.join(record_key(name, number))
    }

    pub(super) fn object_file(&self, name: &str, hash: &str) -> PathBuf {
        self.root.join(object_key(name, hash))
    }

    pub(super) fn open(&self, name: &str, hash: &str) -> Result<OpenObject, StoreError> {
        let path = self.object_file(name, hash);
        let file = open_regular(&path).map_err(StoreError::io("open", &path))?;
        let bytes = file.metadata().map_err(StoreError::io("read", &path))?.len();
        Ok(OpenObject { path, file, bytes })
    }

    /// Removes the objects of a twin that `named` does not contain.
    pub(super) fn remove_unnamed(
        &self,
        name: &str,
        named: &BTreeSet<String>,
    ) -> Result<(), StoreError> {
        let objects = self.root.join(name).join("objects");
        for prefix in entries(&objects)? {
            for hash in entries(&objects.join(&prefix))? {
                if !named.contains(&hash) {
                    let path = objects.join(&prefix).join(&hash);
                    fs::remove_file(&path).map_err(StoreError::io("remove", &path))?;
                }
            }
        }
        Ok(())
    }

    /// Removes the empty directories of a twin; the twin's own, too, if it never had a version,
    /// because it has no side files then. Side files are written without the publish lock, so their
    /// directories are kept. The caller holds the publish lock.
    pub(super) fn remove_empty(&self, name: &str) {
        let twin = self.root.join(name);
        for prefix in entries(&twin.join("objects")).unwrap_or_default() {
            let _ = fs::remove_dir(twin.join("objects").join(prefix));
        }
        for dir in [twin.join("objects"), twin.join("log"), twin] {
            let _ = fs::remove_dir(dir);
        }
    }

    /// Waits until no other process publishes a version of a twin, and takes the publish lock.
    pub(super) fn lock_publishing(&self, name: &str) -> Result<File, StoreError> {
        create_dirs(&self.root.join(STAGING))?;
        let PublishLock { path, file } = self.publish_lock(name)?;
        file.lock().map_err(StoreError::io("lock", &path))?;
        Ok(file)
    }

    /// Opens the publish lock. Its file is never removed: otherwise two commits could lock two
    /// files of one name.
    pub(super) fn publish_lock(&self, name: &str) -> Result<PublishLock, StoreError> {
        let path = self.root.join(STAGING).join(format!("{name}.lock"));
        let file = open_regular_with(File::options().create(true).append(true), &path);
        let file = file.map_err(StoreError::io("create", &path))?;
        Ok(PublishLock { path, file })
    }
}

/// Whether no process holds the lock of a staging directory. The caller holds the publish lock.
pub(super) fn is_abandoned(dir: &Path) -> Result<bool, StoreError> {
    let path = dir.join(LOCK);
    match open_regular_with(File::options().append(true), &path) {
        Ok(lock) => match lock.try_lock() {
            Ok(()) => Ok(true),
            Err(TryLockError::WouldBlock) => Ok(false),
            Err(TryLockError::Error(cause)) => Err(StoreError::io("lock", &path)(cause)),
        },
        // Its process was killed before it created the lock, or is removing the directory now.
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(dir.exists()),
        Err(error) => Err(StoreError::io("open", &path)(error)),
    }
}
