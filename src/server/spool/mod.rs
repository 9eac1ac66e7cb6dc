//! Uploads on disk, until they are pushed or too old.
//!
//! ```text
//! <spool>/lock               locked by the server that uses the directory
//! <spool>/<stem>.json        what was announced, and by which token
//! <spool>/<stem>.part        what has arrived
//! <spool>/<stem>.data        a complete upload, which matches its digest
//! <spool>/<stem>.gone        a removed upload: freeing a large file takes a while
//! ```
//!
//! **The id is the digest**: the same content is the same upload. So an upload needs no state but its
//! bytes: announcing it again finds it, whatever happened to the server or the client. An incomplete upload
//! survives a restart, and can be continued.
//!
//! **An upload belongs to the token that announced it.** Another token cannot see, continue, remove or push it, and has
//! an upload of its own for the same content. The stem of its files is the id, followed by a hash of the token's name.
//!
//! **Room is for bytes that came.** An announcement alone takes little room, and for minutes only ([`quota`]).

mod digest;
mod quota;
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
use quota::Quota;
use upload::RemovedFiles;

/// The uploads of a server.
pub(crate) struct Spool {
    dir: PathBuf,
    limits: SpoolLimits,
    quota: Quota,
    /// By the stem of their files.
    uploads: Mutex<Uploads>,
    _lock: File,
}

type Uploads = BTreeMap<String, Arc<Upload>>;

/// How much of a spool is used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SpoolUsage {
    /// Number of uploads.
    pub(crate) uploads: usize,
    /// Their bytes that have arrived, and those that are reserved for more.
    pub(crate) bytes: u64,
}

impl Spool {
    /// Opens a directory for one server, with the uploads that an earlier server left there. `tokens` is the number
    /// of tokens that may upload, and `own_bytes` the bytes of those with a limit of their own, by name.
    pub(crate) fn open(
        dir: &Path,
        limits: SpoolLimits,
        tokens: usize,
        own_bytes: BTreeMap<String, u64>,
    ) -> io::Result<Self> {
        fs::create_dir_all(dir)?;
        let lock = OpenOptions::new().create(true).append(true).open(dir.join("lock"))?;
        lock.try_lock().map_err(|error| match error {
            fs::TryLockError::Error(error) => error,
            fs::TryLockError::WouldBlock => {
                io::Error::other("another server uses it: give one of them another --uploads DIR")
            }
        })?;
        let spool = Self {
            dir: dir.to_owned(),
            limits,
            quota: Quota::new(limits, tokens, own_bytes),
            uploads: Mutex::default(),
            _lock: lock,
        };
        spool.recover()?;
        Ok(spool)
    }

    /// The upload of a file by a token, which is begun if it is new. Old uploads are removed to make room for it.
    ///
    /// # Errors
    /// The upload is too large, there is no room, the disk fails, or the token has all of that content, of another
    /// size.
    pub(crate) fn begin(&self, owner: &str, announced: Announced) -> Result<Arc<Upload>, Fault> {
        if announced.size > self.limits.upload_bytes {
            let must =
                format!("{}; at most {} are accepted", announced.size, self.limits.upload_bytes);
            return Err(Fault::OutOfRange { field: "size".to_owned(), must });
        }
        let upload = Arc::new(Upload::new(&self.dir, owner, announced));
        let stem = upload.stem().to_owned();
        // Declared before the lock, so that files are deleted after the lock is released.
        let mut removed = Vec::new();
        let mut uploads = self.uploads.lock();
        if let Some(known) = uploads.get(&stem) {
            let size = upload.announced().size;
            let known_size = known.announced().size;
            if known_size == size {
                known.touch();
                return Ok(known.clone());
            }
            // The size of complete content is certain. Of incomplete content, either size may be the wrong one.
            if known.is_complete() || Arc::strong_count(known) > 1 {
                return Err(Fault::UploadDigest {
                    what: "the size of that content",
                    promised: format!("{size} bytes"),
                    found: format!("{known_size} bytes"),
                });
            }
            removed.push(known.set_aside());
            uploads.remove(&stem);
        }
        self.quota.make_room_for_new(&mut uploads, &upload, &mut removed)?;
        // No file is left of an upload that is refused.
        upload.create().inspect_err(|_| removed.push(upload.set_aside()))?;
        uploads.insert(stem, upload.clone());
        Ok(upload)
    }

    /// Makes room for more bytes of an upload, which are about to be written.
    ///
    /// # Errors
    /// [`Fault::StorageFull`]; what has arrived is kept.
    pub(crate) fn make_room(&self, upload: &Upload, more_bytes: u64) -> Result<(), Fault> {
        // Declared before the lock, so that files are deleted after the lock is released.
        let mut removed = Vec::new();
        let mut uploads = self.uploads.lock();
        self.quota.make_room_for_more(&mut uploads, upload, more_bytes, &mut removed)
    }

    /// An upload that a token began.
    ///
    /// # Errors
    /// [`Fault::UnknownUpload`].
    pub(crate) fn get(&self, owner: &str, id: &str) -> Result<Arc<Upload>, Fault> {
        let unknown = || Fault::UnknownUpload { id: id.to_owned(), field: None };
        self.uploads.lock().get(&upload::stem(owner, id)).cloned().ok_or_else(unknown)
    }

    /// Removes an upload.
    pub(crate) fn remove(&self, upload: &Upload) {
        let mut uploads = self.uploads.lock();
        uploads.remove(upload.stem());
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
        quota::usage(uploads.values())
    }

    /// Reads the directory. Files of uploads that cannot be continued are removed; files of other names
    /// are left alone.
    fn recover(&self) -> io::Result<()> {
        let mut names = Vec::new();
        for entry in fs::read_dir(&self.dir)? {
            names.extend(entry?.file_name().into_string());
        }
        let upload_stem = |name: &String| {
            let (stem, kind) = name.split_once('.')?;
            let is_known = ["json", "part", "data", "gone"].contains(&kind);
            let is_id = |id: &str| Digest::of_id(id).is_some();
            let is_stem = is_id(stem) || stem.rsplit_once('-').is_some_and(|(id, _)| is_id(id));
            (is_known && is_stem).then(|| stem.to_owned())
        };
        let stems: BTreeSet<String> = names.iter().filter_map(upload_stem).collect();
        let mut uploads = self.uploads.lock();
        for stem in stems {
            match Upload::found(&self.dir, &stem) {
                Some(upload) => {
                    uploads.insert(stem, Arc::new(upload));
                }
                None => drop(RemovedFiles::of(&self.dir, &stem)),
            }
        }
        Ok(())
    }
}
