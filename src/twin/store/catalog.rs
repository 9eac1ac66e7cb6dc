//! The twins in a directory or an object store, and their versions.

use std::path::Path;
use std::sync::Arc;

use serde::Deserialize;

use crate::limits;
use wildcity_scene::manifest::{ChunkEntry, Provenance, Section};
use wildcity_scene::rig::is_name;
use wildcity_scene::{Chunk, Manifest, PagePool, sh};

use super::backend::ObjectBackend;
use super::clock::{Clock, SystemClock};
use super::disk::Disk;
use super::layout::is_hash;
use super::local::{Local, RealDisk};
use super::log::{LogEntry, LogRecord};
use super::object_access::{DiskCacheSettings, Traffic};
use super::remote::Remote;
#[cfg(feature = "object-store")]
use super::remote::RetryPolicy;
use super::{StoreError, chunk_file};

/// Twins in a directory or an object store.
#[derive(Clone, Debug)]
pub struct Catalog {
    pub(super) objects: Arc<dyn ObjectBackend>,
    pub(super) clock: Arc<dyn Clock>,
    #[cfg(feature = "object-store")]
    remote: Option<Remote>,
    /// Memory of sections that were evicted, for those that are read next.
    pages: Arc<PagePool>,
}

/// A twin and its latest version.
#[derive(Clone, Debug, PartialEq)]
pub struct TwinListing {
    pub name: String,
    /// Number of its latest version, from 1.
    pub number: u64,
    /// Hash of that version's manifest, 64 lower-case hex digits.
    pub hash: String,
}

/// The twins of a catalog.
#[derive(Debug, Default)]
pub struct TwinList {
    /// Twins whose newest log record can be read, sorted by name.
    pub twins: Vec<TwinListing>,
    /// The other twins, sorted by name. Their damage does not affect the readable ones.
    pub damaged: Vec<DamagedTwin>,
}

/// A twin whose newest log record cannot be read.
#[derive(Debug)]
pub struct DamagedTwin {
    pub name: String,
    pub error: StoreError,
}

/// One immutable version of a twin.
#[derive(Clone, Debug, PartialEq)]
pub struct Version {
    /// Its number in the twin's log, from 1.
    pub number: u64,
    /// Its identity: the manifest's BLAKE3, 64 lower-case hex digits.
    pub hash: String,
    /// When it was committed, in microseconds since 1970.
    pub created_us: i64,
    pub manifest: Manifest,
}

impl Catalog {
    /// Opens a directory of twins, which need not exist yet, and removes the remains of killed
    /// commits; or opens the twins at a URL (`s3://bucket/folder`, `gs://`, `az://`,
    /// `file:///folder`), with credentials from the environment.
    ///
    /// # Errors
    /// The directory cannot be listed; [`StoreError::Url`]. Remains that cannot be removed are no
    /// error here, so that one twin does not keep the others from being opened: the next commit of
    /// that twin reports it.
    pub fn open(dir: &Path) -> Result<Self, StoreError> {
        Self::open_cached(dir, None)
    }

    /// As [`Catalog::open`], and caches parts of remote twins on the local disk. Local twins need
    /// no cache.
    ///
    /// # Errors
    /// As [`Catalog::open`]; the cache's directory cannot be created.
    pub fn open_cached(
        place: &Path,
        cache: Option<&DiskCacheSettings>,
    ) -> Result<Self, StoreError> {
        let url = place.to_str().filter(|place| place.contains("://"));
        let dir = url.and_then(|url| url.strip_prefix("file://"));
        let catalog = match (url, dir) {
            // A directory, with a directory's locks and without a disk cache.
            (_, Some(dir)) => Self::local(Path::new(dir)),
            (Some(url), None) => Self::remote(Remote::at(url, cache)?),
            (None, None) => Self::local(place),
        };
        catalog.remove_abandoned_commits(None)?;
        Ok(catalog)
    }

    /// Opens the twins within an object store that is open already. All keys begin with `prefix`;
    /// messages name the store by `url`.
    ///
    /// # Errors
    /// The prefix is invalid, or the cache's directory cannot be created.
    #[cfg(feature = "object-store")]
    pub fn over(
        store: Arc<dyn object_store::ObjectStore>,
        url: &str,
        prefix: &str,
        cache: Option<&DiskCacheSettings>,
        retry: RetryPolicy,
    ) -> Result<Self, StoreError> {
        Remote::over(store, url, prefix, cache, retry).map(Self::remote)
    }

