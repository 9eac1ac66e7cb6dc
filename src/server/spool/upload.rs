//! One upload on disk.

use std::io::{self, ErrorKind, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tokio::sync::{Mutex as AsyncMutex, Notify, OwnedMutexGuard};
use tokio::time::timeout;

use wildcity_twin::store::disk::{FileInfo, WriteFile};

use crate::fault::{Fault, is_full};
use crate::limits;

use super::SpoolMedium;
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
    medium: SpoolMedium,
    /// Bytes on disk; [`COMPLETE`] once they are checked.
    held: AtomicU64,
    /// When the last byte arrived, or the upload was last announced, in microseconds since 1970.
    used_us: AtomicI64,
    /// When the last byte arrived, or the upload was begun or found, by the clock that never jumps.
    active_us: AtomicI64,
    writing: Arc<AsyncMutex<()>>,
    /// Notifies the connection that writes to release the upload to another one.
    release: Notify,
}

/// The announcement of a file that a client is going to send.
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
    // A name of a token may have any characters, and a file name may not. 64 bits do not collide
    // for some thousand tokens.
    let owner = blake3::hash(owner.as_bytes()).to_hex();
    format!("{id}-{}", &owner[..16])
}

impl Upload {
    /// A new upload of a token in a directory, without its files.
    pub(super) fn new(medium: &SpoolMedium, owner: &str, announced: Announced) -> Self {
        Self::with(medium, owner.to_owned(), announced, 0, medium.clock.now_us())
    }

    /// The upload of these files that an earlier server left in the directory, if they are valid.
    ///
    /// # Errors
    /// They cannot be read now.
    pub(super) fn found(medium: &SpoolMedium, stem: &str) -> io::Result<Option<Self>> {
        let file = |kind: &str| found_file(medium.disk.info(&path(medium, stem, kind)));
        // Looked at before the announcement: files without one are removed, which an error of the
        // disk must prevent.
        let data = file("data")?;
        let part = file("part")?;
        let Some(AnnouncedBy { announced, owner }) = announcement(medium, stem)? else {
            return Ok(None);
        };
        // Files that were copied or renamed by hand are not those of this upload.
        if self::stem(&owner, &announced.digest.id()) != stem {
            return Ok(None);
        }
        let size = announced.size;
        let data = data.filter(|data| data.bytes == size);
        // A longer file cannot be continued.
        let part = part.filter(|part| part.bytes <= size);
        let (held, file) = match (data, part) {
            (Some(data), _) => (COMPLETE, data),
            (None, Some(part)) => (part.bytes, part),
            (None, None) => return Ok(None),
        };
        Ok(Some(Self::with(medium, owner, announced, held, file.modified_us)))
    }

