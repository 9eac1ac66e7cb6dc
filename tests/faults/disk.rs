//! A disk in memory that forgets what was not synced, fails at reads and writes, and stops the
//! process between two writes; and a clock that jumps.
//!
//! The disk has two states. The *live* one is what processes see. The *durable* one has the files
//! as they were last synced, and the names at the last sync of their directory. After a power cut,
//! each name that was not synced is old or new, and each file that was not synced has its old
//! content, a part of the new one, or all of it. File systems allow any combination of these.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Cursor, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use wildcity_twin::store::clock::Clock;
use wildcity_twin::store::disk::{
    Disk, FileInfo, Lock, ReadFile, Wait, WriteFile, check_truncation,
};

use super::random::Random;
use super::reads::{BadReads, Carries, ReadFault, Reads};

/// The root of the disk.
pub(crate) const ROOT: &str = "/twins";

/// A fault of the store, as it shows on the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Plant {
    /// The directories of objects are not synced.
    MissingSync,
    /// The log record becomes durable before the objects that it names.
    RecordBeforeObjects,
    /// A lease is not removed when its version is closed.
    LeakedLease,
    /// In an object store, a put of a log record replaces an existing one.
    RecordReplaced,
    /// A file that the process once failed to read counts as absent until the process ends.
    FailedReadIsAbsent,
    /// The content of files is not synced.
    UnsyncedFiles,
    /// An unfinished upload counts with the bytes that were announced, and not with those that
    /// arrived.
    AnnouncedCounted,
}

/// A fault at a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fault {
    /// The process is killed. Its writes stay.
    Kill,
    /// The power fails. In an object store: the process is killed during its request.
    PowerCut,
    /// The disk is full, for only this write. An object store refuses one to three writes, or loses
    /// the answers.
    Full,
}

/// The time of a simulation.
#[derive(Debug)]
pub(crate) struct SimClock {
    now_us: AtomicI64,
    monotonic_us: AtomicI64,
}

/// Time that passes with each read of the clock, so that no two events have the same time.
const TICK_US: i64 = 1_000;

impl SimClock {
    pub(crate) fn new() -> Self {
        Self { now_us: AtomicI64::new(1_700_000_000_000_000), monotonic_us: AtomicI64::new(0) }
    }

    /// Changes the time of day.
    pub(crate) fn jump(&self, us: i64) {
        self.now_us.fetch_add(us, Ordering::Relaxed);
    }

    /// Lets time pass.
    pub(crate) fn wait(&self, us: i64) {
        self.jump(us);
        self.monotonic_us.fetch_add(us, Ordering::Relaxed);
    }
}

impl Clock for SimClock {
    fn now_us(&self) -> i64 {
        self.now_us.fetch_add(TICK_US, Ordering::Relaxed)
    }

