//! The twins of a directory and their versions.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::config;
use crate::scene::manifest::ChunkEntry;
use crate::scene::rig::is_name;
use crate::scene::{Chunk, Manifest};

use super::chunk_file::{self, ReadError};
use super::objects::{ObjectReader, Objects};
use super::{StoreError, recover};

/// A directory of twins.
#[derive(Clone, Debug)]
pub struct Catalog {
    pub(super) objects: Objects,
}

/// One line of a listing: a twin and its latest version.
#[derive(Clone, Debug, PartialEq)]
pub struct Listing {
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

/// A record of the log, as JSON.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Record {
    pub(super) manifest: String,
    pub(super) created_us: i64,
}

impl Catalog {
    /// Opens a directory of twins, which need not exist yet, and cleans up after killed imports.
    ///
    /// # Errors
    /// The directory cannot be listed, or the rest of a killed import cannot be removed.
    pub fn open(dir: &Path) -> Result<Self, StoreError> {
        let catalog = Self { objects: Objects::new(dir) };
        recover::clean(&catalog)?;
        Ok(catalog)
    }

    /// The directory.
    pub fn dir(&self) -> &Path {
        self.objects.root()
    }

    /// All twins with their latest versions, in order of name.
    ///
    /// # Errors
    /// A log cannot be read.
    pub fn twins(&self) -> Result<Vec<Listing>, StoreError> {
        let mut twins = Vec::new();
        for name in self.objects.names()? {
            if let Some(&number) = self.objects.numbers(&name)?.last() {
                let hash = self.record(&name, number)?.manifest;
                twins.push(Listing { name, number, hash });
            }
        }
        Ok(twins)
    }

    /// Reads one version of a twin, or the latest, and checks it against its hash.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`] or [`StoreError::NoVersion`] for what was asked;
    /// [`StoreError::Damaged`] or [`StoreError::Format`] for what was found.
    pub fn version(&self, name: &str, number: Option<u64>) -> Result<Version, StoreError> {
        let numbers = self.numbers(name)?;
        let latest = numbers[numbers.len() - 1];
        let number = number.unwrap_or(latest);
        if !numbers.contains(&number) {
            return Err(StoreError::NoVersion { name: name.to_owned(), number, latest });
        }
        let Record { manifest: hash, created_us } = self.record(name, number)?;
        let manifest = self.manifest(name, &hash)?;
        Ok(Version { number, hash, created_us, manifest })
    }

    /// Reads one chunk of a version, activated, and checks it against its hash.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it is not what was committed.
    pub fn chunk(&self, version: &Version, entry: &ChunkEntry) -> Result<Chunk, StoreError> {
        let Manifest { twin, sh_degree, .. } = &version.manifest;
        let mut reader = self.objects.open(twin, &entry.object)?;
        let path = reader.path().to_owned();
        let total_bytes = reader.size_bytes();
        let chunk = chunk_file::read(&mut reader, total_bytes).map_err(|error| match error {
            ReadError::Io(source) => StoreError::io("read", &path)(source),
            ReadError::Format(found) => {
                StoreError::Format { path: path.clone(), found, supported: chunk_file::FORMAT }
            }
            ReadError::Damaged(reason) => StoreError::Damaged { path: path.clone(), reason },
        });
        // The hash says more than what its first wrong byte led to.
        reader.finish()?;
        let chunk = chunk?;
        let found = (chunk.cell(), chunk.sh_degree(), chunk.len() as u64);
        if found != (entry.cell, *sh_degree, entry.count) {
            let reason = "the manifest says another cell, degree or count".to_owned();
            return Err(StoreError::Damaged { path, reason });
        }
        Ok(chunk)
    }

    /// Numbers of a twin's versions, rising; at least one.
    pub(super) fn numbers(&self, name: &str) -> Result<Vec<u64>, StoreError> {
        if !is_name(name) {
            return Err(StoreError::Name { name: name.to_owned() });
        }
        let numbers = self.objects.numbers(name)?;
        if numbers.is_empty() {
            let (dir, known) = (self.dir().to_owned(), self.objects.names()?);
            return Err(StoreError::NoTwin { name: name.to_owned(), dir, known });
        }
        Ok(numbers)
    }

    pub(super) fn record(&self, name: &str, number: u64) -> Result<Record, StoreError> {
        let bytes = self.objects.record(name, number)?;
        let damaged = |reason| {
            let path = self.objects.record_path(name, number);
            StoreError::Damaged { path, reason }
        };
        let record: Record = serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
        if !is_hash(&record.manifest) {
            return Err(damaged(format!("{:?} is not a hash", record.manifest)));
        }
        Ok(record)
    }

    pub(super) fn manifest(&self, name: &str, hash: &str) -> Result<Manifest, StoreError> {
        let reader = self.objects.open(name, hash)?;
        let path = reader.path().to_owned();
        let bytes = read_whole(reader)?;
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
        match manifest.chunks.iter().find(|chunk| !is_hash(&chunk.object)) {
            Some(chunk) => Err(damaged(format!("{:?} is not a hash", chunk.object))),
            None => Ok(manifest),
        }
    }
}

#[derive(Deserialize)]
struct Format {
    format: u32,
}

fn read_whole(mut reader: ObjectReader) -> Result<Vec<u8>, StoreError> {
    use std::io::Read as _;
    let (path, bytes) = (reader.path().to_owned(), reader.size_bytes());
    if bytes > config::MANIFEST_BYTES {
        let reason = format!("a manifest of {bytes} bytes is above {}", config::MANIFEST_BYTES);
        return Err(StoreError::Damaged { path, reason });
    }
    let mut whole = Vec::with_capacity(bytes as usize);
    (&mut reader)
        .take(config::MANIFEST_BYTES)
        .read_to_end(&mut whole)
        .map_err(StoreError::io("read", &path))?;
    reader.finish()?;
    Ok(whole)
}

/// Whether a text is 64 lower-case hex digits: it becomes a file name.
fn is_hash(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}
