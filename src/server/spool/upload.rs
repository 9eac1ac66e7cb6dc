//! One upload on disk.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime};

use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::sync::{Mutex as AsyncMutex, Notify, OwnedMutexGuard};
use tokio::time::timeout;

use crate::fault::{Fault, is_full};
use crate::limits;

use super::digest::Digest;

/// Value of [`Upload::held`] for an upload after its digest was checked.
const COMPLETE: u64 = u64::MAX;

/// One upload. It is not removed while an `Arc` of it is held outside the spool.
#[derive(Debug)]
pub(crate) struct Upload {
    id: String,
    stem: String,
    /// Name of the token that announced it; empty on a server without tokens.
    owner: String,
    announced: Announced,
    dir: PathBuf,
    /// Bytes on disk; [`COMPLETE`] once they are checked.
    held: AtomicU64,
    /// When the last byte arrived, or the upload was last announced.
    used: Mutex<SystemTime>,
    /// When the last byte arrived, or the upload was begun or found.
    active: Mutex<Instant>,
    writing: Arc<AsyncMutex<()>>,
    /// Asks the connection that writes to release the upload to another one.
    release: Notify,
}

/// What a client announces of a file before it sends it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Announced {
    pub(crate) name: String,
    pub(crate) size: u64,
    pub(crate) digest: Digest,
}

/// The JSON file of an upload.
#[derive(Serialize, Deserialize)]
struct AnnouncedBy {
    #[serde(flatten)]
    announced: Announced,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    owner: String,
}

/// The name of the files of an upload, without their endings.
pub(super) fn stem(owner: &str, id: &str) -> String {
    if owner.is_empty() {
        return id.to_owned();
    }
    let owner = blake3::hash(owner.as_bytes()).to_hex();
    format!("{id}-{}", &owner[..16])
}

impl Upload {
    /// A new upload of a token in a directory, without its files.
    pub(super) fn new(dir: &Path, owner: &str, announced: Announced) -> Self {
        Self::with(dir, owner.to_owned(), announced, 0, SystemTime::now())
    }

    /// The upload of these files that an earlier server left in the directory, if they are valid.
    pub(super) fn found(dir: &Path, stem: &str) -> Option<Self> {
        let path = |kind: &str| dir.join(format!("{stem}.{kind}"));
        let metadata = |kind: &str| fs::metadata(path(kind)).ok();
        let text = fs::read(path("json")).ok()?;
        let AnnouncedBy { announced, owner } = serde_json::from_slice(&text).ok()?;
        if self::stem(&owner, &announced.digest.id()) != stem {
            return None;
        }
        let size = announced.size;
        let data = metadata("data").filter(|data| data.len() == size);
        let part = metadata("part").filter(|part| part.len() <= size);
        let (held, file) = match (data, part) {
            (Some(data), _) => (COMPLETE, data),
            (None, Some(part)) => (part.len(), part),
            (None, None) => return None,
        };
        let used = file.modified().unwrap_or_else(|_| SystemTime::now());
        Some(Self::with(dir, owner, announced, held, used))
    }

    fn with(dir: &Path, owner: String, announced: Announced, held: u64, used: SystemTime) -> Self {
        let id = announced.digest.id();
        Self {
            stem: stem(&owner, &id),
            id,
            owner,
            announced,
            dir: dir.to_owned(),
            held: held.into(),
            used: Mutex::new(used),
            active: Mutex::new(Instant::now()),
            writing: Arc::default(),
            release: Notify::new(),
        }
    }

    pub(crate) fn id(&self) -> &str {
        &self.id
    }

    /// The name of its files, without their endings.
    pub(super) fn stem(&self) -> &str {
        &self.stem
    }

    /// Name of the token that announced it.
    pub(super) fn owner(&self) -> &str {
        &self.owner
    }

    pub(crate) fn announced(&self) -> &Announced {
        &self.announced
    }

    /// Bytes that have arrived.
    pub(crate) fn offset(&self) -> u64 {
        self.held.load(Ordering::Acquire).min(self.announced.size)
    }

    /// Whether all bytes have arrived and match the digest.
    pub(crate) fn is_complete(&self) -> bool {
        self.held.load(Ordering::Acquire) == COMPLETE
    }

    /// Path of a complete upload.
    pub(crate) fn path(&self) -> PathBuf {
        self.file("data")
    }