    /// These twins with another clock.
    pub fn with_clock(self, clock: Arc<dyn Clock>) -> Self {
        Self { clock, ..self }
    }

    /// Opens a directory of twins on a disk, with a clock: the parts of a machine, or of a
    /// simulated one. As [`Catalog::open`], removes the remains of killed commits.
    ///
    /// # Errors
    /// As [`Catalog::open`].
    pub fn on(dir: &Path, disk: Arc<dyn Disk>, clock: Arc<dyn Clock>) -> Result<Self, StoreError> {
        let objects = Arc::new(Local::new(dir, disk));
        let catalog = Self::from_local(objects, clock);
        catalog.remove_abandoned_commits(None)?;
        Ok(catalog)
    }

    fn local(dir: &Path) -> Self {
        let objects = Arc::new(Local::new(dir, Arc::new(RealDisk)));
        Self::from_local(objects, Arc::new(SystemClock))
    }

    fn from_local(objects: Arc<Local>, clock: Arc<dyn Clock>) -> Self {
        Self {
            objects,
            clock,
            #[cfg(feature = "object-store")]
            remote: None,
            pages: page_pool(),
        }
    }

    #[cfg(not(feature = "object-store"))]
    fn remote(remote: Remote) -> Self {
        // Without the feature the type has no values, so that this is never called.
        match remote {}
    }

    #[cfg(feature = "object-store")]
    fn remote(remote: Remote) -> Self {
        let objects = Arc::new(remote.clone());
        Self { objects, clock: Arc::new(SystemClock), remote: Some(remote), pages: page_pool() }
    }

    /// These twins, read without the disk cache.
    pub(super) fn uncached(&self) -> Self {
        #[cfg(feature = "object-store")]
        if let Some(remote) = &self.remote {
            return Self::remote(remote.uncached());
        }
        // A directory has no cache.
        self.clone()
    }

    /// Counts of requests to the object store since it was opened; `None` for a directory.
    pub fn traffic(&self) -> Option<Traffic> {
        #[cfg(feature = "object-store")]
        if let Some(remote) = &self.remote {
            return Some(remote.traffic());
        }
        None
    }

    /// The directory, or the URL.
    pub fn dir(&self) -> &Path {
        self.objects.root()
    }

    /// All twins with their latest versions, and the damaged ones.
    ///
    /// # Errors
    /// The directory or the object store cannot be listed.
    pub fn twins(&self) -> Result<TwinList, StoreError> {
        let mut list = TwinList::default();
        for name in self.objects.twin_names()? {
            match self.listing(&name) {
                Ok(Some(listing)) => list.twins.push(listing),
                // Its only version was removed meanwhile.
                Ok(None) => {}
                Err(error) => list.damaged.push(DamagedTwin { name, error }),
            }
        }
        Ok(list)
    }

    fn listing(&self, name: &str) -> Result<Option<TwinListing>, StoreError> {
        let numbers = self.objects.version_numbers(name)?;
        // Only the newest record is read: damage of older ones does not hide the twin.
        let Some(&number) = numbers.last() else { return Ok(None) };
        let hash = self.record(name, number)?.manifest;
        Ok(Some(TwinListing { name: name.to_owned(), number, hash }))
    }

    /// Number of a twin's latest version, only from the names of the log's records. The records
    /// are not read, so a damaged one causes no error.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; the log cannot be listed.
    pub fn latest(&self, name: &str) -> Result<u64, StoreError> {
        let numbers = self.numbers(name)?;
        // `numbers` returns at least one.
        Ok(numbers[numbers.len() - 1])
    }

    /// Reads one version of a twin, or the latest, and compares it with its hash.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`], [`StoreError::NoVersion`] or
    /// [`StoreError::GarbageCollected`] if there is no such version;
    /// [`StoreError::Damaged`] or [`StoreError::Format`] if it cannot be used.
    pub fn version(&self, name: &str, number: Option<u64>) -> Result<Version, StoreError> {
        let numbers = self.numbers(name)?;
        let latest = numbers[numbers.len() - 1];
        let number = number.unwrap_or(latest);
        if !numbers.contains(&number) {
            return Err(StoreError::NoVersion { name: name.to_owned(), number, latest });
        }
        // Asked before the manifest is read, which may be gone: that would seem to be damage.
        self.check_not_collected(name, number)?;
        let LogRecord { manifest: hash, created_us, .. } = self.record(name, number)?;
        let mut manifest = self.manifest(name, &hash)?;
        self.fill(&mut manifest)?;
        Ok(Version { number, hash, created_us, manifest })
    }

