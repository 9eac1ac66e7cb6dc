//! The only file that opens files of a twin: objects by hash, log records by number, staging.

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::io::{self, BufReader, BufWriter, ErrorKind, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::config;
use crate::scene::rig::is_name;

use super::StoreError;

/// Bytes read or written at once.
const BUFFER_BYTES: usize = 256 << 10;

/// The directory of twins.
#[derive(Clone, Debug)]
pub(super) struct Objects {
    root: PathBuf,
}

impl Objects {
    pub(super) fn new(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    pub(super) fn root(&self) -> &Path {
        &self.root
    }

    /// Names of the twins that have a version, sorted.
    pub(super) fn names(&self) -> Result<Vec<String>, StoreError> {
        let mut names = entries(&self.root)?;
        names.retain(|name| is_name(name) && !self.numbers(name).is_ok_and(|n| n.is_empty()));
        Ok(names)
    }

    /// Numbers of the versions in a twin's log, rising; none for an unknown twin.
    pub(super) fn numbers(&self, name: &str) -> Result<Vec<u64>, StoreError> {
        let entries = entries(&self.root.join(name).join("log"))?;
        let number = |entry: &String| {
            let number = entry.parse().ok()?;
            // "1" and "+1" are numbers, too, but nobody wrote them here.
            (record_name(number) == *entry).then_some(number)
        };
        Ok(entries.iter().filter_map(number).collect())
    }

    /// Where one log record lies.
    pub(super) fn record_path(&self, name: &str, number: u64) -> PathBuf {
        self.root.join(name).join("log").join(record_name(number))
    }

    /// Reads one log record.
    pub(super) fn record(&self, name: &str, number: u64) -> Result<Vec<u8>, StoreError> {
        let path = self.record_path(name, number);
        let file = File::open(&path).map_err(StoreError::io("open", &path))?;
        let mut bytes = Vec::new();
        file.take(config::LOG_RECORD_BYTES)
            .read_to_end(&mut bytes)
            .map_err(StoreError::io("read", &path))?;
        Ok(bytes)
    }

    /// Where an object lies.
    pub(super) fn path(&self, name: &str, hash: &str) -> PathBuf {
        self.root.join(name).join("objects").join(&hash[..2]).join(hash)
    }

    /// Opens an object for reading; [`ObjectReader::finish`] compares it with its hash.
    pub(super) fn open(&self, name: &str, hash: &str) -> Result<ObjectReader, StoreError> {
        let path = self.path(name, hash);
        let file = File::open(&path).map_err(StoreError::io("open", &path))?;
        let bytes = file.metadata().map_err(StoreError::io("read", &path))?.len();
        let hashing = Hashing { inner: file, hasher: blake3::Hasher::new() };
        let hash = hash.to_owned();
        Ok(ObjectReader {
            reader: BufReader::with_capacity(BUFFER_BYTES, hashing),
            path,
            hash,
            bytes,
        })
    }

    /// Whether an object is there, and as long as it should be; its bytes are not looked at.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it is shorter or longer.
    pub(super) fn check_present(
        &self,
        name: &str,
        hash: &str,
        bytes: u64,
    ) -> Result<(), StoreError> {
        let path = self.path(name, hash);
        let found = fs::metadata(&path).map_err(StoreError::io("find", &path))?.len();
        if found == bytes {
            return Ok(());
        }
        Err(StoreError::Damaged { path, reason: format!("it has {found} bytes, not {bytes}") })
    }

    /// Reads a part of an object, without comparing anything with a hash.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if the object ends before the part does; nothing is allocated for it.
    pub(super) fn read_range(
        &self,
        name: &str,
        hash: &str,
        bytes: Range<u64>,
    ) -> Result<Vec<u8>, StoreError> {
        let path = self.path(name, hash);
        let mut file = File::open(&path).map_err(StoreError::io("open", &path))?;
        let size = file.metadata().map_err(StoreError::io("read", &path))?.len();
        if bytes.end > size {
            let reason = format!("it has {size} bytes; {} are needed", bytes.end);
            return Err(StoreError::Damaged { path, reason });
        }
        let mut part = vec![0; (bytes.end - bytes.start) as usize];
        file.seek(SeekFrom::Start(bytes.start))
            .and_then(|_| file.read_exact(&mut part))
            .map_err(StoreError::io("read", &path))?;
        Ok(part)
    }

    /// Names of the twins with a commit that was begun and not ended: it runs, or it was killed.
    pub(super) fn begun(&self) -> Result<Vec<String>, StoreError> {
        let mut names = Vec::new();
        for entry in entries(&self.root.join(STAGING))? {
            let name = entry.split_once(OF).map(|(name, _)| name);
            names.extend(name.filter(|name| is_name(name)).map(str::to_owned));
        }
        names.dedup();
        Ok(names)
    }

    /// Begins a commit: a directory of its own, locked for as long as the process lives.
    pub(super) fn stage(&self, name: &str, commit: &str) -> Result<Staging, StoreError> {
        let dir = self.root.join(STAGING);
        create_dirs(&dir)?;
        // Whoever sweeps has the turn, and must not find the directory before its lock is taken.
        let _turn = self.turn(name)?;
        let dir = dir.join(format!("{name}{OF}{commit}"));
        fs::create_dir(&dir).map_err(StoreError::io("create", &dir))?;
        let path = dir.join(LOCK);
        let lock = File::create_new(&path).map_err(StoreError::io("create", &path))?;
        lock.lock().map_err(StoreError::io("lock", &path))?;
        Ok(Staging {
            objects: self.clone(),
            name: name.to_owned(),
            dir,
            placed: Vec::new(),
            turn: None,
            _lock: lock,
        })
    }

    /// Clears away what killed commits of a twin left: their staging, and objects they had placed
    /// and `named` does not name. Commits that run stay.
    pub(super) fn sweep(
        &self,
        name: &str,
        named: impl FnOnce() -> Option<BTreeSet<String>>,
    ) -> Result<(), StoreError> {
        let (path, turn) = self.turn_file(name)?;
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

    /// Removes the empty directories of a twin: all, if it never had a version. Whoever calls has
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
    fn turn(&self, name: &str) -> Result<File, StoreError> {
        let (path, turn) = self.turn_file(name)?;
        turn.lock().map_err(StoreError::io("lock", &path))?;
        Ok(turn)
    }

    /// The file stays for ever: were it removed, two commits could lock two files of a name.
    fn turn_file(&self, name: &str) -> Result<(PathBuf, File), StoreError> {
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

const STAGING: &str = ".staging";
/// Between the twin's name and the commit's in the name of a staging directory; in neither of them.
const OF: char = '@';
/// The file of a staging directory that its commit holds locked.
const LOCK: &str = "lock";

/// Objects of a commit that nobody sees yet. Dropped before [`Staging::publish`] succeeds, it
/// leaves nothing behind.
#[derive(Debug)]
pub(super) struct Staging {
    objects: Objects,
    name: String,
    dir: PathBuf,
    /// Objects that were not there before this commit put them.
    placed: Vec<PathBuf>,
    /// Held while publishing: others must not rely on an object that may be taken back.
    turn: Option<File>,
    /// Released by the kernel when the process ends, however it ends.
    _lock: File,
}

/// An object that was written: its hash as 64 hex digits, and its size.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Put {
    pub(super) hash: String,
    pub(super) bytes: u64,
}

impl Staging {
    /// Where it lies.
    pub(super) fn dir(&self) -> &Path {
        &self.dir
    }

    /// Writes one object, hashing on the way, and names it by its hash.
    pub(super) fn put(
        &mut self,
        write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<Put, StoreError> {
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
        Ok(Put { hash, bytes })
    }

    /// Waits until nobody else publishes a version of this twin, and then nobody does until this is
    /// dropped.
    pub(super) fn take_turn(&mut self) -> Result<(), StoreError> {
        self.turn = Some(self.objects.turn(&self.name)?);
        Ok(())
    }

    /// Makes objects that were put and then the log record visible. Whoever calls has the turn.
    ///
    /// # Errors
    /// Nothing is visible, unless it is [`StoreError::NotSynced`].
    pub(super) fn publish(
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
    pub(super) fn restore(
        &mut self,
        hashes: &BTreeSet<&str>,
        number: u64,
    ) -> Result<(), StoreError> {
        self.place(hashes)?;
        self.placed.clear();
        let path = self.objects.record_path(&self.name, number);
        sync_parent(&path).map_err(|error| self.not_synced(number, error))
    }

    fn not_synced(&self, number: u64, error: StoreError) -> StoreError {
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

/// Reads an object and hashes what it reads.
#[derive(Debug)]
pub(super) struct ObjectReader {
    reader: BufReader<Hashing>,
    path: PathBuf,
    hash: String,
    bytes: u64,
}

impl ObjectReader {
    /// Size of the file, in bytes.
    pub(super) fn size_bytes(&self) -> u64 {
        self.bytes
    }

    /// Where the object lies.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Reads what is left and compares the whole with its hash.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] with both hashes.
    pub(super) fn finish(mut self) -> Result<(), StoreError> {
        io::copy(&mut self.reader, &mut io::sink()).map_err(StoreError::io("read", &self.path))?;
        let found = self.reader.into_inner().hasher.finalize().to_hex();
        if found.as_str() == self.hash {
            return Ok(());
        }
        let reason = format!("its bytes hash to {found}");
        Err(StoreError::Damaged { path: self.path, reason })
    }
}

impl Read for ObjectReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.reader.read(buffer)
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

/// Ten digits, so that names sort as numbers do.
fn record_name(number: u64) -> String {
    format!("{number:010}")
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
        let objects = Objects::new(dir.path());
        let commit = |content: &[u8]| {
            let mut staging = objects.stage("street", "a")?;
            let put = staging.put(|out| out.write_all(content))?;
            staging.take_turn()?;
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
        objects.open("street", &first.hash).unwrap().finish().unwrap();
        let lost = objects.path("street", &blake3::hash(b"second").to_hex());
        assert!(!lost.exists() && !lost.parent().unwrap().exists());
        assert_eq!(objects.begun().unwrap(), [""; 0]);
    }

    #[test]
    fn a_version_that_may_not_last_is_not_said_to_be_gone() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Objects::new(dir.path());
        let staging = objects.stage("street", "a").unwrap();
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
    fn only_names_that_are_written_here_are_versions() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Objects::new(dir.path());
        let log = dir.path().join("street/log");
        fs::create_dir_all(&log).unwrap();
        for name in ["0000000002", "10000000000", "1", "+1", "+000000003", "00000000004", "x"] {
            fs::write(log.join(name), "").unwrap();
        }
        assert_eq!(objects.numbers("street").unwrap(), [2, 10_000_000_000]);
    }

    #[test]
    fn only_what_was_abandoned_is_swept() {
        let dir = tempfile::tempdir().unwrap();
        let objects = Objects::new(dir.path());
        let staged = || {
            let mut names = entries(&dir.path().join(STAGING)).unwrap();
            names.retain(|name| name.contains(OF));
            names
        };
        let running = objects.stage("street", "a").unwrap();
        let mut killed = objects.stage("street", "b").unwrap();
        killed.put(|out| out.write_all(b"staged")).unwrap();
        let (other, dir_of_b) = (objects.stage("avenue", "c").unwrap(), killed.dir.clone());
        // As the kernel lets go of a killed process's files, and nothing else happens.
        killed.dir = dir.path().join("elsewhere");
        drop(killed);
        assert!(dir_of_b.join(LOCK).exists());
        assert_eq!(objects.begun().unwrap(), ["avenue", "street"]);
        objects.sweep("street", || None).unwrap();
        assert_eq!(staged(), ["avenue@c", "street@a"]);
        drop((running, other));
        assert_eq!(staged(), [""; 0]);
    }
}