    fn monotonic_us(&self) -> i64 {
        self.monotonic_us.fetch_add(TICK_US, Ordering::Relaxed)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Node {
    Dir,
    /// Index of the file's content.
    File(usize),
}

#[derive(Debug, Default)]
struct Content {
    bytes: Vec<u8>,
    /// As of the last sync.
    synced: Option<Vec<u8>>,
    modified_us: i64,
}

type Names = BTreeMap<PathBuf, Node>;

#[derive(Debug)]
struct State {
    live: Names,
    durable: Names,
    contents: Vec<Content>,
    locked: BTreeSet<PathBuf>,
    /// Writes until the fault, and which.
    fault: Option<(u64, Fault)>,
    /// The fault that has happened and stopped the process.
    stopped_by: Option<Fault>,
    plant: Option<Plant>,
    /// Directories whose sync is withheld until the record's ([`Plant::RecordBeforeObjects`]).
    withheld: Vec<PathBuf>,
    reads: Reads,
    /// Paths that count as absent ([`Plant::FailedReadIsAbsent`]).
    absent: BTreeSet<PathBuf>,
}

/// The disk as one process sees it. The handle is dead after the process was stopped.
#[derive(Clone, Debug)]
pub(crate) struct SimDisk {
    state: Arc<Mutex<State>>,
    clock: Arc<SimClock>,
    is_dead: Arc<AtomicBool>,
}

fn stopped() -> io::Error {
    io::Error::other("the process was stopped")
}

fn failed_read() -> io::Error {
    const EIO: i32 = 5;
    io::Error::from_raw_os_error(EIO)
}

fn not_found() -> io::Error {
    ErrorKind::NotFound.into()
}

impl SimDisk {
    pub(crate) fn new(clock: Arc<SimClock>, plant: Option<Plant>) -> Self {
        let names = ["/", ROOT].map(|dir| (PathBuf::from(dir), Node::Dir));
        let names = Names::from(names);
        let state = State {
            live: names.clone(),
            durable: names,
            contents: Vec::new(),
            locked: BTreeSet::new(),
            fault: None,
            stopped_by: None,
            plant,
            withheld: Vec::new(),
            reads: Reads::default(),
            absent: BTreeSet::new(),
        };
        Self { state: Arc::new(Mutex::new(state)), clock, is_dead: Arc::default() }
    }

    /// Sets the fault that happens after a number of writes, or none.
    pub(crate) fn set_fault(&self, fault: Option<(u64, Fault)>) {
        self.lock_state().fault = fault;
    }

    /// Lets some reads fail, or none.
    pub(crate) fn set_bad_reads(&self, reads: Option<BadReads>) {
        self.lock_state().reads.planned = reads;
    }

    /// Number of reads that failed or were damaged since this was last called.
    pub(crate) fn take_failed_reads(&self) -> u64 {
        self.lock_state().reads.take_failed()
    }

    /// Whether a fault waits for its write.
    pub(crate) fn has_fault(&self) -> bool {
        self.lock_state().fault.is_some()
    }

    /// Whether the process was stopped.
    pub(crate) fn is_stopped(&self) -> bool {
        self.is_dead.load(Ordering::Relaxed)
    }

    /// Stops the process.
    pub(crate) fn stop(&self, fault: Fault) {
        self.lock_state().stopped_by = Some(fault);
        self.is_dead.store(true, Ordering::Relaxed);
    }

    /// The disk for the next process, after this one was stopped.
    pub(crate) fn restarted(&self, random: &mut Random) -> Self {
        let mut state = self.lock_state();
        state.locked.clear();
        state.fault = None;
        state.reads.planned = None;
        state.withheld.clear();
        state.absent.clear();
        if state.stopped_by.take() == Some(Fault::PowerCut) {
            state.lose_power(random);
        }
        drop(state);
        let is_dead = Arc::default();
        Self { state: self.state.clone(), clock: self.clock.clone(), is_dead }
    }

    /// The files below a directory, and their sizes in bytes.
    pub(crate) fn files_below(&self, dir: &str) -> Vec<(PathBuf, u64)> {
        let state = self.lock_state();
        let dir = Path::new(ROOT).join(dir);
        let below = state.live.iter().filter(|(path, _)| path.starts_with(&dir));
        let file = |(path, node): (&PathBuf, &Node)| match node {
            Node::File(index) => Some((path.clone(), state.contents[*index].bytes.len() as u64)),
            Node::Dir => None,
        };
        below.filter_map(file).collect()
    }

    fn lock_state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no test thread panics with it")
    }

    /// The state, unless the process was stopped.
    fn living(&self) -> io::Result<MutexGuard<'_, State>> {
        if self.is_stopped() { Err(stopped()) } else { Ok(self.lock_state()) }
    }

