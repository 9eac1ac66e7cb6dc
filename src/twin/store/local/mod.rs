//! Twins in a directory. In the store, only this folder opens files.

mod directory;
#[cfg(feature = "object-store")]
mod disk_cache;
mod files;
mod real_disk;
mod staging;

use std::collections::BTreeSet;
use std::io::{ErrorKind, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::limits;
use wildcity_scene::rig::is_name;

use super::StoreError;
use super::backend::{
    HashedStart, ListedObject, ObjectBackend, ObjectListing, Staging, UnlistedObjects,
};
use super::disk::{FileInfo, Lock, Wait};
use super::layout::{
    ACTORS, COLLECTION, LEASES, LOCK_ENDING, LOG, OBJECTS, check_hash, check_side_file, is_hash,
    is_prefix, log_numbers,
};

pub(super) use directory::Local;
#[cfg(feature = "object-store")]
pub(super) use disk_cache::DiskCache;
pub use files::create_dirs;
pub use real_disk::RealDisk;

use directory::{OpenObject, SEPARATOR, STAGING};
use files::{
    BUFFER_BYTES, HashingFile, WRITING, create_parent, entries, read_all, sync, sync_parent,
};
use staging::LocalStaging;

impl ObjectBackend for Local {
    fn root(&self) -> &Path {
        &self.root
    }

    fn twin_names(&self) -> Result<Vec<String>, StoreError> {
        let mut names = entries(&*self.disk, &self.root)?;
        // A twin whose log cannot be listed stays in the list, where it is shown as damaged.
        names.retain(|name| {
            is_name(name) && !self.version_numbers(name).is_ok_and(|n| n.is_empty())
        });
        Ok(names)
    }

    fn version_numbers(&self, name: &str) -> Result<Vec<u64>, StoreError> {
        Ok(log_numbers(entries(&*self.disk, &self.root.join(name).join(LOG))?))
    }

    fn read_record(&self, name: &str, number: u64) -> Result<Vec<u8>, StoreError> {
        let path = self.record_path(name, number);
        let file = self.disk.open(&path).map_err(StoreError::io("open", &path))?;
        read_all(file, limits::LOG_RECORD_BYTES).map_err(StoreError::io("read", &path))
    }

    fn read_object(&self, name: &str, hash: &str, limit_bytes: u64) -> Result<Vec<u8>, StoreError> {
        let OpenObject { path, file, bytes: size } = self.open(name, hash)?;
        // `read_all` would cut it off, and the message would name another hash instead of the size.
        if size > limit_bytes {
            let reason = format!("{size} bytes are above {limit_bytes}");
            return Err(StoreError::Damaged { path, reason });
        }
        let bytes = read_all(file, limit_bytes).map_err(StoreError::io("read", &path))?;
        match check_hash(&bytes, hash) {
            Ok(()) => Ok(bytes),
            Err(reason) => Err(StoreError::Damaged { path, reason }),
        }
    }

    fn read_and_hash(
        &self,
        name: &str,
        hash: &str,
        most_bytes: usize,
    ) -> Result<HashedStart, StoreError> {
        let OpenObject { path, file, .. } = self.open(name, hash)?;
        let failed = || StoreError::io("read", &path);
        let mut reader = HashingFile::new(file);
        let mut start = Vec::new();
        (&mut reader).take(most_bytes as u64).read_to_end(&mut start).map_err(failed())?;
        let mut buffer = vec![0; BUFFER_BYTES];
        // The rest is only hashed.
        while reader.read(&mut buffer).map_err(failed())? > 0 {}
        Ok(HashedStart { start, hash: reader.hasher.finalize().to_hex().to_string() })
    }

    fn read_range(
        &self,
        name: &str,
        object: &str,
        bytes: Range<u64>,
        hash: &[u8; 32],
    ) -> Result<Vec<u8>, StoreError> {
        let OpenObject { path, mut file, bytes: size } = self.open(name, object)?;
        // Before the allocation: a damaged table could ask for any size.
        if bytes.end > size {
            let reason = format!("it has {size} bytes; {} are needed", bytes.end);
            return Err(StoreError::Damaged { path, reason });
        }
        let mut part = vec![0; (bytes.end - bytes.start) as usize];
        file.seek(SeekFrom::Start(bytes.start))
            .and_then(|_| file.read_exact(&mut part))
            .map_err(StoreError::io("read", &path))?;
        let found = blake3::hash(&part);
        if found == *hash {
            return Ok(part);
        }
        Err(StoreError::Damaged { path, reason: format!("its bytes hash to {}", found.to_hex()) })
    }

    fn read_and_discard(&self, name: &str, hash: &str) -> Result<u64, StoreError> {
        let OpenObject { path, mut file, .. } = self.open(name, hash)?;
        let mut buffer = vec![0; BUFFER_BYTES];
        let mut bytes = 0;
        loop {
            match file.read(&mut buffer).map_err(StoreError::io("read", &path))? {
                0 => return Ok(bytes),
                read => bytes += read as u64,
            }
        }
    }

    fn check_present(&self, name: &str, hash: &str, bytes: u64) -> Result<(), StoreError> {
        let OpenObject { path, bytes: found, .. } = self.open(name, hash)?;
        if found == bytes {
            return Ok(());
        }
        Err(StoreError::Damaged { path, reason: format!("it has {found} bytes, not {bytes}") })
    }

    fn begin_staging(&self, name: &str, commit: &str) -> Result<Box<dyn Staging>, StoreError> {
        Ok(Box::new(LocalStaging::begin(self, name, commit)?))
    }

    fn unfinished_commits(&self) -> Result<Vec<String>, StoreError> {
        let mut names = Vec::new();
        for entry in entries(&*self.disk, &self.root.join(STAGING))? {
            let name = entry.split_once(SEPARATOR).map(|(name, _)| name);
            names.extend(name.filter(|name| is_name(name) || *name == ACTORS).map(str::to_owned));
        }
        // The entries are sorted, so that equal names are neighbours.
        names.dedup();
        Ok(names)
    }

    fn remove_abandoned(
        &self,
        name: &str,
        named: &dyn Fn() -> Option<BTreeSet<String>>,
    ) -> Result<(), StoreError> {
        // Another process publishes a version or does this.
        let Some(_lock) = self.publish_lock(name, Wait::No)? else { return Ok(()) };
        let mut abandoned = Vec::new();
        for entry in entries(&*self.disk, &self.root.join(STAGING))? {
            let dir = self.root.join(STAGING).join(&entry);
            if entry.split_once(SEPARATOR).is_some_and(|(of, _)| of == name)
                && self.is_abandoned(&dir)?
            {
                abandoned.push(dir);
            }
        }
        if abandoned.is_empty() {
            return Ok(());
        }
        // The log decides which objects are removed.
        self.settle(name)?;
        // The staging directories are removed last: while they exist, the next start tries again.
        // Without the list of what versions name, no object is removed.
        if let Some(named) = named() {
            self.remove_unnamed(name, &named)?;
        }
        for dir in abandoned {
            match self.disk.remove_all(&dir) {
                Err(error) if error.kind() != ErrorKind::NotFound => {
                    return Err(StoreError::io("remove", &dir)(error));
                }
                _ => {}
            }
        }
        self.remove_empty(name);
        Ok(())
    }

    fn set_record_aside(&self, name: &str, number: u64) -> Result<PathBuf, StoreError> {
        let _publish_lock = self.lock_publishing(name)?;
        let path = self.record_file(name, number);
        // Any name will do that is not ten digits: readers ignore it.
        let id = uuid::Uuid::now_v7().as_simple().to_string();
        let aside = path.with_extension(format!("damaged-{id}"));
        self.disk.rename(&path, &aside).map_err(StoreError::io("rename", &path))?;
        // Durable before it is reported: the record must not come back after a power cut.
        sync_parent(&*self.disk, &path)?;
        Ok(aside)
    }

    fn list_objects(&self, name: &str) -> Result<ObjectListing, StoreError> {
        let objects = self.objects_dir(name);
        let mut listing = ObjectListing::default();
        // Folders of other names contain no objects.
        for prefix in entries(&*self.disk, &objects)?.into_iter().filter(|name| is_prefix(name)) {
            let dir = objects.join(&prefix);
            let hashes = match self.names_in_folder(&dir) {
                Ok(hashes) => hashes,
                Err(error) => {
                    listing.unlisted.push(UnlistedObjects { digits: prefix, error });
                    continue;
                }
            };
            for hash in hashes.into_iter().filter(|name| is_hash(name)) {
                let path = dir.join(&hash);
                match self.disk.info(&path) {
                    Ok(FileInfo { bytes, modified_us: written_us, is_file, .. }) => {
                        listing.objects.push(ListedObject { hash, bytes, is_file, written_us });
                    }
                    // It was removed in between.
                    Err(error) if error.kind() == ErrorKind::NotFound => {}
                    Err(cause) => {
                        let error = StoreError::io("find", &path)(cause);
                        listing.unlisted.push(UnlistedObjects { digits: hash, error });
                    }
                }
            }
        }
        Ok(listing)
    }

    fn remove_objects(
        &self,
        name: &str,
        which: &mut dyn FnMut() -> Result<Vec<String>, StoreError>,
    ) -> Result<(), StoreError> {
        // Held while `which` decides, so that no commit relies on an object that is about to go.
        let _publish_lock = self.lock_publishing(name)?;
        let mut folders = BTreeSet::new();
        for hash in which()? {
            let path = self.object_file(name, &hash);
            self.disk.remove_file(&path).map_err(StoreError::io("remove", &path))?;
            folders.extend(path.parent().map(Path::to_owned));
        }
        // An asset that was removed does not come back.
        folders.iter().try_for_each(|folder| sync(&*self.disk, folder))?;
        self.remove_empty(name);
        Ok(())
    }

    fn remove_twin(
        &self,
        name: &str,
        mark: &mut dyn FnMut() -> Result<(), StoreError>,
    ) -> Result<(), StoreError> {
        let _publish_lock = self.lock_publishing(name)?;
        mark()?;
        let twin = self.root.join(name);
        // The log is last: as long as it has a record, the removal can be repeated.
        for folder in [OBJECTS, LEASES, COLLECTION, LOG] {
            let dir = twin.join(folder);
            match self.disk.remove_all(&dir) {
                Err(error) if error.kind() == ErrorKind::NotFound => {}
                removed => removed.map_err(StoreError::io("remove", &dir))?,
            }
            // Folder by folder, so that after a power cut the log is never gone before the objects.
            sync(&*self.disk, &twin)?;
        }
        self.disk.remove_dir(&twin).map_err(StoreError::io("remove", &twin))?;
        sync(&*self.disk, &self.root)
    }

    fn list_side_files(&self, name: &str, folder: &str) -> Result<Vec<String>, StoreError> {
        let mut files = entries(&*self.disk, &self.root.join(name).join(folder))?;
        files.retain(|file| !file.starts_with(WRITING));
        Ok(files)
    }

    fn read_side_file(&self, name: &str, file: &str) -> Result<Option<Vec<u8>>, StoreError> {
        let path = self.root.join(name).join(file);
        let file = match self.disk.open(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            opened => opened.map_err(StoreError::io("open", &path))?,
        };
        // One byte more than the limit, by which a file that is too long is recognised.
        let bytes =
            read_all(file, limits::SIDE_FILE_BYTES + 1).map_err(StoreError::io("read", &path))?;
        if bytes.len() as u64 > limits::SIDE_FILE_BYTES {
            let reason = format!("it is above {} bytes", limits::SIDE_FILE_BYTES);
            return Err(StoreError::Damaged { path, reason });
        }
        Ok(Some(bytes))
    }

    fn write_side_file(&self, name: &str, file: &str, bytes: &[u8]) -> Result<(), StoreError> {
        let path = self.root.join(name).join(file);
        check_side_file(path.clone(), bytes)?;
        create_parent(&*self.disk, &path)?;
        // A unique name, because threads of one process may write the same side file.
        let id = uuid::Uuid::now_v7().as_simple().to_string();
        let writing = path.with_file_name(format!("{WRITING}{id}"));
        let mut file = self.disk.create(&writing).map_err(StoreError::io("write", &writing))?;
        // The content is durable before it gets its name: a power cut leaves the old file or the
        // new one.
        file.write_all(bytes)
            .and_then(|()| file.sync())
            .and_then(|()| self.disk.rename(&writing, &path))
            .map_err(StoreError::io("write", &path))?;
        sync_parent(&*self.disk, &path)
    }

    fn remove_leftovers(&self, name: &str, folder: &str, before_us: i64) -> Result<(), StoreError> {
        let dir = self.root.join(name).join(folder);
        let files = entries(&*self.disk, &dir)?;
        for file in &files {
            let is_leftover = match file.strip_suffix(LOCK_ENDING) {
                Some(of) => {
                    let is_used = files.iter().any(|other| other == of);
                    !is_used && !self.is_held(name, &format!("{folder}/{file}"))?
                }
                None => file.starts_with(WRITING),
            };
            // A young file may belong to a write or to a lease that is being made.
            let path = dir.join(file);
            if is_leftover && self.disk.info(&path).is_ok_and(|found| found.modified_us < before_us)
            {
                self.disk.remove_file(&path).map_err(StoreError::io("remove", &path))?;
            }
        }
        Ok(())
    }

    fn hold(&self, name: &str, file: &str) -> Result<Option<Lock>, StoreError> {
        let path = self.root.join(name).join(file);
        path.parent().map_or(Ok(()), |dir| self.create_transient(dir))?;
        self.disk.lock(&path, Wait::Yes).map_err(StoreError::io("lock", &path))
    }

    fn is_held(&self, name: &str, file: &str) -> Result<bool, StoreError> {
        let path = self.root.join(name).join(file);
        // If the lock is free, it is taken for a moment, and released with the result.
        match self.disk.lock(&path, Wait::NoAndExisting) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
            lock => Ok(lock.map_err(StoreError::io("lock", &path))?.is_none()),
        }
    }

    fn remove_side_file(&self, name: &str, file: &str) -> Result<(), StoreError> {
        let path = self.root.join(name).join(file);
        match self.disk.remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                Err(StoreError::io("remove", &path)(error))
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::directory::LOCK;
    use std::sync::Arc;
    use std::sync::atomic::Ordering;

    use super::*;

    fn begin(local: &Local, name: &str, commit: &str) -> Result<LocalStaging, StoreError> {
        LocalStaging::begin(local, name, commit)
    }

    #[test]
    fn a_number_is_taken_once_and_a_refused_commit_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Local::new(dir.path(), Arc::new(RealDisk));
        let commit = |content: &[u8]| {
            let mut staging = begin(&objects, "street", "a")?;
            let put = staging.put(Box::new(|out| out.write_all(content)))?;
            staging.lock_publishing()?;
            staging.publish(&BTreeSet::from([&*put.hash]), 1, content).map(|()| put)
        };
        let first = commit(b"first").unwrap();
        assert_eq!(
            (first.hash.as_str(), first.bytes),
            (blake3::hash(b"first").to_hex().as_str(), 5)
        );
        let error = commit(b"second").unwrap_err();
        assert!(matches!(error, StoreError::Conflict { number: 1, .. }), "{error}");
        assert_eq!(objects.read_record("street", 1).unwrap(), b"first");
        assert_eq!(objects.version_numbers("street").unwrap(), [1]);
        objects.read_start("street", &first.hash, 0).unwrap();
        let lost = objects.object_path("street", &blake3::hash(b"second").to_hex());
        assert!(!lost.exists() && !lost.parent().unwrap().exists());
        assert_eq!(objects.unfinished_commits().unwrap(), [""; 0]);
    }

    /// A refused import of any name would leave a file otherwise.
    #[test]
    fn a_name_without_a_twin_leaves_no_lock() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Local::new(dir.path(), Arc::new(RealDisk));
        let staged = || entries(&RealDisk, &dir.path().join(STAGING)).unwrap();
        let first = begin(&objects, "street", "a").unwrap();
        let second = begin(&objects, "street", "b").unwrap();
        drop(first);
        assert_eq!(staged(), ["street.lock", "street@b"]);
        drop(second);
        assert_eq!(staged(), [""; 0]);
        // Threads that begin and give up all get locks of one file.
        let objects = &objects;
        let held = &std::sync::atomic::AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for thread in 0..4 {
                scope.spawn(move || {
                    for commit in 0..50 {
                        let mut staging =
                            begin(objects, "street", &format!("{thread}-{commit}")).unwrap();
                        staging.lock_publishing().unwrap();
                        assert_eq!(held.fetch_add(1, Ordering::SeqCst), 0, "two have the lock");
                        held.fetch_sub(1, Ordering::SeqCst);
                    }
                });
            }
        });
        assert_eq!(staged(), [""; 0]);
    }

    #[test]
    fn the_error_of_a_version_that_is_not_synced_says_that_it_is_in_place() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Local::new(dir.path(), Arc::new(RealDisk));
        let staging = begin(&objects, "street", "a").unwrap();
        let source = StoreError::io("sync", dir.path())(ErrorKind::StorageFull.into());
        let said = staging.not_synced(3, source).to_string();
        assert!(said.starts_with("version 3 of twin \"street\" is in place, but"), "{said}");
        assert!(said.contains("cannot sync"), "{said}");
    }

    #[test]
    fn only_abandoned_staging_is_removed() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Local::new(dir.path(), Arc::new(RealDisk));
        let staged = || {
            let mut names = entries(&RealDisk, &dir.path().join(STAGING)).unwrap();
            names.retain(|name| name.contains(SEPARATOR));
            names
        };
        let running = begin(&objects, "street", "a").unwrap();
        let mut killed = begin(&objects, "street", "b").unwrap();
        killed.put(Box::new(|out| out.write_all(b"staged"))).unwrap();
        let other = begin(&objects, "avenue", "c").unwrap();
        let dir_of_b = killed.dir.clone();
        // As after a kill: the kernel releases the process's locks, and no file is removed.
        killed.dir = dir.path().join("elsewhere");
        drop(killed);
        assert!(dir_of_b.join(LOCK).exists());
        assert_eq!(objects.unfinished_commits().unwrap(), ["avenue", "street"]);
        objects.remove_abandoned("street", &|| None).unwrap();
        assert_eq!(staged(), ["avenue@c", "street@a"]);
        drop((running, other));
        assert_eq!(staged(), [""; 0]);
    }
}
