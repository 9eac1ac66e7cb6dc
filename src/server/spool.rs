//! Uploads on disk, until they are pushed or too old.
//!
//! ```text
//! <spool>/lock             held by the server that spools here
//! <spool>/<id>.json        what was announced
//! <spool>/<id>.part        what has arrived
//! <spool>/<id>.data        all of it, and it is what the digest promises
//! <spool>/<id>.gone        thrown away: freeing a large file takes a while
//! ```
//!
//! The id is the digest: the same content is the same upload. Half an upload survives a restart, and
//! goes on where it stopped.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use tokio::sync::{Mutex as AsyncMutex, Notify, OwnedMutexGuard};
use tokio::time::timeout;

use crate::limits;

use super::fault::{Fault, is_full};

/// How much a server keeps of uploads; see the constants in [`crate::limits`] that are the defaults.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpoolLimits {
    /// Uploads at once, finished or not.
    pub uploads: usize,
    /// Bytes of all of them, as announced.
    pub bytes: u64,
    /// How long one is kept after its last byte.
    pub age: Duration,
}

impl Default for SpoolLimits {
    fn default() -> Self {
        let (uploads, bytes, age) = (limits::UPLOADS, limits::SPOOL_BYTES, limits::UPLOAD_AGE);
        Self { uploads, bytes, age }
    }
}

/// The uploads of a server.
pub(super) struct Spool {
    dir: PathBuf,
    limits: SpoolLimits,
    uploads: Mutex<BTreeMap<String, Arc<Upload>>>,
    _lock: File,
}

/// One upload. Whoever holds one keeps it from being thrown away.
#[derive(Debug)]
pub(super) struct Upload {
    id: String,
    announced: Announced,
    dir: PathBuf,
    /// Bytes on disk; [`COMPLETE`] once they are checked.
    held: AtomicU64,
    touched: Mutex<SystemTime>,
    writing: Arc<AsyncMutex<()>>,
    /// Asks who writes to make room for another connection.
    leave: Notify,
}

/// What is said of a file before it comes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Announced {
    pub(super) name: String,
    pub(super) size: u64,
    pub(super) digest: Digest,
}

/// A digest, as `blake3:` or `sha-256:` and 64 hex digits.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub(super) struct Digest {
    algorithm: Algorithm,
    hash: [u8; 32],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Algorithm {
    Blake3,
    Sha256,
}

const COMPLETE: u64 = u64::MAX;

impl Spool {
    /// Opens a directory for one server, and takes up what an earlier one left.
    pub(super) fn open(dir: &Path, limits: SpoolLimits) -> io::Result<Self> {
        fs::create_dir_all(dir)?;
        let lock = OpenOptions::new().create(true).append(true).open(dir.join("lock"))?;
        lock.try_lock().map_err(|error| match error {
            fs::TryLockError::Error(error) => error,
            fs::TryLockError::WouldBlock => {
                io::Error::other("another server uses it: give one of them another --uploads DIR")
            }
        })?;
        let spool = Self { dir: dir.to_owned(), limits, uploads: Mutex::default(), _lock: lock };
        spool.take_up()?;
        Ok(spool)
    }

    /// The upload of a file, begun if it is new; what is too old makes room.
    pub(super) fn begin(&self, announced: Announced) -> Result<Arc<Upload>, Fault> {
        if announced.size > limits::UPLOAD_BYTES {
            let must = format!("{}; at most {} are accepted", announced.size, limits::UPLOAD_BYTES);
            return Err(Fault::OutOfRange { field: "size".to_owned(), must });
        }
        let id = announced.digest.id();
        // Dropped after the lock is given back.
        let mut gone = Vec::new();
        let mut uploads = self.lock();
        if let Some(upload) = uploads.get(&id) {
            if upload.announced.size != announced.size {
                let [promised, found] = [announced.size, upload.announced.size];
                return Err(Fault::UploadDigest {
                    what: "the size of that content",
                    promised: format!("{promised} bytes"),
                    found: format!("{found} bytes"),
                });
            }
            upload.touch();
            return Ok(upload.clone());
        }
        self.make_room(&mut uploads, announced.size, &mut gone)?;
        let upload = Arc::new(Upload::new(&self.dir, announced, 0, SystemTime::now()));
        let created = upload.create().map_err(|cause| upload.failed("write to", cause));
        let begun = created.and_then(|()| match upload.announced.size {
            0 => upload.finish(),
            _ => Ok(()),
        });
        // Nothing is left of what is refused.
        begun.inspect_err(|_| gone.push(upload.set_aside()))?;
        uploads.insert(id, upload.clone());
        Ok(upload)
    }