    /// Completes when another connection wants to write.
    pub(crate) fn released(&self) -> tokio::sync::futures::Notified<'_> {
        self.release.notified()
    }

    /// Takes the upload over from the connection that writes it, if there is one: after a network failure
    /// the client knows long before the server that the old connection is dead.
    ///
    /// # Errors
    /// [`Fault::Busy`]: the other connection did not release it in time.
    pub(crate) async fn write(self: &Arc<Self>) -> Result<Writer, Fault> {
        self.release.notify_waiters();
        let lock = timeout(limits::UPLOAD_SILENCE, self.writing.clone().lock_owned()).await;
        let lock = lock.map_err(|_| Fault::Busy { what: "connections that write it", limit: 1 })?;
        Ok(Writer { upload: self.clone(), _lock: lock, file: None })
    }

    /// Makes the files of a new upload.
    pub(super) fn create(&self) -> Result<(), Fault> {
        let create = || {
            let announced = self.announced.clone();
            let announced = AnnouncedBy { announced, owner: self.owner.clone() };
            fs::write(self.file("json"), serde_json::to_vec(&announced)?)?;
            File::create(self.file("part"))
        };
        create().map_err(|cause| io_fault("write to", cause))?;
        if self.announced.size == 0 { self.finish() } else { Ok(()) }
    }

    /// Checks the bytes that arrived against the digest. The caller removes an upload that does not match.
    fn finish(&self) -> Result<(), Fault> {
        let part = self.file("part");
        let found = self.announced.digest.of_same_kind(&part);
        let found = found.map_err(|cause| io_fault("read", cause))?;
        if found != self.announced.digest {
            return Err(Fault::UploadDigest {
                what: "the digest of what arrived",
                promised: String::from(self.announced.digest.clone()),
                found: found.into(),
            });
        }
        fs::rename(part, self.file("data")).map_err(|cause| io_fault("write to", cause))?;
        self.held.store(COMPLETE, Ordering::Release);
        Ok(())
    }

    /// Renames the files, so that a new upload can have the same id at once. They are deleted when the
    /// result is dropped.
    pub(super) fn set_aside(&self) -> RemovedFiles {
        RemovedFiles::of(&self.dir, &self.stem)
    }

    /// Notes that the upload is used now.
    pub(super) fn touch(&self) {
        *self.used.lock() = SystemTime::now();
    }

    /// Time since the last byte arrived, or the upload was begun or found.
    pub(super) fn idle(&self) -> Duration {
        self.active.lock().elapsed()
    }

    /// When the upload was last used.
    pub(super) fn used(&self) -> SystemTime {
        *self.used.lock()
    }

    fn file(&self, kind: &str) -> PathBuf {
        self.dir.join(format!("{}.{kind}", self.stem))
    }
}

/// Exclusive write access to an upload. The methods block.
pub(crate) struct Writer {
    upload: Arc<Upload>,
    _lock: OwnedMutexGuard<()>,
    file: Option<File>,
}

impl Writer {
    /// Appends bytes: all of them, or none if the disk fails.
    pub(crate) fn append(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        let start = self.upload.offset();
        let written = self.file().and_then(|file| {
            file.set_len(start)?;
            file.write_all(bytes)
        });
        match written {
            Ok(()) => {
                self.upload.held.store(start + bytes.len() as u64, Ordering::Release);
                self.upload.touch();
                *self.upload.active.lock() = Instant::now();
                Ok(())
            }
            Err(cause) => {
                // The first error is the one to report; an error of this clean-up would only hide it.
                let _ = self.file().and_then(|file| file.set_len(start));
                Err(io_fault("write to", cause))
            }
        }
    }

    /// Discards all bytes from an offset on.
    pub(crate) fn truncate(&mut self, offset: u64) -> Result<(), Fault> {
        let truncated = self.file().and_then(|file| file.set_len(offset));
        truncated.map_err(|cause| io_fault("write to", cause))?;
        self.upload.held.store(offset, Ordering::Release);
        Ok(())
    }

    /// After the last byte: syncs the file, and checks it against the digest.
    pub(crate) fn finish(mut self) -> Result<(), Fault> {
        let synced = self.file().and_then(|file| file.sync_all());
        synced.map_err(|cause| io_fault("write to", cause))?;
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

fn io_fault(action: &'static str, cause: io::Error) -> Fault {
    if is_full(&cause) {
        return Fault::StorageFull { reason: format!("{cause}") };
    }
    Fault::Spool { action, cause }
}

/// The file of an upload that was removed. It is deleted when this is dropped, which takes a while for
/// tens of GB: not under a lock.
#[must_use]
pub(super) struct RemovedFiles(PathBuf);

impl RemovedFiles {
    pub(super) fn of(dir: &Path, stem: &str) -> Self {
        let path = |kind: &str| dir.join(format!("{stem}.{kind}"));
        let gone = path("gone");
        // The announcement is removed last: if the process is killed before, the next start removes the rest.
        for kind in ["part", "data"] {
            log_error(&path(kind), fs::rename(path(kind), &gone));
        }
        log_error(&path("json"), fs::remove_file(path("json")));
        Self(gone)
    }
}

impl Drop for RemovedFiles {
    fn drop(&mut self) {
        log_error(&self.0, fs::remove_file(&self.0));
    }
}

/// Logs that a file could not be removed, unless it did not exist.
fn log_error(path: &Path, removed: io::Result<()>) {
    if let Err(error) = removed
        && error.kind() != io::ErrorKind::NotFound
    {
        tracing::warn!("cannot remove {}: {error}", path.display());
    }
}