    /// Returns the state for a read, unless it fails, and the error in the bytes that are read.
    fn read(
        &self,
        path: &Path,
        carries: Carries,
    ) -> io::Result<(MutexGuard<'_, State>, Option<ReadFault>)> {
        let mut state = self.living()?;
        if state.absent.contains(path) {
            return Err(not_found());
        }
        let fault = state.reads.next(carries, |us| self.clock.wait(us));
        if fault.is_some() && state.plant == Some(Plant::FailedReadIsAbsent) {
            state.absent.insert(path.to_owned());
        }
        // A file with content may fail later, when the content is read.
        if fault == Some(ReadFault::Error) && carries == Carries::Names {
            return Err(failed_read());
        }
        Ok((state, fault))
    }

    /// The state for a write, unless the fault is due.
    fn write(&self) -> io::Result<MutexGuard<'_, State>> {
        let mut state = self.living()?;
        match &mut state.fault {
            Some((0, Fault::Full)) => {
                state.fault = None;
                Err(ErrorKind::StorageFull.into())
            }
            Some((0, fault)) => {
                let fault = *fault;
                state.stopped_by = Some(fault);
                self.is_dead.store(true, Ordering::Relaxed);
                Err(stopped())
            }
            Some((writes, _)) => {
                *writes -= 1;
                Ok(state)
            }
            None => Ok(state),
        }
    }
}

impl State {
    fn check_parent(&self, path: &Path) -> io::Result<()> {
        let parent = path.parent().ok_or_else(not_found)?;
        match self.live.get(parent) {
            Some(Node::Dir) => Ok(()),
            Some(Node::File(_)) => Err(ErrorKind::NotADirectory.into()),
            None => Err(not_found()),
        }
    }

    fn file(&self, path: &Path) -> io::Result<usize> {
        match self.live.get(path) {
            Some(Node::File(index)) => Ok(*index),
            Some(Node::Dir) => Err(io::Error::other("it is not a regular file")),
            None => Err(not_found()),
        }
    }

    /// Size in the announcement of an unfinished upload.
    fn announced_bytes(&self, path: &Path) -> Option<u64> {
        path.extension().filter(|kind| *kind == "part")?;
        let announcement = self.file(&path.with_extension("json")).ok()?;
        let announcement: serde_json::Value =
            serde_json::from_slice(&self.contents[announcement].bytes).ok()?;
        announcement["size"].as_u64()
    }

    fn has_children(&self, dir: &Path) -> bool {
        self.live.keys().any(|path| path.parent() == Some(dir))
    }

    fn add_file(&mut self, path: &Path, modified_us: i64) -> usize {
        self.contents.push(Content { modified_us, ..Content::default() });
        let index = self.contents.len() - 1;
        self.live.insert(path.to_owned(), Node::File(index));
        index
    }

    /// Makes the names in a directory durable.
    fn sync_names(&mut self, dir: &Path) {
        let is_in = |path: &PathBuf| path.parent() == Some(dir);
        self.durable.retain(|path, _| !is_in(path));
        let names = self.live.iter().filter(|(path, _)| is_in(path));
        self.durable.extend(names.map(|(path, node)| (path.clone(), *node)));
    }

    fn lose_power(&mut self, random: &mut Random) {
        let all: BTreeSet<PathBuf> = self.live.keys().chain(self.durable.keys()).cloned().collect();
        let mut after = Names::new();
        for path in all {
            let old = self.durable.get(&path);
            let new = self.live.get(&path);
            let node = if old != new && random.once_in(2) { new } else { old };
            // Without its directory, a name is lost. Parents come first.
            let has_parent = path.parent().is_none_or(|dir| after.contains_key(dir));
            if let Some(node) = node.filter(|_| has_parent) {
                after.insert(path, *node);
            }
        }
        for content in &mut self.contents {
            if content.synced.as_ref() != Some(&content.bytes) {
                match random.below(3) {
                    0 => content.bytes = content.synced.clone().unwrap_or_default(),
                    1 => content
                        .bytes
                        .truncate(random.below(content.bytes.len() as u64 + 1) as usize),
                    _ => {}
                }
            }
            content.synced = Some(content.bytes.clone());
        }
        self.live = after.clone();
        self.durable = after;
    }
}

