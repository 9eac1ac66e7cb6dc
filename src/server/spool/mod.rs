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
//! **The id is the digest**: the same content is the same upload. So an upload needs no state
//! except its bytes: announcing it again finds it, whatever happened to the server or the client.
//! An incomplete upload survives a restart, and can be continued. A complete upload also survives a
//! power cut; an incomplete one may lose its last bytes.
//!
//! **An upload belongs to the token that announced it.** Another token cannot see, continue, remove
//! or push it, and has an upload of its own for the same content. The stem of its files is the id,
//! followed by a hash of the token's name.
//!
//! **Space is counted for bytes that have arrived.** An announcement without bytes takes little
//! space, and only for minutes ([`quota`]).

mod digest;
mod quota;
mod upload;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;

use wildcity_twin::store::clock::{Clock, SystemClock};
use wildcity_twin::store::disk::{Disk, Lock, Wait};
use wildcity_twin::store::{RealDisk, create_dirs};

use crate::config::SpoolLimits;
use crate::fault::Fault;

pub(crate) use upload::{Announced, Upload, Writer};

use digest::Digest;
use quota::Quota;
use upload::{RemovedFiles, remove_file};

/// The uploads of a server.
pub(crate) struct Spool {
    medium: SpoolMedium,
    limits: SpoolLimits,
    quota: Quota,
    /// By the stem of their files.
    uploads: Mutex<Uploads>,
    _lock: Lock,
}

/// Where uploads are kept, and the time.
#[derive(Clone, Debug)]
pub(crate) struct SpoolMedium {
    pub(crate) dir: PathBuf,
    pub(crate) disk: Arc<dyn Disk>,
    pub(crate) clock: Arc<dyn Clock>,
}

type Uploads = BTreeMap<String, Arc<Upload>>;

/// How much of a spool is used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SpoolUsage {
    pub(crate) uploads: usize,
    /// Their bytes that have arrived, and those that are reserved for more.
    pub(crate) bytes: u64,
}

impl SpoolMedium {
    /// A directory of this machine.
    pub(crate) fn directory(dir: &Path) -> Self {
        Self { dir: dir.to_owned(), disk: Arc::new(RealDisk), clock: Arc::new(SystemClock) }
    }
}

impl Spool {
    /// Opens a directory for one server, with the uploads of an earlier server. `tokens` is the
    /// number of tokens that may upload, and `own_bytes` the limits of tokens that have their own
    /// limit, by name.
    pub(crate) fn open(
        medium: SpoolMedium,
        limits: SpoolLimits,
        tokens: usize,
        own_bytes: BTreeMap<String, u64>,
    ) -> io::Result<Self> {
        create_dirs(&*medium.disk, &medium.dir).map_err(io::Error::other)?;
        let lock = medium.disk.lock(&medium.dir.join("lock"), Wait::No)?.ok_or_else(|| {
            io::Error::other("another server uses it: give one of them another --uploads DIR")
        })?;
        let spool = Self {
            medium,
            limits,
            quota: Quota::new(limits, tokens, own_bytes),
            uploads: Mutex::default(),
            _lock: lock,
        };
        spool.recover()?;
        Ok(spool)
    }