    fn with(
        medium: &SpoolMedium,
        owner: String,
        announced: Announced,
        held: u64,
        used_us: i64,
    ) -> Self {
        let id = announced.digest.id();
        Self {
            stem: stem(&owner, &id),
            id,
            owner,
            announced,
            medium: medium.clone(),
            held: held.into(),
            used_us: used_us.into(),
            active_us: medium.clock.monotonic_us().into(),
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

    /// Completes when another connection is going to write.
    pub(crate) fn released(&self) -> tokio::sync::futures::Notified<'_> {
        self.release.notified()
    }

    /// Takes the upload over from the connection that writes it, if there is one: after a network
    /// failure the client detects long before the server that the old connection is dead.
    ///
    /// # Errors
    /// [`Fault::Busy`]: the other connection did not release it in time.
    pub(crate) async fn write(self: &Arc<Self>) -> Result<Writer, Fault> {
        self.release.notify_waiters();
        // The other connection ends when it sees the signal, or at the latest when it was silent
        // for as long.
        let lock = timeout(limits::UPLOAD_SILENCE, self.writing.clone().lock_owned())
            .await
            .map_err(|_| Fault::Busy { what: "connections that write it", limit: 1 })?;
        Ok(Writer { upload: self.clone(), _lock: lock, file: None })
    }

    /// Makes the files of a new upload.
    pub(super) fn create(&self) -> Result<(), Fault> {
        let create = || {
            let announced = self.announced.clone();
            let by = AnnouncedBy { announced, owner: self.owner.clone() };
            let mut file = self.medium.disk.create(&self.file("json"))?;
            file.write_all(&serde_json::to_vec(&by)?)?;
            self.medium.disk.create(&self.file("part"))
        };
        create().map_err(write_fault)?;
        // No request with bytes will come, so it is complete at once.
        if self.announced.size == 0 { self.finish() } else { Ok(()) }
    }

    /// Checks the bytes that arrived against the digest, and makes the upload durable. The bytes
    /// are durable already.
    ///
    /// # Errors
    /// [`Fault::SpoolRead`]: the disk cannot be read now, and the upload is kept. After any other
    /// error the caller removes the upload.
    fn finish(&self) -> Result<(), Fault> {
        let disk = &*self.medium.disk;
        let part = self.file("part");
        let Announced { size, digest, .. } = &self.announced;
        let read = || {
            let found = disk.open(&part).and_then(|file| digest.hash_same_kind(file, *size));
            found.map_err(|cause| Fault::SpoolRead { cause })
        };
        // The upload is lost if its bytes are wrong, but not if they were only read wrong.
        if read()? != *digest {
            let found = read()?;
            if found != *digest {
                return Err(Fault::UploadDigest {
                    what: "the digest of what arrived",
                    promised: String::from(digest.clone()),
                    found: found.into(),
                });
            }
        }
        // The order makes it durable: the bytes are synced, then the announcement, and then the
        // name that says that both are good.
        disk.append(&self.file("json"))
            .and_then(|mut announcement| announcement.sync())
            .and_then(|()| disk.rename(&part, &self.file("data")))
            .and_then(|()| disk.sync_dir(&self.medium.dir))
            .map_err(write_fault)?;
        // Release and Acquire: what reads COMPLETE finds the file under its new name.
        self.held.store(COMPLETE, Ordering::Release);
        Ok(())
    }

    /// Renames the files, so that a new upload can have the same id at once. They are deleted when
    /// the result is dropped.
    pub(super) fn set_aside(&self) -> RemovedFiles {
        RemovedFiles::rename_all(&self.medium, &self.stem)
    }

    /// Notes that the upload is used now.
    pub(super) fn touch(&self) {
        self.used_us.store(self.medium.clock.now_us(), Ordering::Relaxed);
    }

    /// Time since the last byte arrived, or the upload was begun or found.
    pub(super) fn idle(&self) -> Duration {
        let active_us = self.active_us.load(Ordering::Relaxed);
        let idle_us = self.medium.clock.monotonic_us() - active_us;
        Duration::from_micros(u64::try_from(idle_us).unwrap_or_default())
    }

    /// When the upload was last used, in microseconds since 1970.
    pub(super) fn used_us(&self) -> i64 {
        self.used_us.load(Ordering::Relaxed)
    }

    fn file(&self, kind: &str) -> PathBuf {
        path(&self.medium, &self.stem, kind)
    }
}

/// Exclusive write access to an upload. The methods block.
pub(crate) struct Writer {
    upload: Arc<Upload>,
    _lock: OwnedMutexGuard<()>,
    file: Option<Box<dyn WriteFile>>,
}

impl Writer {
    /// Appends bytes: all of them, or none if the disk fails.
    pub(crate) fn append(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        // The writer has the lock, so that no other thread changes the offset.
        let start = self.upload.offset();
        let written = self.file().and_then(|file| {
            // Bytes of a failed write may be behind the offset. A file that is shorter than the
            // offset is an error here.
            file.truncate(start)?;
            file.write_all(bytes)
        });
        match written {
            Ok(()) => {
                self.upload.held.store(start + bytes.len() as u64, Ordering::Release);
                self.upload.touch();
                let now_us = self.upload.medium.clock.monotonic_us();
                self.upload.active_us.store(now_us, Ordering::Relaxed);
                Ok(())
            }
            Err(cause) => {
                // Report the first error, and not an error of this clean-up.
                let _ = self.file().and_then(|file| file.truncate(start));
                Err(write_fault(cause))
            }
        }
    }

