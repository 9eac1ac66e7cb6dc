//! The twins of a directory and their versions.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;

use crate::limits;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_scene::rig::is_name;
use wildcity_scene::{Chunk, Manifest, sh};

use super::local::Local;
use super::local::disk_cache::DiskCache;
use super::log::LogRecord;
use super::objects::{ObjectBackend, is_hash};
use super::remote::{Remote, RetryPolicy, Traffic};
use super::{StoreError, chunk_file, recover};

/// Twins in a directory or an object store.
#[derive(Clone, Debug)]
pub struct Catalog {
    pub(super) objects: Arc<dyn ObjectBackend>,
    remote: Option<Remote>,
}

/// Where parts of remote twins are kept on disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiskCacheSettings {
    /// The directory, made if need be; processes may share it.
    pub dir: PathBuf,
    /// How much it may hold, in bytes.
    pub limit_bytes: u64,
}

/// One line of a listing: a twin and its latest version.
#[derive(Clone, Debug, PartialEq)]
pub struct TwinListing {
    /// The twin's name.
    pub name: String,
    /// Number of its latest version, from 1.
    pub number: u64,
    /// Hash of that version's manifest, 64 lower-case hex digits.
    pub hash: String,
}

/// One immutable version of a twin.
#[derive(Clone, Debug, PartialEq)]
pub struct Version {
    /// Its place in the twin's log, from 1.
    pub number: u64,
    /// Its identity: the manifest's BLAKE3, 64 lower-case hex digits.
    pub hash: String,
    /// When it was committed, in microseconds since 1970.
    pub created_us: i64,
    /// What it consists of.
    pub manifest: Manifest,
}

impl Catalog {
    /// Opens a directory of twins, which need not exist yet, and cleans up after killed commits; or
    /// the twins at a URL (`s3://bucket/folder`, `gs://`, `az://`, `file:///folder`), with
    /// credentials from the environment.
    ///
    /// # Errors
    /// The directory cannot be listed, or the rest of a killed commit cannot be removed;
    /// [`StoreError::Url`].
    pub fn open(dir: &Path) -> Result<Self, StoreError> {
        Self::open_cached(dir, None)
    }

    /// As [`Catalog::open`], and keeps parts of remote twins on disk; local ones need none of that.
    ///
    /// # Errors
    /// As [`Catalog::open`]; the cache's directory cannot be made.
    pub fn open_cached(
        place: &Path,
        cache: Option<&DiskCacheSettings>,
    ) -> Result<Self, StoreError> {
        let url = place.to_str().filter(|place| place.contains("://"));
        let catalog = match (url, url.and_then(|url| url.strip_prefix("file://"))) {
            (_, Some(dir)) => Self { objects: Arc::new(Local::new(Path::new(dir))), remote: None },
            (Some(url), None) => Self::remote(Remote::at(url, open_cache(cache)?)?),
            (None, None) => Self { objects: Arc::new(Local::new(place)), remote: None },
        };
        recover::clean(&catalog)?;
        Ok(catalog)
    }

    /// Twins within an object store that is open already, all keys beginning with `prefix`; `url` is
    /// what messages call it.
    ///
    /// # Errors
    /// The prefix is none, or the cache's directory cannot be made.
    pub fn over(
        store: Arc<dyn object_store::ObjectStore>,
        url: &str,
        prefix: &str,
        cache: Option<&DiskCacheSettings>,
        retry: RetryPolicy,
    ) -> Result<Self, StoreError> {
        Remote::over(store, url, prefix, open_cache(cache)?, retry).map(Self::remote)
    }

    fn remote(remote: Remote) -> Self {
        Self { objects: Arc::new(remote.clone()), remote: Some(remote) }
    }

    /// The same twins, read from where they are and not from the disk cache.
    pub(super) fn uncached(&self) -> Self {
        self.remote.as_ref().map_or_else(|| self.clone(), |remote| Self::remote(remote.uncached()))
    }

    /// What was asked of the object store since it was opened; none for a directory.
    pub fn traffic(&self) -> Option<Traffic> {
        self.remote.as_ref().map(Remote::traffic)
    }

    /// The directory, or the URL.
    pub fn dir(&self) -> &Path {
        self.objects.root()
    }

    /// All twins with their latest versions, in order of name.
    ///
    /// # Errors
    /// A log cannot be read.
    pub fn twins(&self) -> Result<Vec<TwinListing>, StoreError> {
        let mut twins = Vec::new();
        for name in self.objects.names()? {
            if let Some(&number) = self.objects.numbers(&name)?.last() {
                let hash = self.record(&name, number)?.manifest;
                twins.push(TwinListing { name, number, hash });
            }
        }
        Ok(twins)
    }

    /// Number of a twin's latest version, from the names of the log's records alone: none of them is
    /// read, and one that is damaged is in nobody's way.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; the log cannot be listed.
    pub fn latest(&self, name: &str) -> Result<u64, StoreError> {
        let numbers = self.numbers(name)?;
        Ok(numbers[numbers.len() - 1])
    }