impl Disk for SimDisk {
    fn list(&self, dir: &Path) -> io::Result<Vec<String>> {
        let (state, _) = self.read(dir, Carries::Names)?;
        match state.live.get(dir) {
            Some(Node::Dir) => {}
            Some(Node::File(_)) => return Err(ErrorKind::NotADirectory.into()),
            None => return Err(not_found()),
        }
        let names = state.live.keys().filter(|path| path.parent() == Some(dir));
        Ok(names.filter_map(|path| Some(path.file_name()?.to_str()?.to_owned())).collect())
    }

    fn info(&self, path: &Path) -> io::Result<FileInfo> {
        let (state, _) = self.read(path, Carries::Names)?;
        let node = state.live.get(path).ok_or_else(not_found)?;
        Ok(match node {
            Node::Dir => FileInfo { bytes: 0, modified_us: 0, is_file: false, is_dir: true },
            Node::File(index) => {
                let Content { bytes, modified_us, .. } = &state.contents[*index];
                let announced = match state.plant {
                    Some(Plant::AnnouncedCounted) => state.announced_bytes(path),
                    _ => None,
                };
                let bytes = announced.unwrap_or(bytes.len() as u64);
                FileInfo { bytes, modified_us: *modified_us, is_file: true, is_dir: false }
            }
        })
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>> {
        let is_upload = path.extension().is_some_and(|kind| kind == "part" || kind == "data");
        let has_digest = is_upload || path.components().any(|part| part.as_os_str() == "objects");
        let carries = if has_digest { Carries::Digested } else { Carries::Content };
        let (state, fault) = self.read(path, carries)?;
        let index = state.file(path)?;
        let bytes = state.contents[index].bytes.clone();
        let size_bytes = bytes.len() as u64;
        // Half of the files fail when they are opened, the others when they are read.
        if fault == Some(ReadFault::Error) && size_bytes.is_multiple_of(2) {
            return Err(failed_read());
        }
        let bytes = fault.map_or(bytes.clone(), |fault| fault.damaged(bytes));
        let fails = fault == Some(ReadFault::Error);
        Ok(Box::new(OpenFile { bytes: Cursor::new(bytes), size_bytes, fails }))
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        let mut state = self.write()?;
        state.check_parent(path)?;
        let index = state.add_file(path, self.clock.now_us());
        Ok(Box::new(WrittenFile { disk: self.clone(), index }))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        let index = self.living()?.file(path)?;
        Ok(Box::new(WrittenFile { disk: self.clone(), index }))
    }

    fn create_dir(&self, dir: &Path) -> io::Result<()> {
        let mut state = self.write()?;
        state.check_parent(dir)?;
        if state.live.contains_key(dir) {
            return Err(ErrorKind::AlreadyExists.into());
        }
        state.live.insert(dir.to_owned(), Node::Dir);
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut state = self.write()?;
        let index = state.file(from)?;
        state.check_parent(to)?;
        state.live.remove(from);
        state.live.insert(to.to_owned(), Node::File(index));
        Ok(())
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut state = self.write()?;
        let index = state.file(from)?;
        state.check_parent(to)?;
        if state.live.contains_key(to) {
            return Err(ErrorKind::AlreadyExists.into());
        }
        state.live.insert(to.to_owned(), Node::File(index));
        Ok(())
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        let mut state = self.write()?;
        state.file(path)?;
        let is_lease = path.parent().is_some_and(|dir| dir.ends_with("leases"));
        if state.plant == Some(Plant::LeakedLease) && is_lease {
            return Ok(());
        }
        state.live.remove(path);
        Ok(())
    }

    fn remove_dir(&self, dir: &Path) -> io::Result<()> {
        let mut state = self.write()?;
        match state.live.get(dir) {
            Some(Node::Dir) if state.has_children(dir) => Err(ErrorKind::DirectoryNotEmpty.into()),
            Some(Node::Dir) => {
                state.live.remove(dir);
                Ok(())
            }
            Some(Node::File(_)) => Err(ErrorKind::NotADirectory.into()),
            None => Err(not_found()),
        }
    }

    fn remove_all(&self, dir: &Path) -> io::Result<()> {
        // One file after the other: the process may be stopped in between.
        let below: Vec<PathBuf> = {
            let state = self.living()?;
            let below = state.live.keys().filter(|path| path.starts_with(dir));
            below.rev().cloned().collect()
        };
        if below.is_empty() {
            return Err(not_found());
        }
        for path in below {
            self.write()?.live.remove(&path);
        }
        Ok(())
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        let mut state = self.write()?;
        if !state.live.contains_key(dir) {
            return Err(not_found());
        }
        let is_of_objects = dir.parent().is_some_and(|parent| parent.ends_with("objects"));
        match state.plant {
            Some(Plant::MissingSync) if is_of_objects => return Ok(()),
            Some(Plant::RecordBeforeObjects) if is_of_objects => {
                state.withheld.push(dir.to_owned());
                return Ok(());
            }
            _ => {}
        }
        state.sync_names(dir);
        if dir.ends_with("log") && !state.withheld.is_empty() {
            drop(state);
            // The process may be stopped between the record's sync and those of the objects.
            let mut state = self.write()?;
            for dir in std::mem::take(&mut state.withheld) {
                state.sync_names(&dir);
            }
        }
        Ok(())
    }

    fn lock(&self, path: &Path, wait: Wait) -> io::Result<Option<Lock>> {
        let (mut state, _) = self.read(path, Carries::Names)?;
        if state.file(path).is_err() {
            if wait == Wait::NoAndExisting {
                return Err(not_found());
            }
            drop(state);
            state = self.write()?;
            state.check_parent(path)?;
            state.add_file(path, self.clock.now_us());
        }
        if !state.locked.insert(path.to_owned()) {
            assert_ne!(wait, Wait::Yes, "a deadlock: {} is locked", path.display());
            return Ok(None);
        }
        drop(state);
        Ok(Some(Lock::held_by(HeldLock { disk: self.clone(), path: path.to_owned() })))
    }
}

/// A lock of a living process.
#[derive(Debug)]
struct HeldLock {
    disk: SimDisk,
    path: PathBuf,
}

impl Drop for HeldLock {
    fn drop(&mut self) {
        // The locks of a stopped process are gone already, and may be another's.
        if !self.disk.is_stopped() {
            self.disk.lock_state().locked.remove(&self.path);
        }
    }
}

#[derive(Debug)]
struct OpenFile {
    bytes: Cursor<Vec<u8>>,
    size_bytes: u64,
    /// Whether its bytes cannot be read.
    fails: bool,
}

impl Read for OpenFile {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.fails { Err(failed_read()) } else { self.bytes.read(buffer) }
    }
}

impl Seek for OpenFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.bytes.seek(to)
    }
}

impl ReadFile for OpenFile {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.size_bytes)
    }
}

#[derive(Debug)]
struct WrittenFile {
    disk: SimDisk,
    index: usize,
}

impl Write for WrittenFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.disk.write()?;
        let content = &mut state.contents[self.index];
        content.bytes.extend_from_slice(bytes);
        content.modified_us = self.disk.clock.now_us();
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl WriteFile for WrittenFile {
    fn truncate(&mut self, bytes: u64) -> io::Result<()> {
        let mut state = self.disk.write()?;
        let content = &mut state.contents[self.index];
        check_truncation(content.bytes.len() as u64, bytes)?;
        content.bytes.truncate(bytes as usize);
        Ok(())
    }

    fn sync(&mut self) -> io::Result<()> {
        let mut state = self.disk.write()?;
        if state.plant == Some(Plant::UnsyncedFiles) {
            return Ok(());
        }
        let content = &mut state.contents[self.index];
        content.synced = Some(content.bytes.clone());
        Ok(())
    }
}
