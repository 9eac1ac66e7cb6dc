//! Twins in a directory. Only this folder opens files of a twin.

pub(super) mod disk_cache;
pub(super) mod staging;

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use crate::limits;
use wildcity_scene::rig::is_name;

use super::StoreError;
use super::objects::{self, ListedObject, ObjectBackend, Staging, is_hash, log_numbers};

/// Bytes read or written at once.
const BUFFER_BYTES: usize = 256 << 10;
const STAGING: &str = ".staging";
/// Between the twin's name and the commit's in the name of a staging directory; in neither of them.
const OF: char = '@';
/// The file of a staging directory that its commit holds locked.
const LOCK: &str = "lock";
/// How the name of a note begins that is being written.
const WRITING: char = '~';

/// The directory of twins.
#[derive(Clone, Debug)]
pub(in crate::store) struct Local {
    root: PathBuf,
}

impl ObjectBackend for Local {
    fn root(&self) -> &Path {
        &self.root
    }

    fn names(&self) -> Result<Vec<String>, StoreError> {
        let mut names = entries(&self.root)?;
        names.retain(|name| is_name(name) && !self.numbers(name).is_ok_and(|n| n.is_empty()));
        Ok(names)
    }

    fn numbers(&self, name: &str) -> Result<Vec<u64>, StoreError> {
        Ok(log_numbers(entries(&self.root.join(name).join("log"))?))
    }

    fn record(&self, name: &str, number: u64) -> Result<Vec<u8>, StoreError> {
        let path = self.record_path(name, number);
        let file = File::open(&path).map_err(StoreError::io("open", &path))?;
        let mut bytes = Vec::new();
        file.take(limits::LOG_RECORD_BYTES)
            .read_to_end(&mut bytes)
            .map_err(StoreError::io("read", &path))?;
        Ok(bytes)
    }

    fn read_object(&self, name: &str, hash: &str, limit_bytes: u64) -> Result<Vec<u8>, StoreError> {
        let (path, mut file, size) = self.open(name, hash)?;
        if size > limit_bytes {
            let reason = format!("{size} bytes are above {limit_bytes}");
            return Err(StoreError::Damaged { path, reason });
        }
        let mut bytes = Vec::with_capacity(size as usize);
        (&mut file)
            .take(limit_bytes)
            .read_to_end(&mut bytes)
            .map_err(StoreError::io("read", &path))?;
        match objects::check_hash(&bytes, hash) {
            Ok(()) => Ok(bytes),
            Err(reason) => Err(StoreError::Damaged { path, reason }),
        }
    }

    fn read_start(&self, name: &str, hash: &str, most_bytes: usize) -> Result<Vec<u8>, StoreError> {
        let (path, file, _) = self.open(name, hash)?;
        let failed = || StoreError::io("read", &path);
        let mut reader = Hashing { inner: file, hasher: blake3::Hasher::new() };
        let mut start = Vec::new();
        (&mut reader).take(most_bytes as u64).read_to_end(&mut start).map_err(failed())?;
        let mut buffer = vec![0; BUFFER_BYTES];
        while reader.read(&mut buffer).map_err(failed())? > 0 {}
        let found = reader.hasher.finalize().to_hex();
        if found.as_str() == hash {
            return Ok(start);
        }
        Err(StoreError::Damaged { path, reason: format!("its bytes hash to {found}") })
    }

    fn read_range(
        &self,
        name: &str,
        object: &str,
        bytes: Range<u64>,
        hash: &[u8; 32],
    ) -> Result<Vec<u8>, StoreError> {
        let (path, mut file, size) = self.open(name, object)?;
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
        let (path, mut file, _) = self.open(name, hash)?;
        let (mut buffer, mut bytes) = (vec![0; BUFFER_BYTES], 0);
        loop {
            match file.read(&mut buffer).map_err(StoreError::io("read", &path))? {
                0 => return Ok(bytes),
                read => bytes += read as u64,
            }
        }
    }

    fn check_present(&self, name: &str, hash: &str, bytes: u64) -> Result<(), StoreError> {
        let (path, _, found) = self.open(name, hash)?;
        if found == bytes {
            return Ok(());
        }
        Err(StoreError::Damaged { path, reason: format!("it has {found} bytes, not {bytes}") })
    }