    /// Returns the upload of a file by a token, and begins it if it is new. Old uploads are removed
    /// to make space for it. An upload of an earlier server that could not be read when this server
    /// started is continued.
    ///
    /// # Errors
    /// The upload is too large, there is no space, the disk fails, or the token has a complete
    /// upload of the same digest with a different size.
    pub(crate) fn begin(&self, owner: &str, announced: Announced) -> Result<Arc<Upload>, Fault> {
        // What can be refused without a lock is refused first.
        if announced.size > self.limits.upload_bytes {
            let must =
                format!("{}; at most {} are accepted", announced.size, self.limits.upload_bytes);
            return Err(Fault::OutOfRange { field: "size".to_owned(), must });
        }
        let upload = Arc::new(Upload::new(&self.medium, owner, announced));
        let stem = upload.stem().to_owned();
        // Declared before the lock, so that files are deleted after the lock is released.
        let mut removed = Vec::new();
        let mut uploads = self.uploads.lock();
        // The disk may have an upload that could not be read when the server started.
        if !uploads.contains_key(&stem) {
            let found = self.find(&stem).map_err(|cause| Fault::SpoolRead { cause })?;
            uploads.extend(found.map(|found| (stem.clone(), found)));
        }
        if let Some(known) = uploads.get(&stem) {
            let size = upload.announced().size;
            let known_size = known.announced().size;
            // The same content: the client goes on from the bytes that are there.
            if known_size == size {
                known.touch();
                return Ok(known.clone());
            }
            // The size of complete content is certain. For incomplete content, either of the two
            // sizes may be wrong.
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
        // Inserted last: what is in the map has its files.
        uploads.insert(stem, upload.clone());
        Ok(upload)
    }

    /// Makes space for more bytes of an upload, before they are written.
    ///
    /// # Errors
    /// [`Fault::StorageFull`]; the bytes that have arrived are kept.
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

    /// Takes an upload over, as [`Upload::write`].
    ///
    /// # Errors
    /// [`Fault::Busy`]; [`Fault::UnknownUpload`] if it was removed meanwhile.
    pub(crate) async fn write(&self, upload: &Arc<Upload>) -> Result<Writer, Fault> {
        // The check comes after the wait, in which the upload may have been removed.
        let writer = upload.write().await?;
        // The files of its stem may be those of a newer upload.
        if !is_own(&self.uploads.lock(), upload) {
            return Err(Fault::UnknownUpload { id: upload.id().to_owned(), field: None });
        }
        Ok(writer)
    }

    /// Removes an upload, unless it was removed before. The caller has its [`Writer`], so that no
    /// other connection writes to files of a newer upload.
    pub(crate) fn remove(&self, upload: &Upload) {
        let mut uploads = self.uploads.lock();
        if !is_own(&uploads, upload) {
            return;
        }
        uploads.remove(upload.stem());
        // Under the lock, because an upload of the same id may begin right after.
        let removed = upload.set_aside();
        drop(uploads);
        drop(removed);
    }

    /// Removes uploads that are too old and not in use.
    pub(crate) fn remove_old(&self) {
        let now_us = self.medium.clock.now_us();
        let is_old = |upload: &Arc<Upload>| {
            // A clock that was set back gives a negative age, which counts as 0: nothing is removed
            // for it.
            let age_us = u64::try_from(now_us - upload.used_us()).unwrap_or_default();
            Duration::from_micros(age_us) >= self.limits.age && Arc::strong_count(upload) == 1
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

    /// Reads the directory. Files of uploads that cannot be continued are removed; files of other
    /// names, and files that cannot be read now, are not changed.
    fn recover(&self) -> io::Result<()> {
        let names = self.medium.disk.list(&self.medium.dir)?;
        let upload_stem = |name: &String| {
            let (stem, kind) = name.split_once('.')?;
            let is_known = ["json", "part", "data", "gone"].contains(&kind);
            let is_id = |id: &str| Digest::from_id(id).is_some();
            // With and without a token's name. An operator's own files in the directory match
            // neither.
            let is_stem = is_id(stem) || stem.rsplit_once('-').is_some_and(|(id, _)| is_id(id));
            (is_known && is_stem).then(|| stem.to_owned())
        };
        // An upload has up to three files, and is looked at once.
        let stems: BTreeSet<String> = names.iter().filter_map(upload_stem).collect();
        let mut uploads = self.uploads.lock();
        for stem in stems {
            match self.find(&stem) {
                Ok(Some(upload)) => {
                    uploads.insert(stem, upload);
                }
                Ok(None) => drop(RemovedFiles::rename_all(&self.medium, &stem)),
                Err(error) => tracing::warn!("cannot read the upload {stem}: {error}"),
            }
        }
        // An earlier process may have ended after it renamed a complete upload, and before this.
        self.medium.disk.sync_dir(&self.medium.dir)
    }

    /// The upload of these files that an earlier server left, if they are valid.
    fn find(&self, stem: &str) -> io::Result<Option<Arc<Upload>>> {
        let Some(upload) = Upload::found(&self.medium, stem)? else { return Ok(None) };
        // The process may have ended before it deleted these files.
        remove_file(&self.medium, stem, "gone");
        if upload.is_complete() {
            remove_file(&self.medium, stem, "part");
        }
        Ok(Some(Arc::new(upload)))
    }
}

/// Whether an upload is still in the spool: a newer upload may have the stem of a removed one.
fn is_own(uploads: &Uploads, upload: &Upload) -> bool {
    // By address, because both have the same stem and often the same announcement.
    uploads.get(upload.stem()).is_some_and(|known| std::ptr::eq(&**known, upload))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(dir: &Path) -> Spool {
        let medium = SpoolMedium::directory(dir);
        Spool::open(medium, SpoolLimits::default(), 1, BTreeMap::new()).unwrap()
    }

    /// An upload of 7 bytes.
    fn announced() -> Announced {
        let digest = format!("blake3:{}", blake3::hash(b"content").to_hex());
        Announced { name: "a".to_owned(), size: 7, digest: digest.try_into().unwrap() }
    }

    /// A server may be killed after it renamed the files of an upload, when the same content was
    /// announced again.
    #[test]
    fn what_a_killed_server_was_deleting_is_deleted_at_the_next_start() {
        let dir = tempfile::tempdir().unwrap();
        let stem = open(dir.path()).begin("", announced()).unwrap().stem().to_owned();
        let gone = dir.path().join(format!("{stem}.gone"));
        std::fs::write(&gone, b"cont").unwrap();
        let spool = open(dir.path());
        assert!(!gone.exists());
        assert_eq!(spool.usage().uploads, 1);
    }

    #[test]
    fn an_announcement_keeps_the_bytes_of_an_upload_that_could_not_be_read_at_the_start() {
        let dir = tempfile::tempdir().unwrap();
        let stem = open(dir.path()).begin("", announced()).unwrap().stem().to_owned();
        let file = |kind: &str| dir.path().join(format!("{stem}.{kind}"));
        std::fs::write(file("part"), b"cont").unwrap();
        let announcement = std::fs::read_to_string(file("json")).unwrap();
        // Longer than an announcement can be.
        // Padded with spaces to 20,000 bytes, and 16 KiB are read at most.
        std::fs::write(file("json"), format!("{announcement:20000}")).unwrap();
        let spool = open(dir.path());
        assert_eq!(spool.usage().uploads, 0);
        let refused = spool.begin("", announced());
        assert!(matches!(refused, Err(Fault::SpoolRead { .. })), "{refused:?}");
        std::fs::write(file("json"), &announcement).unwrap();
        assert_eq!(spool.begin("", announced()).unwrap().offset(), 4);
        assert_eq!(std::fs::read(file("part")).unwrap(), b"cont");
    }

    #[tokio::test]
    async fn nothing_is_appended_to_a_file_that_has_lost_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let spool = open(dir.path());
        let upload = spool.begin("", announced()).unwrap();
        let part = dir.path().join(format!("{}.part", upload.stem()));
        let mut writer = spool.write(&upload).await.unwrap();
        writer.append(b"cont").unwrap();
        std::fs::write(&part, b"co").unwrap();
        let refused = writer.append(b"ent");
        assert!(matches!(refused, Err(Fault::SpoolWrite { .. })), "{refused:?}");
        assert_eq!(std::fs::read(&part).unwrap(), b"co");
    }

    #[tokio::test]
    async fn a_request_for_a_removed_upload_leaves_the_newer_one_of_its_stem_alone() {
        let dir = tempfile::tempdir().unwrap();
        let spool = open(dir.path());
        let old = spool.begin("", announced()).unwrap();
        spool.remove(&old);
        let new = spool.begin("", announced()).unwrap();
        spool.remove(&old);
        assert_eq!(spool.usage().uploads, 1);
        let refused = spool.write(&old).await.map(drop);
        assert!(matches!(refused, Err(Fault::UnknownUpload { .. })), "{refused:?}");
        assert!(spool.write(&new).await.is_ok());
    }
}
