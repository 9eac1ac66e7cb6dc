//! A commit in the making, in a directory of its own.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use crate::store::StoreError;
use crate::store::objects::{ObjectBackend as _, StoredObject};

use super::{BUFFER_BYTES, Hashing, Local, create_parent, sync, sync_parent};

/// ObjectBackend of a commit that nobody sees yet. Dropped before [`Staging::publish`] succeeds, it
/// leaves nothing behind.
#[derive(Debug)]
pub(in crate::store) struct Staging {
    pub(super) objects: Local,
    pub(super) name: String,
    pub(super) dir: PathBuf,
    /// ObjectBackend that were not there before this commit put them.
    pub(super) placed: Vec<PathBuf>,
    /// Held while publishing: others must not rely on an object that may be taken back.
    pub(super) turn: Option<File>,
    /// Released by the kernel when the process ends, however it ends.
    pub(super) _lock: File,
}

impl Staging {
    /// Where it lies.
    pub(in crate::store) fn dir(&self) -> &Path {
        &self.dir
    }

    /// Writes one object, hashing on the way, and names it by its hash.
    pub(in crate::store) fn put(
        &mut self,
        write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<StoredObject, StoreError> {
        let path = self.dir.join("writing");
        let failed = || StoreError::io("write", &path);
        let file = File::create(&path).map_err(failed())?;
        let hashing = Hashing { inner: file, hasher: blake3::Hasher::new() };
        let mut writer = BufWriter::with_capacity(BUFFER_BYTES, hashing);
        write(&mut writer).map_err(failed())?;
        let Hashing { inner: file, hasher } =
            writer.into_inner().map_err(|e| e.into_error()).map_err(failed())?;
        file.sync_all().map_err(failed())?;
        let (hash, bytes) = (hasher.finalize().to_hex().to_string(), hasher.count());
        let staged = self.dir.join(&hash);
        fs::rename(&path, &staged).map_err(StoreError::io("rename", &staged))?;
        Ok(StoredObject { hash, bytes })
    }

    /// Waits until nobody else publishes a version of this twin, and then nobody does until this is
    /// dropped.
    pub(in crate::store) fn lock_publishing(&mut self) -> Result<(), StoreError> {
        self.turn = Some(self.objects.lock_publishing(&self.name)?);
        Ok(())
    }

    /// Makes objects that were put and then the log record visible. Whoever calls has the turn.
    ///
    /// # Errors
    /// Nothing is visible, unless it is [`StoreError::NotSynced`].
    pub(in crate::store) fn publish(
        &mut self,
        hashes: &BTreeSet<&str>,
        number: u64,
        record: &[u8],
    ) -> Result<(), StoreError> {
        self.place(hashes)?;
        let staged = self.dir.join("record");
        let failed = || StoreError::io("write", &staged);
        let mut file = File::create(&staged).map_err(failed())?;
        file.write_all(record).and_then(|()| file.sync_all()).map_err(failed())?;
        let path = self.objects.record_path(&self.name, number);
        create_parent(&path)?;
        // A link, unlike a rename, fails if the number is taken: put if absent.
        fs::hard_link(&staged, &path).map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => StoreError::Conflict { name: self.name.clone(), number },
            _ => StoreError::io("write", &path)(source),
        })?;
        // Whoever looks has seen the version from here on, so it is not taken back.
        self.placed.clear();
        sync_parent(&path).map_err(|error| self.not_synced(number, error))
    }

    /// Puts objects in the place of those of a version that is there already, which heals damaged
    /// and lost ones, and sees to it that its record lasts. Whoever calls has the turn.
    pub(in crate::store) fn restore(
        &mut self,
        hashes: &BTreeSet<&str>,
        number: u64,
    ) -> Result<(), StoreError> {
        self.place(hashes)?;
        self.placed.clear();
        let path = self.objects.record_path(&self.name, number);
        sync_parent(&path).map_err(|error| self.not_synced(number, error))
    }

    pub(super) fn not_synced(&self, number: u64, error: StoreError) -> StoreError {
        StoreError::NotSynced { name: self.name.clone(), number, cause: Box::new(error) }
    }

    /// Moves those of the objects that were put here to their places, over older copies, too.
    fn place(&mut self, hashes: &BTreeSet<&str>) -> Result<(), StoreError> {
        let mut changed = BTreeSet::new();
        for hash in hashes {
            let staged = self.dir.join(hash);
            if !staged.exists() {
                continue;
            }
            let path = self.objects.path(&self.name, hash);
            create_parent(&path)?;
            if !path.exists() {
                self.placed.push(path.clone());
            }
            fs::rename(&staged, &path).map_err(StoreError::io("write", &path))?;
            changed.insert(path.parent().map(Path::to_owned));
        }
        changed.iter().flatten().try_for_each(|dir| sync(dir))
    }
}

impl Drop for Staging {
    /// What cannot be removed here is removed by the next start, so failures need no report.
    fn drop(&mut self) {
        if self.turn.is_some() {
            for path in &self.placed {
                let _ = fs::remove_file(path);
            }
            self.objects.remove_empty(&self.name);
        }
        let _ = fs::remove_dir_all(&self.dir);
    }
}