    fn stage(&self, name: &str, commit: &str) -> Result<Staging, StoreError> {
        self.begin(name, commit).map(Staging::Local)
    }

    fn unfinished_commits(&self) -> Result<Vec<String>, StoreError> {
        let mut names = Vec::new();
        for entry in entries(&self.root.join(STAGING))? {
            let name = entry.split_once(OF).map(|(name, _)| name);
            names.extend(name.filter(|name| is_name(name)).map(str::to_owned));
        }
        names.dedup();
        Ok(names)
    }

    fn remove_abandoned(
        &self,
        name: &str,
        named: &dyn Fn() -> Option<BTreeSet<String>>,
    ) -> Result<(), StoreError> {
        let (path, turn) = self.publish_lock_file(name)?;
        match turn.try_lock() {
            Ok(()) => {}
            // Somebody publishes or sweeps.
            Err(TryLockError::WouldBlock) => return Ok(()),
            Err(TryLockError::Error(cause)) => return Err(StoreError::io("lock", &path)(cause)),
        }
        let mut abandoned = Vec::new();
        for entry in entries(&self.root.join(STAGING))? {
            let dir = self.root.join(STAGING).join(&entry);
            if entry.split_once(OF).is_some_and(|(of, _)| of == name) && is_abandoned(&dir)? {
                abandoned.push(dir);
            }
        }
        if abandoned.is_empty() {
            return Ok(());
        }
        // The staging goes last: while it is there, the next start comes here again.
        if let Some(named) = named() {
            self.remove_unnamed(name, &named)?;
        }
        for dir in abandoned {
            match fs::remove_dir_all(&dir) {
                Err(error) if error.kind() != ErrorKind::NotFound => {
                    return Err(StoreError::io("remove", &dir)(error));
                }
                _ => {}
            }
        }
        self.remove_empty(name);
        Ok(())
    }

    fn list(&self, name: &str) -> Result<Vec<ListedObject>, StoreError> {
        let objects = self.root.join(name).join("objects");
        let mut listed = Vec::new();
        for prefix in entries(&objects)? {
            for hash in entries(&objects.join(&prefix))? {
                let path = objects.join(&prefix).join(&hash);
                let found = fs::metadata(&path).map_err(StoreError::io("find", &path))?;
                let written = found.modified().map_err(StoreError::io("find", &path))?;
                let since = written.duration_since(UNIX_EPOCH).unwrap_or_default();
                if is_hash(&hash) {
                    let written_us = i64::try_from(since.as_micros()).unwrap_or(i64::MAX);
                    listed.push(ListedObject { hash, bytes: found.len(), written_us });
                }
            }
        }
        Ok(listed)
    }

    fn remove(
        &self,
        name: &str,
        which: &mut dyn FnMut() -> Result<Vec<String>, StoreError>,
    ) -> Result<(), StoreError> {
        let _turn = self.lock_publishing(name)?;
        for hash in which()? {
            let path = self.path(name, &hash);
            fs::remove_file(&path).map_err(StoreError::io("remove", &path))?;
        }
        self.remove_empty(name);
        Ok(())
    }

    fn list_side_files(&self, name: &str, folder: &str) -> Result<Vec<String>, StoreError> {
        let mut notes = entries(&self.root.join(name).join(folder))?;
        notes.retain(|note| !note.starts_with(WRITING));
        Ok(notes)
    }

    fn read_side_file(&self, name: &str, note: &str) -> Result<Option<Vec<u8>>, StoreError> {
        let path = self.root.join(name).join(note);
        let file = match File::open(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            opened => opened.map_err(StoreError::io("open", &path))?,
        };
        let mut bytes = Vec::new();
        file.take(limits::SIDE_FILE_BYTES + 1)
            .read_to_end(&mut bytes)
            .map_err(StoreError::io("read", &path))?;
        if bytes.len() as u64 > limits::SIDE_FILE_BYTES {
            let reason = format!("it is above {} bytes", limits::SIDE_FILE_BYTES);
            return Err(StoreError::Damaged { path, reason });
        }
        Ok(Some(bytes))
    }