    /// All versions of a twin in order of their numbers, only from the log.
    ///
    /// # Errors
    /// [`StoreError::Name`] or [`StoreError::NoTwin`]; [`StoreError::Damaged`] for a record that
    /// cannot be parsed.
    pub fn versions(&self, name: &str) -> Result<Vec<LogEntry>, StoreError> {
        let entry = |number| {
            let LogRecord { manifest: hash, created_us, commit, parent, kind } =
                self.record(name, number)?;
            Ok(LogEntry { number, hash, created_us, commit, parent, kind })
        };
        self.numbers(name)?.into_iter().map(entry).collect()
    }

    /// The source of a version of the log, only from its manifest.
    ///
    /// # Errors
    /// As [`Catalog::version`].
    pub fn provenance(&self, name: &str, entry: &LogEntry) -> Result<Provenance, StoreError> {
        self.check_not_collected(name, entry.number)?;
        Ok(self.manifest(name, &entry.hash)?.provenance)
    }

    /// Reads one section of a chunk, compares it with its hash, and decodes it. Nothing else of the
    /// chunk is read.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it differs from what was committed.
    pub fn section(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
        section: &Section,
    ) -> Result<Chunk, StoreError> {
        let Manifest { sh_degree, record, .. } = version.manifest;
        let pool = Some(self.pages.clone());
        self.read_section(version, chunk, section, |bytes| {
            chunk_file::unpack(bytes, chunk, section, sh_degree, record, pool)
        })
    }

    /// As [`Catalog::section`], part by part: `visit` sees chunks of at most 65,536 Gaussians, in
    /// order. Their memory is used again and again.
    ///
    /// # Errors
    /// As [`Catalog::section`]. Parts before a damaged one have been shown by then.
    pub fn visit_parts(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
        section: &Section,
        visit: &mut dyn FnMut(&Chunk),
    ) -> Result<(), StoreError> {
        let Manifest { sh_degree, record, .. } = version.manifest;
        self.read_section(version, chunk, section, |bytes| {
            chunk_file::unpack_parts(bytes, chunk, section, sh_degree, record, &self.pages, visit)
        })
    }

    /// Bytes of memory that sections have returned and the next ones take.
    pub fn free_page_bytes(&self) -> u64 {
        self.pages.free_bytes() as u64
    }

    /// Reads the bytes of a section, and decodes them.
    fn read_section<T>(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
        section: &Section,
        decode: impl FnOnce(&[u8]) -> Result<T, String>,
    ) -> Result<T, StoreError> {
        let twin = &version.manifest.twin;
        // A damaged manifest may have any offset. A sum that saturates lies beyond the end of the
        // object, which `read_range` refuses.
        let end = section.offset_bytes.saturating_add(section.bytes.into());
        let of_section = |path, reason| {
            let Section { block, level, .. } = section;
            StoreError::Damaged { path, reason: format!("block {block}, level {level}: {reason}") }
        };
        let bytes = self
            .objects
            .read_range(twin, &chunk.object, section.offset_bytes..end, &section.hash)
            .map_err(|error| match error {
                StoreError::Damaged { path, reason } => of_section(path, reason),
                error => error,
            })?;
        decode(&bytes)
            .map_err(|reason| of_section(self.objects.object_path(twin, &chunk.object), reason))
    }