    /// Reads one version of a twin, or the latest, and checks it against its hash.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`], [`StoreError::NoVersion`] or
    /// [`StoreError::GarbageCollected`] for what was asked;
    /// [`StoreError::Damaged`] or [`StoreError::Format`] for what was found.
    pub fn version(&self, name: &str, number: Option<u64>) -> Result<Version, StoreError> {
        let numbers = self.numbers(name)?;
        let latest = numbers[numbers.len() - 1];
        let number = number.unwrap_or(latest);
        if !numbers.contains(&number) {
            return Err(StoreError::NoVersion { name: name.to_owned(), number, latest });
        }
        self.check_not_collected(name, number)?;
        let LogRecord { manifest: hash, created_us, .. } = self.record(name, number)?;
        let mut manifest = self.manifest(name, &hash)?;
        self.fill(&mut manifest)?;
        Ok(Version { number, hash, created_us, manifest })
    }

    /// Reads one section of a chunk, activated, and checks it against its hash; nothing else of the
    /// chunk is read.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it is not what was committed.
    pub fn section(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
        section: &Section,
    ) -> Result<Chunk, StoreError> {
        let Manifest { twin, sh_degree, record, .. } = &version.manifest;
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
        chunk_file::unpack(&bytes, chunk, section, *sh_degree, *record)
            .map_err(|reason| of_section(self.objects.path(twin, &chunk.object), reason))
    }

    /// Reads a chunk's object to its end, looks at none of it, and keeps nothing: how fast bytes come.
    /// Returns how many there are.
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

    /// Whether a chunk's object and what it says of itself are what was committed. Reads all of it.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if not.
    pub(super) fn check_chunk(&self, name: &str, chunk: &ChunkEntry) -> Result<(), StoreError> {
        let most = limits::CHUNK_TABLE_BYTES + chunk_file::PAGE_BYTES;
        // The hash says more than what its first wrong byte led to, and is compared first.
        let start = self.objects.read_start(name, &chunk.object, most)?;
        let path = self.objects.path(name, &chunk.object);
        chunk_file::check_start(&start, chunk)
            .map_err(|reason| StoreError::Damaged { path, reason })
    }

    /// Numbers of a twin's versions, rising; at least one.
    pub(super) fn numbers(&self, name: &str) -> Result<Vec<u64>, StoreError> {
        check_name(name)?;
        let numbers = self.objects.numbers(name)?;
        if numbers.is_empty() {
            let (dir, known) = (self.dir().to_owned(), self.objects.names()?);
            return Err(StoreError::NoTwin { name: name.to_owned(), dir, known });
        }
        Ok(numbers)
    }

    pub(super) fn record(&self, name: &str, number: u64) -> Result<LogRecord, StoreError> {
        let bytes = self.objects.record(name, number)?;
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

    /// JSON with the fields in the order of the type: the same content, the same bytes.
    pub(super) fn encode(&self, content: &impl serde::Serialize) -> Result<Vec<u8>, StoreError> {
        serde_json::to_vec(content).map_err(|e| StoreError::io("encode for", self.dir())(e.into()))
    }

    /// Reads the sections of a manifest's chunks from its table.
    pub(super) fn fill(&self, manifest: &mut Manifest) -> Result<(), StoreError> {
        let (twin, table) = (&manifest.twin, &manifest.table.object);
        let path = self.objects.path(twin, table);
        let table = self.objects.read_object(twin, table, limits::TABLE_BYTES)?;
        let Manifest { chunks, sh_degree, record, .. } = manifest;
        chunk_file::fill(chunks, *sh_degree, *record, &table)
            .map_err(|reason| StoreError::Damaged { path, reason })
    }

    /// Reads a manifest without the sections of its chunks.
    pub(super) fn manifest(&self, name: &str, hash: &str) -> Result<Manifest, StoreError> {
        let path = self.objects.path(name, hash);
        let bytes = self.objects.read_object(name, hash, limits::MANIFEST_BYTES)?;
        let damaged = |reason: String| StoreError::Damaged { path: path.clone(), reason };
        // The format first: of a later one, nothing else is known.
        let Format { format } =
            serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
        if format != Manifest::FORMAT {
            return Err(StoreError::Format { path, found: format, supported: Manifest::FORMAT });
        }
        let manifest: Manifest =
            serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
        if manifest.twin != name {
            return Err(damaged(format!("it belongs to twin {:?}", manifest.twin)));
        }
        if manifest.sh_degree > sh::MAX_DEGREE {
            return Err(damaged(format!("SH degree is {}, not 0 to 3", manifest.sh_degree)));
        }
        let objects = manifest.chunks.iter().map(|chunk| &chunk.object);
        let sky = manifest.sky.iter().map(|sky| &sky.object);
        let named = objects.chain(sky).chain([&manifest.table.object]);
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

/// Whether a name can be a twin's, and part of a path.
pub(super) fn check_name(name: &str) -> Result<(), StoreError> {
    if is_name(name) { Ok(()) } else { Err(StoreError::Name { name: name.to_owned() }) }
}

fn open_cache(cache: Option<&DiskCacheSettings>) -> Result<Option<DiskCache>, StoreError> {
    cache
        .map(|DiskCacheSettings { dir, limit_bytes }| DiskCache::open(dir, *limit_bytes))
        .transpose()
}
