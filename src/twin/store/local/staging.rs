//! A commit in preparation, in a directory of its own.

use std::collections::BTreeSet;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use crate::store::StoreError;
use crate::store::backend::{Staging, StoredObject, WriteObject};
use crate::store::disk::{Lock, Wait};

use super::directory::{LOCK, Local, SEPARATOR, STAGING};
use super::files::{
    BUFFER_BYTES, HashingFile, create_dirs, create_dirs_in, create_parent, sync, sync_parent,
};

/// Objects of a commit that no reader sees yet. Dropped before it is published, it leaves nothing
/// behind.
#[derive(Debug)]
pub(super) struct LocalStaging {
    local: Local,
    name: String,
    pub(super) dir: PathBuf,
    /// Objects that did not exist before this commit placed them.
    placed: Vec<PathBuf>,
    /// The publish lock. While it is held, no other commit can rely on an object that may be
    /// removed again.
    publish_lock: Option<Lock>,
    /// Released by the kernel when the process ends, however it ends.
    _lock: Option<Lock>,
}

impl LocalStaging {
    /// Creates the directory, and locks it for as long as the process lives.
    pub(super) fn begin(local: &Local, name: &str, commit: &str) -> Result<Self, StoreError> {
        // Removing abandoned directories takes this lock, too, and must not find this one before
        // its own lock is taken.
        local.create_transient(&local.root.join(STAGING))?;
        let _publish_lock = local.publish_lock(name, Wait::Yes)?;
        let dir = local.root.join(STAGING).join(format!("{name}{SEPARATOR}{commit}"));
        local.disk.create_dir(&dir).map_err(StoreError::io("create", &dir))?;
        let path = dir.join(LOCK);
        let lock = local.disk.lock(&path, Wait::Yes).map_err(StoreError::io("lock", &path))?;
        Ok(Self {
            local: local.clone(),
            name: name.to_owned(),
            dir,
            placed: Vec::new(),
            publish_lock: None,
            _lock: lock,
        })
    }

    pub(super) fn not_synced(&self, number: u64, error: StoreError) -> StoreError {
        StoreError::NotSynced { name: self.name.clone(), number, cause: Box::new(error) }
    }

    /// Moves those of the objects that were put here to their final places, over older copies, too.
    fn place(&mut self, hashes: &BTreeSet<&str>) -> Result<(), StoreError> {
        let disk = &*self.local.disk;
        let mut staged = Vec::new();
        // What was not put here is in its place already.
        for hash in hashes {
            if self.local.exists(&self.dir.join(hash))? {
                staged.push((self.dir.join(hash), self.local.object_file(&self.name, hash)));
            }
        }
        if staged.is_empty() {
            return Ok(());
        }
        let objects = self.local.objects_dir(&self.name);
        let folders = staged.iter().filter_map(|(_, path)| path.parent().map(Path::to_owned));
        let folders: BTreeSet<PathBuf> = folders.collect();
        create_dirs(disk, &objects)?;
        create_dirs_in(disk, &objects, &folders)?;
        for (staged, path) in staged {
            // Noted before the rename. If that fails, there is nothing to remove, which does no
            // harm.
            if !self.local.exists(&path)? {
                self.placed.push(path.clone());
            }
            disk.rename(&staged, &path).map_err(StoreError::io("write", &path))?;
        }
        // The names are durable before a record relies on them.
        folders.iter().try_for_each(|folder| sync(disk, folder))
    }
}

impl Staging for LocalStaging {
    fn put(&mut self, write: WriteObject<'_>) -> Result<StoredObject, StoreError> {
        let path = self.dir.join("writing");
        let failed = || StoreError::io("write", &path);
        let file = self.local.disk.create(&path).map_err(failed())?;
        let mut writer = BufWriter::with_capacity(BUFFER_BYTES, HashingFile::new(file));
        write(&mut writer).map_err(failed())?;
        let HashingFile { inner: mut file, hasher } =
            writer.into_inner().map_err(|e| e.into_error()).map_err(failed())?;
        // Durable under its temporary name; `place` does the same for the final name.
        file.sync().map_err(failed())?;
        let hash = hasher.finalize().to_hex().to_string();
        let staged = self.dir.join(&hash);
        self.local.disk.rename(&path, &staged).map_err(StoreError::io("rename", &staged))?;
        Ok(StoredObject { hash, bytes: hasher.count() })
    }

    fn lock_publishing(&mut self) -> Result<(), StoreError> {
        self.publish_lock = self.local.lock_publishing(&self.name)?;
        Ok(())
    }

    fn publish(
        &mut self,
        hashes: &BTreeSet<&str>,
        number: u64,
        record: &[u8],
    ) -> Result<(), StoreError> {
        self.place(hashes)?;
        let staged = self.dir.join("record");
        let failed = || StoreError::io("write", &staged);
        let mut file = self.local.disk.create(&staged).map_err(failed())?;
        file.write_all(record).and_then(|()| file.sync()).map_err(failed())?;
        let path = self.local.record_file(&self.name, number);
        create_parent(&*self.local.disk, &path)?;
        // Put if absent: a hard link, unlike a rename, fails if the number is taken.
        self.local.disk.link(&staged, &path).map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => StoreError::Conflict { name: self.name.clone(), number },
            _ => StoreError::io("write", &path)(source),
        })?;
        // From here on a reader may have seen the version, so its objects are not removed again.
        self.placed.clear();
        sync_parent(&*self.local.disk, &path).map_err(|error| self.not_synced(number, error))
    }

    fn place_objects(&mut self, hashes: &BTreeSet<&str>) -> Result<(), StoreError> {
        self.place(hashes)?;
        self.placed.clear();
        Ok(())
    }

    fn restore(&mut self, hashes: &BTreeSet<&str>, number: u64) -> Result<(), StoreError> {
        self.place(hashes)?;
        self.placed.clear();
        let path = self.local.record_file(&self.name, number);
        sync_parent(&*self.local.disk, &path).map_err(|error| self.not_synced(number, error))
    }

    fn dir(&self) -> &Path {
        &self.dir
    }
}

impl Drop for LocalStaging {
    /// Failures are ignored, because the next start removes whatever remains.
    fn drop(&mut self) {
        // Without the lock nothing was placed, and another commit could rely on what is removed.
        if self.publish_lock.is_some() {
            for path in &self.placed {
                let _ = self.local.disk.remove_file(path);
            }
            self.local.remove_empty(&self.name);
        }
        let _ = self.local.disk.remove_all(&self.dir);
        let lock = match self.publish_lock.take() {
            None => self.local.publish_lock(&self.name, Wait::No).ok().flatten(),
            held => held,
        };
        if lock.is_some() {
            self.local.remove_unused_lock(&self.name);
        }
    }
}
