//! Uploads on disk, until they are pushed or too old.
//!
//! ```text
//! <spool>/lock             locked by the server that uses the directory
//! <spool>/<id>.json        what was announced
//! <spool>/<id>.part        what has arrived
//! <spool>/<id>.data        a complete upload, which matches its digest
//! <spool>/<id>.gone        a removed upload: freeing a large file takes a while
//! ```
//!
//! **The id is the digest**: the same content is the same upload. So an upload needs no state but its
//! bytes: announcing it again finds it, whatever happened to the server or the client. An incomplete upload
//! survives a restart, and can be continued.

mod digest;
mod upload;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;

use crate::config::SpoolLimits;
use crate::fault::Fault;

pub(crate) use upload::{Announced, Upload, Writer};

use digest::Digest;
use upload::RemovedFiles;

/// The uploads of a server.
pub(crate) struct Spool {
    dir: PathBuf,
    limits: SpoolLimits,
    uploads: Mutex<BTreeMap<String, Arc<Upload>>>,
    _lock: File,
}

/// How much of a spool is used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SpoolUsage {
    /// Number of uploads.
    pub(crate) uploads: usize,
    /// Their bytes, as announced.
    pub(crate) bytes: u64,
}

impl Spool {
    /// Opens a directory for one server, with the uploads that an earlier server left there.
    pub(crate) fn open(dir: &Path, limits: SpoolLimits) -> io::Result<Self> {
        fs::create_dir_all(dir)?;
        let lock = OpenOptions::new().create(true).append(true).open(dir.join("lock"))?;
        lock.try_lock().map_err(|error| match error {
            fs::TryLockError::Error(error) => error,
            fs::TryLockError::WouldBlock => {
                io::Error::other("another server uses it: give one of them another --uploads DIR")
            }
        })?;
        let spool = Self { dir: dir.to_owned(), limits, uploads: Mutex::default(), _lock: lock };
        spool.recover()?;
        Ok(spool)
    }

    /// The upload of a file, which is begun if it is new. Old uploads are removed to make room for it.
    ///
    /// # Errors
    /// The upload is too large, there is no room, the disk fails, or the digest was announced with another
    /// size before.
    pub(crate) fn begin(&self, announced: Announced) -> Result<Arc<Upload>, Fault> {
        if announced.size > self.limits.upload_bytes {
            let must =
                format!("{}; at most {} are accepted", announced.size, self.limits.upload_bytes);
            return Err(Fault::OutOfRange { field: "size".to_owned(), must });
        }
        let id = announced.digest.id();
        // Declared before the lock, so that files are deleted after the lock is released.
        let mut removed = Vec::new();
        let mut uploads = self.uploads.lock();
        if let Some(upload) = uploads.get(&id) {
            let known = upload.announced().size;
            if known != announced.size {
                return Err(Fault::UploadDigest {
                    what: "the size of that content",
                    promised: format!("{} bytes", announced.size),
                    found: format!("{known} bytes"),
                });
            }
            upload.touch();
            return Ok(upload.clone());
        }
        self.make_room(&mut uploads, announced.size, &mut removed)?;
        let upload = Arc::new(Upload::new(&self.dir, announced));
        // No file is left of an upload that is refused.
        upload.create().inspect_err(|_| removed.push(upload.set_aside()))?;
        uploads.insert(id, upload.clone());
        Ok(upload)
    }

    /// An upload that was begun.
    ///
    /// # Errors
    /// [`Fault::UnknownUpload`].
    pub(crate) fn get(&self, id: &str) -> Result<Arc<Upload>, Fault> {
        let unknown = || Fault::UnknownUpload { id: id.to_owned(), field: None };
        self.uploads.lock().get(id).cloned().ok_or_else(unknown)
    }

    /// Removes an upload.
    pub(crate) fn remove(&self, upload: &Upload) {
        let mut uploads = self.uploads.lock();
        uploads.remove(upload.id());
        // Under the lock: an upload of the same id may begin right after.
        let removed = upload.set_aside();
        drop(uploads);
        drop(removed);
    }

    /// Removes uploads that are too old and not in use.
    pub(crate) fn remove_old(&self) {
        let is_old = |upload: &Arc<Upload>| {
            let age = upload.used().elapsed().unwrap_or_default();
            age >= self.limits.age && Arc::strong_count(upload) == 1
        };
        // Declared before the lock, so that files are deleted after the lock is released.
        let mut removed = Vec::new();
        self.uploads.lock().retain(|_, upload| {
            let keep = !is_old(upload);
            if !keep {
                removed.push(upload.set_aside());
            }
            keep
        });
    }

    /// How long an upload is kept.
    pub(crate) fn age(&self) -> Duration {
        self.limits.age
    }

    /// How much of the spool is used.
    pub(crate) fn usage(&self) -> SpoolUsage {
        let uploads = self.uploads.lock();
        let bytes = uploads.values().map(|upload| upload.announced().size).sum();
        SpoolUsage { uploads: uploads.len(), bytes }
    }

    /// Removes complete uploads that are not in use, the oldest first, until one of `size` bytes fits.
    fn make_room(
        &self,
        uploads: &mut BTreeMap<String, Arc<Upload>>,
        size: u64,
        removed: &mut Vec<RemovedFiles>,
    ) -> Result<(), Fault> {
        loop {
            let bytes: u64 = uploads.values().map(|upload| upload.announced().size).sum();
            let fits = bytes.checked_add(size).is_some_and(|sum| sum <= self.limits.bytes);
            if fits && uploads.len() < self.limits.uploads {
                return Ok(());
            }
            let is_unused =
                |upload: &&Arc<Upload>| upload.is_complete() && Arc::strong_count(upload) == 1;
            let oldest = uploads.values().filter(is_unused).min_by_key(|upload| upload.used());
            let Some(id) = oldest.map(|upload| upload.id().to_owned()) else {
                let reason = format!(
                    "{} uploads of {bytes} bytes are kept, of at most {} uploads and {} bytes; push \
                     what is uploaded, or wait",
                    uploads.len(),
                    self.limits.uploads,
                    self.limits.bytes
                );
                return Err(Fault::StorageFull { reason });
            };
            if let Some(upload) = uploads.remove(&id) {
                removed.push(upload.set_aside());
            }
        }
    }

    /// Reads the directory. Files of uploads that cannot be continued are removed; files of other names
    /// are left alone.
    fn recover(&self) -> io::Result<()> {
        let mut names = Vec::new();
        for entry in fs::read_dir(&self.dir)? {
            names.extend(entry?.file_name().into_string());
        }
        let upload_id = |name: &String| {
            let (id, kind) = name.split_once('.')?;
            let is_known = ["json", "part", "data", "gone"].contains(&kind);
            (is_known && Digest::of_id(id).is_some()).then(|| id.to_owned())
        };
        let ids: BTreeSet<String> = names.iter().filter_map(upload_id).collect();
        let mut uploads = self.uploads.lock();
        for id in ids {
            match Upload::found(&self.dir, &id) {
                Some(upload) => {
                    uploads.insert(id, Arc::new(upload));
                }
                None => drop(RemovedFiles::of(&self.dir, &id)),
            }
        }
        Ok(())
    }
}