    /// Discards all bytes from an offset on.
    pub(crate) fn truncate(&mut self, offset: u64) -> Result<(), Fault> {
        let truncated = self.file().and_then(|file| file.truncate(offset));
        truncated.map_err(write_fault)?;
        self.upload.held.store(offset, Ordering::Release);
        Ok(())
    }

    /// After the last byte: syncs the file, and checks it against the digest.
    pub(crate) fn finish(&mut self) -> Result<(), Fault> {
        let synced = self.file().and_then(|file| file.sync());
        synced.map_err(write_fault)?;
        self.upload.finish()
    }

    fn file(&mut self) -> io::Result<&mut dyn WriteFile> {
        let file = match self.file.take() {
            Some(file) => file,
            None => self.upload.medium.disk.append(&self.upload.file("part"))?,
        };
        Ok(&mut **self.file.insert(file))
    }
}

fn write_fault(cause: io::Error) -> Fault {
    if is_full(&cause) {
        return Fault::StorageFull { reason: format!("{cause}") };
    }
    Fault::SpoolWrite { cause }
}

/// The file of an upload that was removed. It is deleted when this is dropped, which takes a while
/// for tens of GB: not under a lock.
#[must_use]
pub(super) struct RemovedFiles {
    medium: SpoolMedium,
    stem: String,
}

impl RemovedFiles {
    pub(super) fn rename_all(medium: &SpoolMedium, stem: &str) -> Self {
        let path = |kind: &str| path(medium, stem, kind);
        let gone = path("gone");
        // The announcement is removed last: if the process is killed before, the next start removes
        // the rest.
        // One of the two exists, as a rule. If both do, the second rename replaces the first.
        for kind in ["part", "data"] {
            log_error(&path(kind), medium.disk.rename(&path(kind), &gone));
        }
        remove_file(medium, stem, "json");
        Self { medium: medium.clone(), stem: stem.to_owned() }
    }
}

impl Drop for RemovedFiles {
    fn drop(&mut self) {
        remove_file(&self.medium, &self.stem, "gone");
    }
}

/// Path of one of an upload's files.
fn path(medium: &SpoolMedium, stem: &str, kind: &str) -> PathBuf {
    medium.dir.join(format!("{stem}.{kind}"))
}

/// Removes one of an upload's files, if it exists.
pub(super) fn remove_file(medium: &SpoolMedium, stem: &str, kind: &str) {
    let path = path(medium, stem, kind);
    log_error(&path, medium.disk.remove_file(&path));
}

/// Logs that a file could not be removed, unless it did not exist.
fn log_error(path: &Path, removed: io::Result<()>) {
    if let Err(error) = removed
        && error.kind() != ErrorKind::NotFound
    {
        tracing::warn!("cannot remove {}: {error}", path.display());
    }
}

/// Reads an upload's announcement; `None` if there is none, or an incomplete one.
fn announcement(medium: &SpoolMedium, stem: &str) -> io::Result<Option<AnnouncedBy>> {
    let mut text = Vec::new();
    match medium.disk.open(&path(medium, stem, "json")) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        file => {
            let file = file?;
            let size = file.size_bytes()?;
            if size > limits::ANNOUNCEMENT_BYTES {
                let most = limits::ANNOUNCEMENT_BYTES;
                let reason = format!("{stem}.json has {size} bytes, not at most {most}: remove it");
                return Err(io::Error::new(ErrorKind::InvalidData, reason));
            }
            // Bounded by the size that was checked, also if the file grows meanwhile.
            file.take(size).read_to_end(&mut text)?;
            if (text.len() as u64) < size {
                return Err(ErrorKind::UnexpectedEof.into());
            }
        }
    }
    // Killed while it was written, it is no JSON: as good as none.
    Ok(serde_json::from_slice(&text).ok())
}

/// A file, if it exists.
fn found_file(found: io::Result<FileInfo>) -> io::Result<Option<FileInfo>> {
    match found {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        found => found.map(|found| Some(found).filter(|found| found.is_file)),
    }
}
