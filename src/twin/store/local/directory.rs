//! The directory of twins: the paths of its parts, and the locks on them.

use std::collections::BTreeSet;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::store::StoreError;
use crate::store::disk::{Disk, Lock, ReadFile, Wait};
use crate::store::layout::{COLLECTION, LOG, OBJECTS, object_key, record_key};

use super::files::{create_dirs, entries};

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
    pub(super) disk: Arc<dyn Disk>,
}

/// The open file of an object, whose size is known but whose content is not yet checked.
pub(super) struct OpenObject {
    pub(super) path: PathBuf,
    pub(super) file: Box<dyn ReadFile>,
    pub(super) bytes: u64,
}

impl Local {
    pub(in crate::store) fn new(root: &Path, disk: Arc<dyn Disk>) -> Self {
        Self { root: root.to_owned(), disk }
    }

    pub(super) fn record_file(&self, name: &str, number: u64) -> PathBuf {
        self.root.join(record_key(name, number))
    }

    pub(super) fn object_file(&self, name: &str, hash: &str) -> PathBuf {
        self.root.join(object_key(name, hash))
    }

    /// The directory of a twin's objects.
    pub(super) fn objects_dir(&self, name: &str) -> PathBuf {
        self.root.join(name).join(OBJECTS)
    }

    pub(super) fn open(&self, name: &str, hash: &str) -> Result<OpenObject, StoreError> {
        let path = self.object_file(name, hash);
        let file = self.disk.open(&path).map_err(StoreError::io("open", &path))?;
        let bytes = file.size_bytes().map_err(StoreError::io("read", &path))?;
        Ok(OpenObject { path, file, bytes })
    }

    /// Names in a folder of objects, sorted; none if it was removed.
    ///
    /// # Errors
    /// The disk fails to list it; [`StoreError::Damaged`] if it is not a folder.
    pub(super) fn names_in_folder(&self, dir: &Path) -> Result<Vec<String>, StoreError> {
        let cause = match self.disk.list(dir) {
            Ok(mut names) => {
                names.sort_unstable();
                return Ok(names);
            }
            Err(cause) => cause,
        };
        // The error of listing does not say whether it is a folder at all.
        match self.disk.info(dir) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(Vec::new()),
            Ok(found) if !found.is_dir => {
                let reason = "it is not a directory".to_owned();
                Err(StoreError::Damaged { path: dir.to_owned(), reason })
            }
            _ => Err(StoreError::io("list", dir)(cause)),
        }
    }

    /// Removes the objects of a twin that `named` does not contain.
    pub(super) fn remove_unnamed(
        &self,
        name: &str,
        named: &BTreeSet<String>,
    ) -> Result<(), StoreError> {
        let objects = self.objects_dir(name);
        for prefix in entries(&*self.disk, &objects)? {
            for hash in entries(&*self.disk, &objects.join(&prefix))? {
                // All versions were read: what none of them names is of a killed commit.
                if !named.contains(&hash) {
                    let path = objects.join(&prefix).join(&hash);
                    self.disk.remove_file(&path).map_err(StoreError::io("remove", &path))?;
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
        let objects = self.objects_dir(name);
        for prefix in entries(&*self.disk, &objects).unwrap_or_default() {
            let _ = self.disk.remove_dir(&objects.join(prefix));
        }
        // From the inside out. The system refuses to remove a directory that is not empty.
        for dir in [objects, twin.join(LOG), twin] {
            let _ = self.disk.remove_dir(&dir);
        }
    }

    /// Creates a directory of which nothing need survive a power cut: of commits in preparation,
    /// and of locks.
    pub(super) fn create_transient(&self, dir: &Path) -> Result<(), StoreError> {
        // Without a sync: no process that needs it lives through a power cut.
        if self.exists(dir)? { Ok(()) } else { create_dirs(&*self.disk, dir) }
    }

    /// Waits until no other process publishes a version of a twin, takes the publish lock, and
    /// settles the twin.
    pub(super) fn lock_publishing(&self, name: &str) -> Result<Option<Lock>, StoreError> {
        self.create_transient(&self.root.join(STAGING))?;
        let lock = self.publish_lock(name, Wait::Yes)?;
        self.settle(name)?;
        Ok(lock)
    }

    /// Makes the log of a twin and the state of garbage collection durable, as they are now. The
    /// caller holds the publish lock.
    ///
    /// A process that was stopped, or that failed to sync, may have left a record, or its removal,
    /// that a power cut takes back. A removal of objects, or a new number, that followed from what
    /// the log said would then have relied on what never was: the versions before the lost one
    /// would be without objects, or the log would have a gap.
    pub(super) fn settle(&self, name: &str) -> Result<(), StoreError> {
        let twin = self.root.join(name);
        // The twin's own directory is last: it has the names of the other two.
        for dir in [twin.join(LOG), twin.join(COLLECTION), twin] {
            match self.disk.sync_dir(&dir) {
                // A new twin has none of them.
                Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {}
                synced => synced.map_err(StoreError::io("sync", &dir))?,
            }
        }
        Ok(())
    }

    fn publish_lock_file(&self, name: &str) -> PathBuf {
        self.root.join(STAGING).join(format!("{name}.lock"))
    }

    /// Removes the file of the publish lock, if its name has neither a twin nor a commit: otherwise
    /// every refused import would leave one. The caller holds the lock.
    pub(super) fn remove_unused_lock(&self, name: &str) {
        let prefix = format!("{name}{SEPARATOR}");
        let staged = entries(&*self.disk, &self.root.join(STAGING));
        let has_commit = |all: Vec<String>| all.iter().any(|entry| entry.starts_with(&prefix));
        let is_used = staged.map_or(true, has_commit);
        if !is_used && matches!(self.exists(&self.root.join(name)), Ok(false)) {
            // A file that stays does no harm.
            let _ = self.disk.remove_file(&self.publish_lock_file(name));
        }
    }

    /// Takes the publish lock; `None` if another process has it and this one does not wait.
    pub(super) fn publish_lock(&self, name: &str, wait: Wait) -> Result<Option<Lock>, StoreError> {
        let path = self.publish_lock_file(name);
        self.disk.lock(&path, wait).map_err(StoreError::io("lock", &path))
    }

    /// Whether something is at a path. A disk that fails is an error: otherwise a commit would
    /// leave an object behind, or take another version's object for its own.
    pub(super) fn exists(&self, path: &Path) -> Result<bool, StoreError> {
        match self.disk.info(path) {
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                Ok(false)
            }
            found => found.map(|_| true).map_err(StoreError::io("find", path)),
        }
    }

    /// Whether no process holds the lock of a staging directory. The caller holds the publish lock.
    pub(super) fn is_abandoned(&self, dir: &Path) -> Result<bool, StoreError> {
        let path = dir.join(LOCK);
        match self.disk.lock(&path, Wait::NoAndExisting) {
            Ok(lock) => Ok(lock.is_some()),
            // Its process was killed before it created the lock, or is removing the directory now.
            Err(error) if error.kind() == ErrorKind::NotFound => self.exists(dir),
            Err(error) => Err(StoreError::io("lock", &path)(error)),
        }
    }
}