    /// Reads a chunk's object to its end without checking or keeping it, to measure the speed of
    /// reading. Returns its size in bytes.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn read_and_discard(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
    ) -> Result<u64, StoreError> {
        self.objects.read_and_discard(&version.manifest.twin, &chunk.object)
    }

    /// Checks that a chunk's object, and the table of contents in it, are what was committed. Reads
    /// all of it.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if not.
    pub(super) fn check_chunk(&self, name: &str, chunk: &ChunkEntry) -> Result<(), StoreError> {
        // The table of contents and the page before it.
        let most = limits::CHUNK_TABLE_BYTES + chunk_file::PAGE_BYTES;
        // The hash is compared first, because its error is clearer than one that follows from a
        // damaged table of contents.
        let start = self.objects.read_start(name, &chunk.object, most)?;
        let path = self.objects.object_path(name, &chunk.object);
        chunk_file::check_start(&start, chunk)
            .map_err(|reason| StoreError::Damaged { path, reason })
    }

    /// Numbers of a twin's versions, ascending; at least one.
    pub(super) fn numbers(&self, name: &str) -> Result<Vec<u64>, StoreError> {
        check_name(name)?;
        let numbers = self.objects.version_numbers(name)?;
        if numbers.is_empty() {
            return Err(StoreError::NoTwin {
                name: name.to_owned(),
                dir: self.dir().to_owned(),
                known: self.objects.twin_names()?,
            });
        }
        Ok(numbers)
    }

    pub(super) fn record(&self, name: &str, number: u64) -> Result<LogRecord, StoreError> {
        let bytes = self.objects.read_record(name, number)?;
        let damaged = |reason| {
            let path = self.objects.record_path(name, number);
            StoreError::Damaged { path, reason }
        };
        let record: LogRecord =
            serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
        if !is_hash(&record.manifest) {
            return Err(damaged(format!("{:?} is not a hash", record.manifest)));
        }
        Ok(record)
    }

    /// JSON with the fields in the order of the type, so that the same content gives the same
    /// bytes.
    pub(super) fn encode(&self, content: &impl serde::Serialize) -> Result<Vec<u8>, StoreError> {
        serde_json::to_vec(content).map_err(|e| StoreError::io("encode for", self.dir())(e.into()))
    }

    /// Reads the sections of a manifest's chunks from its table.
    pub(super) fn fill(&self, manifest: &mut Manifest) -> Result<(), StoreError> {
        let twin = &manifest.twin;
        let table = &manifest.table.object;
        let path = self.objects.object_path(twin, table);
        let table = self.objects.read_object(twin, table, limits::TABLE_BYTES)?;
        let Manifest { chunks, sh_degree, record, .. } = manifest;
        chunk_file::fill(chunks, *sh_degree, *record, &table)
            .map_err(|reason| StoreError::Damaged { path, reason })
    }

    /// Reads a manifest without the sections of its chunks.
    pub(super) fn manifest(&self, name: &str, hash: &str) -> Result<Manifest, StoreError> {
        let path = self.objects.object_path(name, hash);
        let bytes = self.objects.read_object(name, hash, limits::MANIFEST_BYTES)?;
        let damaged = |reason: String| StoreError::Damaged { path: path.clone(), reason };
        // The format is read first: the other fields of a later format are unknown.
        let Format { format } =
            serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
        if format != Manifest::FORMAT {
            return Err(StoreError::Format { path, found: format, supported: Manifest::FORMAT });
        }
        let manifest: Manifest =
            serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
        // The bytes have the right hash, but a folder may have been copied under another name.
        if manifest.twin != name {
            return Err(damaged(format!("it belongs to twin {:?}", manifest.twin)));
        }
        if manifest.sh_degree > sh::MAX_DEGREE {
            return Err(damaged(format!("SH degree is {}, not 0 to 3", manifest.sh_degree)));
        }
        if let Some(alignment) = manifest.twin_from_capture {
            alignment.check().map_err(|error| damaged(format!("its alignment: {error}")))?;
        }
        // All hashes of a manifest become paths. They are checked here once, so that none leads out
        // of the twin.
        let objects = manifest.chunks.iter().map(|chunk| &chunk.object);
        let sky = manifest.sky.iter().map(|sky| &sky.object);
        let views = manifest.views.iter().map(|views| &views.object);
        let named = objects.chain(sky).chain(views).chain([&manifest.table.object]);
        if let Some(object) = { named }.find(|name| !is_hash(name)) {
            return Err(damaged(format!("{object:?} is not a hash")));
        }
        Ok(manifest)
    }
}

#[derive(Deserialize)]
struct Format {
    format: u32,
}

/// Checks that a name can be a twin's, and part of a path.
///
/// # Errors
/// [`StoreError::Name`]
pub fn check_name(name: &str) -> Result<(), StoreError> {
    if is_name(name) { Ok(()) } else { Err(StoreError::Name { name: name.to_owned() }) }
}

fn page_pool() -> Arc<PagePool> {
    Arc::new(PagePool::new(limits::FREE_PAGES_BYTES))
}