    /// An upload that was begun.
    pub(super) fn get(&self, id: &str) -> Result<Arc<Upload>, Fault> {
        let unknown = || Fault::UnknownUpload { id: id.to_owned() };
        self.lock().get(id).cloned().ok_or_else(unknown)
    }

    /// Throws an upload away.
    pub(super) fn forget(&self, upload: &Upload) {
        let mut uploads = self.lock();
        uploads.remove(&upload.id);
        // Under the lock: its name may be given again right after.
        let gone = upload.set_aside();
        drop(uploads);
        drop(gone);
    }

    /// Throws away what is too old, and used by nobody.
    pub(super) fn reap(&self) {
        let too_old = |upload: &Arc<Upload>| {
            let idle = upload.touched().elapsed().unwrap_or_default() >= self.limits.age;
            idle && Arc::strong_count(upload) == 1
        };
        // Dropped after the lock is given back.
        let mut gone = Vec::new();
        self.lock().retain(|_, upload| {
            let keep = !too_old(upload);
            if !keep {
                gone.push(upload.set_aside());
            }
            keep
        });
    }

    /// How long an upload is kept.
    pub(super) fn age(&self) -> Duration {
        self.limits.age
    }

    /// How many there are, and their bytes as announced.
    pub(super) fn load(&self) -> (usize, u64) {
        let uploads = self.lock();
        (uploads.len(), uploads.values().map(|upload| upload.announced.size).sum())
    }

    /// Finished uploads that nobody uses go first, the oldest first.
    fn make_room(
        &self,
        uploads: &mut BTreeMap<String, Arc<Upload>>,
        size: u64,
        gone: &mut Vec<Gone>,
    ) -> Result<(), Fault> {
        loop {
            let bytes: u64 = uploads.values().map(|upload| upload.announced.size).sum();
            let fits = bytes.checked_add(size).is_some_and(|sum| sum <= self.limits.bytes);
            if fits && uploads.len() < self.limits.uploads {
                return Ok(());
            }
            let unused =
                |upload: &&Arc<Upload>| upload.is_complete() && Arc::strong_count(upload) == 1;
            let oldest = uploads.values().filter(unused).min_by_key(|upload| upload.touched());
            let Some(id) = oldest.map(|upload| upload.id.clone()) else {
                let (count, limits) = (uploads.len(), self.limits);
                let reason = format!(
                    "{count} uploads of {bytes} bytes are kept; {} of {} bytes may be; finish or \
                     wait",
                    limits.uploads, limits.bytes
                );
                return Err(Fault::StorageFull { reason });
            };
            if let Some(upload) = uploads.remove(&id) {
                gone.push(upload.set_aside());
            }
        }
    }