    fn write_side_file(&self, name: &str, note: &str, bytes: &[u8]) -> Result<(), StoreError> {
        let path = self.root.join(name).join(note);
        objects::check_side_file(path.clone(), bytes)?;
        create_parent(&path)?;
        // A name of its own: threads of one process may write the same note.
        let id = uuid::Uuid::now_v7().as_simple().to_string();
        let writing = path.with_file_name(format!("{WRITING}{id}"));
        let mut file = File::create(&writing).map_err(StoreError::io("write", &writing))?;
        file.write_all(bytes)
            .and_then(|()| file.sync_all())
            .and_then(|()| fs::rename(&writing, &path))
            .map_err(StoreError::io("write", &path))?;
        sync_parent(&path)
    }

    fn remove_side_file(&self, name: &str, note: &str) -> Result<(), StoreError> {
        let path = self.root.join(name).join(note);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                Err(StoreError::io("remove", &path)(error))
            }
            _ => Ok(()),
        }
    }
}

impl Local {
    pub(in crate::store) fn new(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    /// Opens an object: where it lies, it, and its size in bytes.
    fn open(&self, name: &str, hash: &str) -> Result<(PathBuf, File, u64), StoreError> {
        let path = self.path(name, hash);
        let file = File::open(&path).map_err(StoreError::io("open", &path))?;
        let bytes = file.metadata().map_err(StoreError::io("read", &path))?.len();
        Ok((path, file, bytes))
    }

    /// A directory of its own, locked for as long as the process lives.
    fn begin(&self, name: &str, commit: &str) -> Result<staging::Staging, StoreError> {
        // Whoever sweeps has the turn, and must not find the directory before its lock is taken.
        let _turn = self.lock_publishing(name)?;
        let dir = self.root.join(STAGING).join(format!("{name}{OF}{commit}"));
        fs::create_dir(&dir).map_err(StoreError::io("create", &dir))?;
        let path = dir.join(LOCK);
        let lock = File::create_new(&path).map_err(StoreError::io("create", &path))?;
        lock.lock().map_err(StoreError::io("lock", &path))?;
        Ok(staging::Staging {
            objects: self.clone(),
            name: name.to_owned(),
            dir,
            placed: Vec::new(),
            turn: None,
            _lock: lock,
        })
    }

    fn remove_unnamed(&self, name: &str, named: &BTreeSet<String>) -> Result<(), StoreError> {
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

    /// Removes the empty directories of a twin: all, if it never had a version, and then nobody noted
    /// anything of it. Notes are written without a turn, so their directories stay. Whoever calls has
    /// the turn.
    fn remove_empty(&self, name: &str) {
        let twin = self.root.join(name);
        for prefix in entries(&twin.join("objects")).unwrap_or_default() {
            let _ = fs::remove_dir(twin.join("objects").join(prefix));
        }
        for dir in [twin.join("objects"), twin.join("log"), twin] {
            let _ = fs::remove_dir(dir);
        }
    }

    /// Waits until nobody else publishes a version of a twin.
    fn lock_publishing(&self, name: &str) -> Result<File, StoreError> {
        create_dirs(&self.root.join(STAGING))?;
        let (path, turn) = self.publish_lock_file(name)?;
        turn.lock().map_err(StoreError::io("lock", &path))?;
        Ok(turn)
    }

    /// The file stays for ever: were it removed, two commits could lock two files of a name.
    fn publish_lock_file(&self, name: &str) -> Result<(PathBuf, File), StoreError> {
        let path = self.root.join(STAGING).join(format!("{name}.lock"));
        let file = File::options().create(true).append(true).open(&path);
        let file = file.map_err(StoreError::io("create", &path))?;
        Ok((path, file))
    }
}

/// Whether nobody holds a staging directory. Whoever asks has the turn.
fn is_abandoned(dir: &Path) -> Result<bool, StoreError> {
    let path = dir.join(LOCK);
    match File::options().append(true).open(&path) {
        Ok(lock) => match lock.try_lock() {
            Ok(()) => Ok(true),
            Err(TryLockError::WouldBlock) => Ok(false),
            Err(TryLockError::Error(cause)) => Err(StoreError::io("lock", &path)(cause)),
        },
        // Killed before there was one, or its own process removes it right now.
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(dir.exists()),
        Err(error) => Err(StoreError::io("open", &path)(error)),
    }
}

/// A file and the hash of what passed through it.
#[derive(Debug)]
struct Hashing {
    inner: File,
    hasher: blake3::Hasher,
}

impl Read for Hashing {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.hasher.update(&buffer[..read]);
        Ok(read)
    }
}

impl Write for Hashing {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

/// Names in a directory, sorted; none if it does not exist.
fn entries(dir: &Path) -> Result<Vec<String>, StoreError> {
    let failed = || StoreError::io("list", dir);
    let listing = match fs::read_dir(dir) {
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            return Ok(Vec::new());
        }
        listing => listing.map_err(failed())?,
    };
    let mut names = Vec::new();
    for entry in listing {
        // A name that is not UTF-8 is not ours.
        names.extend(entry.map_err(failed())?.file_name().into_string());
    }
    names.sort_unstable();
    Ok(names)
}

fn create_parent(path: &Path) -> Result<(), StoreError> {
    path.parent().map_or(Ok(()), create_dirs)
}

/// Makes a directory and those above it that are missing, each to last through a power cut: what is
/// written into a directory is lost with the directory's own entry.
fn create_dirs(dir: &Path) -> Result<(), StoreError> {
    // The parent of "twins" is "", which is the directory that we are in.
    if dir.as_os_str().is_empty() || dir.is_dir() {
        return Ok(());
    }
    create_parent(dir)?;
    match fs::create_dir(dir) {
        // Another process may have been faster.
        Err(error) if error.kind() != ErrorKind::AlreadyExists || !dir.is_dir() => {
            Err(StoreError::io("create", dir)(error))
        }
        _ => sync_parent(dir),
    }
}

/// Makes a new name last through a power cut: the directory is written out, too.
fn sync_parent(path: &Path) -> Result<(), StoreError> {
    path.parent().map_or(Ok(()), sync)
}

fn sync(dir: &Path) -> Result<(), StoreError> {
    let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
    File::open(dir).and_then(|dir| dir.sync_all()).map_err(StoreError::io("sync", dir))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_taken_once_and_the_loser_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Local::new(dir.path());
        let commit = |content: &[u8]| {
            let mut staging = objects.begin("street", "a")?;
            let put = staging.put(|out| out.write_all(content))?;
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
        assert_eq!(objects.record("street", 1).unwrap(), b"first");
        assert_eq!(objects.numbers("street").unwrap(), [1]);
        objects.read_start("street", &first.hash, 0).unwrap();
        let lost = objects.path("street", &blake3::hash(b"second").to_hex());
        assert!(!lost.exists() && !lost.parent().unwrap().exists());
        assert_eq!(objects.unfinished_commits().unwrap(), [""; 0]);
    }

    #[test]
    fn a_version_that_may_not_last_is_not_said_to_be_gone() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Local::new(dir.path());
        let staging = objects.begin("street", "a").unwrap();
        let source = StoreError::io("sync", dir.path())(ErrorKind::StorageFull.into());
        let said = staging.not_synced(3, source).to_string();
        assert!(said.starts_with("version 3 of twin \"street\" is in place, but"), "{said}");
        assert!(said.contains("cannot sync"), "{said}");
    }

    #[test]
    fn directories_are_made_with_those_above_them() {
        let dir = tempfile::tempdir().unwrap();
        create_dirs(&dir.path().join("a/b/c")).unwrap();
        create_dirs(&dir.path().join("a/b/c")).unwrap();
        assert!(dir.path().join("a/b/c").is_dir());
        fs::write(dir.path().join("file"), "").unwrap();
        let said = create_dirs(&dir.path().join("file/d")).unwrap_err().to_string();
        assert!(said.starts_with("cannot create"), "{said}");
    }

    #[test]
    fn only_what_was_abandoned_is_swept() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Local::new(dir.path());
        let staged = || {
            let mut names = entries(&dir.path().join(STAGING)).unwrap();
            names.retain(|name| name.contains(OF));
            names
        };
        let running = objects.begin("street", "a").unwrap();
        let mut killed = objects.begin("street", "b").unwrap();
        killed.put(|out| out.write_all(b"staged")).unwrap();
        let (other, dir_of_b) = (objects.begin("avenue", "c").unwrap(), killed.dir.clone());
        // As the kernel lets go of a killed process's files, and nothing else happens.
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