    /// Reads the directory; what belongs to no upload, or to none that can go on, is removed. Files
    /// of other names are left alone.
    fn take_up(&self) -> io::Result<()> {
        let mut uploads = self.lock();
        let mut names = Vec::new();
        for entry in fs::read_dir(&self.dir)? {
            names.extend(entry?.file_name().into_string());
        }
        let is_ours = |name: &str| {
            let (id, kind) = name.split_once('.')?;
            let known = ["json", "part", "data", "gone"].contains(&kind);
            Digest::of_id(id).filter(|_| known).map(|_| id.to_owned())
        };
        let ids: BTreeSet<String> = names.iter().filter_map(|name| is_ours(name)).collect();
        for id in ids {
            let path = |kind: &str| self.dir.join(format!("{id}.{kind}"));
            let announced = fs::read(path("json")).ok();
            let announced: Option<Announced> =
                announced.and_then(|text| serde_json::from_slice(&text).ok());
            let held = |kind: &str| fs::metadata(path(kind)).ok();
            let whole = |size: u64| held("data").filter(|data| data.len() == size);
            let upload = announced.filter(|announced| announced.digest.id() == id);
            let upload = upload.and_then(|announced| {
                let size = announced.size;
                let (held, meta) = match (whole(size), held("part")) {
                    (Some(data), _) => (COMPLETE, data),
                    (None, Some(part)) if part.len() <= size => (part.len(), part),
                    _ => return None,
                };
                let touched = meta.modified().unwrap_or_else(|_| SystemTime::now());
                Some(Upload::new(&self.dir, announced, held, touched))
            });
            match upload {
                Some(upload) => {
                    uploads.insert(id, Arc::new(upload));
                }
                None => drop(Gone::of(&self.dir, &id)),
            }
        }
        Ok(())
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Arc<Upload>>> {
        // A panic elsewhere leaves nothing half-done behind this lock.
        self.uploads.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Upload {
    fn new(dir: &Path, announced: Announced, held: u64, touched: SystemTime) -> Self {
        Self {
            id: announced.digest.id(),
            announced,
            dir: dir.to_owned(),
            held: held.into(),
            touched: Mutex::new(touched),
            writing: Arc::default(),
            leave: Notify::new(),
        }
    }

    pub(super) fn id(&self) -> &str {
        &self.id
    }

    pub(super) fn announced(&self) -> &Announced {
        &self.announced
    }

    /// Bytes that have arrived.
    pub(super) fn offset(&self) -> u64 {
        self.held.load(Ordering::Acquire).min(self.announced.size)
    }

    pub(super) fn is_complete(&self) -> bool {
        self.held.load(Ordering::Acquire) == COMPLETE
    }

    /// Where a finished upload lies.
    pub(super) fn path(&self) -> PathBuf {
        self.file("data")
    }

    /// Becomes true when another connection wants to write.
    pub(super) fn leave(&self) -> tokio::sync::futures::Notified<'_> {
        self.leave.notified()
    }

    /// Takes the upload from the connection that writes it, if one does: after a failure of the
    /// network the client knows long before the server that it is dead.
    pub(super) async fn write(self: &Arc<Self>) -> Result<Writer, Fault> {
        self.leave.notify_waiters();
        let held = timeout(limits::UPLOAD_SILENCE, self.writing.clone().lock_owned()).await;
        let held = held.map_err(|_| Fault::Busy { what: "connections that write it", limit: 1 })?;
        Ok(Writer { upload: self.clone(), _held: held, file: None })
    }

    fn create(&self) -> io::Result<()> {
        let announced = serde_json::to_vec(&self.announced)?;
        fs::write(self.file("json"), announced)?;
        File::create(self.file("part")).map(|_| ())
    }

    /// Checks what arrived against the digest. What does not fit is removed by the caller.
    fn finish(&self) -> Result<(), Fault> {
        let part = self.file("part");
        let found = self.announced.digest.algorithm.of_file(&part);
        let found = found.map_err(|cause| self.failed("read", cause))?;
        if found != self.announced.digest {
            return Err(Fault::UploadDigest {
                what: "the digest of what arrived",
                promised: String::from(self.announced.digest.clone()),
                found: found.into(),
            });
        }
        fs::rename(part, self.file("data")).map_err(|cause| self.failed("write to", cause))?;
        self.held.store(COMPLETE, Ordering::Release);
        Ok(())
    }

    fn failed(&self, action: &'static str, cause: io::Error) -> Fault {
        if is_full(&cause) {
            return Fault::StorageFull { reason: format!("{cause}") };
        }
        Fault::Spool { action, cause }
    }

    /// Takes its files away, at once: a new upload may have its name.
    fn set_aside(&self) -> Gone {
        Gone::of(&self.dir, &self.id)
    }

    fn file(&self, kind: &str) -> PathBuf {
        self.dir.join(format!("{}.{kind}", self.id))
    }

    fn touch(&self) {
        *self.touched.lock().unwrap_or_else(PoisonError::into_inner) = SystemTime::now();
    }

    fn touched(&self) -> SystemTime {
        *self.touched.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The right to append to an upload. Its methods block.
pub(super) struct Writer {
    upload: Arc<Upload>,
    _held: OwnedMutexGuard<()>,
    file: Option<File>,
}

impl Writer {
    /// Appends; what does not go in whole is cut off again.
    pub(super) fn append(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        let upload = self.upload.clone();
        let start = upload.offset();
        let written = self.file().and_then(|file| {
            file.set_len(start)?;
            file.write_all(bytes)
        });
        match written {
            Ok(()) => {
                upload.held.store(start + bytes.len() as u64, Ordering::Release);
                upload.touch();
                Ok(())
            }
            Err(cause) => {
                // The first failure says more than one to clean up after it.
                let _ = self.file().and_then(|file| file.set_len(start));
                Err(upload.failed("write to", cause))
            }
        }
    }

    /// Goes back to an earlier offset.
    pub(super) fn cut(&mut self, offset: u64) -> Result<(), Fault> {
        let cut = self.file().and_then(|file| file.set_len(offset));
        cut.map_err(|cause| self.upload.failed("write to", cause))?;
        self.upload.held.store(offset, Ordering::Release);
        Ok(())
    }

    /// After the last byte: syncs, and checks the whole against its digest.
    pub(super) fn finish(mut self) -> Result<(), Fault> {
        let synced = self.file().and_then(|file| file.sync_all());
        synced.map_err(|cause| self.upload.failed("write to", cause))?;
        self.upload.finish()
    }

    fn file(&mut self) -> io::Result<&mut File> {
        if self.file.is_none() {
            let path = self.upload.file("part");
            self.file = Some(OpenOptions::new().append(true).open(path)?);
        }
        self.file.as_mut().ok_or_else(|| io::ErrorKind::NotFound.into())
    }
}

impl Digest {
    fn id(&self) -> String {
        String::from(self.clone()).replace(':', "-")
    }

    fn of_id(id: &str) -> Option<Self> {
        let at = id.rfind('-')?;
        format!("{}:{}", &id[..at], &id[at + 1..]).try_into().ok()
    }
}

impl TryFrom<String> for Digest {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let parsed = text.split_once(':').and_then(|(algorithm, hex)| {
            let algorithm = [Algorithm::Blake3, Algorithm::Sha256]
                .into_iter()
                .find(|known| known.name() == algorithm)?;
            let is_lower = hex.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
            let hash = blake3::Hash::from_hex(hex).ok().filter(|_| is_lower)?;
            Some(Self { algorithm, hash: *hash.as_bytes() })
        });
        parsed.ok_or_else(|| {
            format!(
                "{text:?} is no digest: expected blake3: or sha-256: and 64 lower-case hex digits"
            )
        })
    }
}

impl From<Digest> for String {
    fn from(Digest { algorithm, hash }: Digest) -> Self {
        format!("{}:{}", algorithm.name(), blake3::Hash::from_bytes(hash).to_hex())
    }
}

impl Algorithm {
    fn name(self) -> &'static str {
        match self {
            Self::Blake3 => "blake3",
            Self::Sha256 => "sha-256",
        }
    }

    fn of_file(self, path: &Path) -> io::Result<Digest> {
        let mut file = File::open(path)?;
        let (mut blake3, mut sha256) = (blake3::Hasher::new(), Sha256::new());
        let hash = match self {
            Self::Blake3 => {
                io::copy(&mut file, &mut blake3)?;
                *blake3.finalize().as_bytes()
            }
            Self::Sha256 => {
                io::copy(&mut file, &mut sha256)?;
                sha256.finalize().into()
            }
        };
        Ok(Digest { algorithm: self, hash })
    }
}

/// What an upload had on disk. Dropped, it is freed, which for tens of GB takes a while.
#[must_use]
struct Gone(PathBuf);

impl Gone {
    fn of(dir: &Path, id: &str) -> Self {
        let [part, data, gone, json] =
            ["part", "data", "gone", "json"].map(|kind| dir.join(format!("{id}.{kind}")));
        // What says that there is something goes last: a kill in between leaves what the next start
        // removes.
        for path in [part, data] {
            warn(&path, fs::rename(&path, &gone));
        }
        warn(&json, fs::remove_file(&json));
        Self(gone)
    }
}

impl Drop for Gone {
    fn drop(&mut self) {
        warn(&self.0, fs::remove_file(&self.0));
    }
}

/// Says what could not be taken away; what is not there was.
fn warn(path: &Path, removed: io::Result<()>) {
    if let Err(error) = removed
        && error.kind() != io::ErrorKind::NotFound
    {
        tracing::warn!("cannot remove {}: {error}", path.display());
    }
}
