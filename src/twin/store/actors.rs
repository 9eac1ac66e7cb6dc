//! Assets of actors: objects beside the twins, in `<twins>/.actors`, that every twin shares.
//!
//! An asset is one immutable object, named by its BLAKE3, which is its identity:
//!
//! ```text
//! 0      magic "WILDACTR", format u32, length of the header u32
//! 16     header (JSON): name, class, box, provenance, SH degree, record format, levels
//! ...    the levels, from level 0 on: parts of zstd-compressed records, as the sections of a chunk
//! ```
//!
//! There is no log: an asset never changes, and the same input gives the same object. Garbage collection of twins does
//! not touch assets.

use std::collections::BTreeSet;
use std::io::ErrorKind;
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::limits;
use wildcity_scene::actor::{ActorAsset, AssetDescription, AssetLevel};
use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_scene::record::Clamped;
use wildcity_scene::{RecordFormat, sh};

use super::chunk_file::{self, LevelOfBlock};
use super::layout::{ACTORS, is_hash};
use super::{Catalog, StoreError};

const MAGIC: [u8; 8] = *b"WILDACTR";
const FORMAT: u32 = 1;
/// Bytes before the header.
const START_BYTES: usize = 16;

/// An asset in the store, without its Gaussians.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredActor {
    /// Its identity: BLAKE3 of the object, 64 lower-case hex digits.
    pub hash: String,
    /// Size of the object, in bytes.
    pub bytes: u64,
    /// What it is.
    pub description: AssetDescription,
    /// Spherical-harmonic degree of its colours.
    pub sh_degree: u8,
    /// How its Gaussians are encoded.
    pub record: RecordFormat,
    /// Its levels of detail, from level 0 on.
    pub levels: Vec<StoredLevel>,
}

/// What [`Catalog::add_actor`] has done.
#[derive(Clone, Debug, PartialEq)]
pub struct AddedActor {
    /// The asset.
    pub actor: StoredActor,
    /// Whether it was not there before.
    pub is_new: bool,
}

/// Whether an asset may get the name of an asset of another content. A name that two assets have stands for neither.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SameName {
    /// It may.
    Allowed,
    /// It may not.
    Refused,
}

/// One level of a [`StoredActor`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StoredLevel {
    /// Number of Gaussians.
    pub count: u32,
    /// Upper bound of the geometric error, in metres.
    pub error_m: f32,
    /// Length in the object, in bytes.
    pub bytes: u32,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    description: AssetDescription,
    sh_degree: u8,
    record: RecordFormat,
    levels: Vec<StoredLevel>,
}

impl Catalog {
    /// Stores an asset. One that is stored already stays as it is.
    ///
    /// # Errors
    /// [`StoreError::Clamped`] if the record format cannot hold its values; nothing can be written.
    pub fn put_actor(
        &self,
        asset: &ActorAsset,
        record: RecordFormat,
    ) -> Result<StoredActor, StoreError> {
        self.add_actor(asset, record, SameName::Allowed).map(|added| added.actor)
    }

    /// As [`Catalog::put_actor`], and says whether the asset is new.
    ///
    /// In an object store, which has no locks, two processes that add different assets of one name at the same time
    /// both succeed.
    ///
    /// # Errors
    /// As [`Catalog::put_actor`]; [`StoreError::ActorExists`] with [`SameName::Refused`].
    pub fn add_actor(
        &self,
        asset: &ActorAsset,
        record: RecordFormat,
        same_name: SameName,
    ) -> Result<AddedActor, StoreError> {
        let (header, bytes) = self.encode_actor(asset, record)?;
        let hash = blake3::hash(&bytes).to_hex().to_string();
        self.remove_abandoned_commits(Some(ACTORS))?;
        let id = uuid::Uuid::now_v7().as_simple().to_string();
        let mut staging = self.objects.begin_staging(ACTORS, &id)?;
        // What holds of the other assets now holds until this one is visible.
        staging.lock_publishing()?;
        if same_name == SameName::Refused {
            self.check_name_is_free(&header.description.name, &hash)?;
        }
        let is_new = match self.objects.check_present(ACTORS, &hash, bytes.len() as u64) {
            Ok(()) => false,
            Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => true,
            // One that is damaged is written again.
            Err(StoreError::Damaged { .. }) => true,
            Err(error) => return Err(error),
        };
        let stored = staging.put(Box::new(|out| out.write_all(&bytes)))?;
        staging.place_objects(&BTreeSet::from([&*stored.hash]))?;
        Ok(AddedActor { actor: StoredActor::new(stored.hash, stored.bytes, header), is_new })
    }

    /// Refuses the name of an asset of another hash.
    fn check_name_is_free(&self, name: &str, hash: &str) -> Result<(), StoreError> {
        let is_other = |actor: &StoredActor| actor.description.name == name && actor.hash != hash;
        match self.actors()?.into_iter().find(is_other) {
            None => Ok(()),
            Some(other) => Err(StoreError::ActorExists { name: name.to_owned(), hash: other.hash }),
        }
    }

    /// All assets, in order of name and hash.
    ///
    /// # Errors
    /// They cannot be listed, or one is damaged.
    pub fn actors(&self) -> Result<Vec<StoredActor>, StoreError> {
        let mut actors = Vec::new();
        for object in self.objects.list_objects(ACTORS)? {
            let most = START_BYTES + limits::ACTOR_HEADER_BYTES;
            let start = self.objects.read_start(ACTORS, &object.hash, most)?;
            let (header, _) = self.header(&object.hash, &start)?;
            actors.push(StoredActor::new(object.hash, object.bytes, header));
        }
        actors.sort_by(|a, b| (&a.description.name, &a.hash).cmp(&(&b.description.name, &b.hash)));
        Ok(actors)
    }

    /// The one asset of a name, of a hash, or of a hash that begins with at least 4 digits.
    ///
    /// # Errors
    /// [`StoreError::NoActor`] if there is none, or more than one.
    pub fn find_actor(&self, text: &str) -> Result<StoredActor, StoreError> {
        let actors = self.actors()?;
        let is_prefix = text.len() >= 4 && text.bytes().all(|b| b.is_ascii_hexdigit());
        let is_it = |actor: &&StoredActor| {
            actor.description.name == text || is_prefix && actor.hash.starts_with(text)
        };
        let found: Vec<&StoredActor> = actors.iter().filter(is_it).collect();
        if let [one] = found[..] {
            return Ok(one.clone());
        }
        let listed = if found.is_empty() { actors.iter().collect() } else { found.clone() };
        let named =
            |actor: &&StoredActor| format!("{} ({})", actor.description.name, &actor.hash[..12]);
        Err(StoreError::NoActor {
            text: text.to_owned(),
            dir: self.dir().to_owned(),
            found: found.len(),
            known: listed.iter().map(named).collect(),
        })
    }

    /// Reads an asset, and compares it with its hash, 64 lower-case hex digits.
    ///
    /// # Errors
    /// [`StoreError::NoActor`]; [`StoreError::Damaged`] or [`StoreError::Format`] if it cannot be used.
    pub fn actor(&self, hash: &str) -> Result<ActorAsset, StoreError> {
        if !is_hash(hash) {
            return Err(StoreError::NoActor {
                text: hash.to_owned(),
                dir: self.dir().to_owned(),
                found: 0,
                known: Vec::new(),
            });
        }
        let bytes = match self.objects.read_object(ACTORS, hash, limits::ACTOR_BYTES) {
            Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => {
                return Err(self.find_actor(hash).err().unwrap_or_else(|| StoreError::NoActor {
                    text: hash.to_owned(),
                    dir: self.dir().to_owned(),
                    found: 0,
                    known: Vec::new(),
                }));
            }
            read => read?,
        };
        let (header, mut rest) = self.header(hash, &bytes)?;
        let damaged = |reason: String| {
            let path = self.objects.object_path(ACTORS, hash);
            StoreError::Damaged { path, reason }
        };
        let mut levels = Vec::with_capacity(header.levels.len());
        for (index, level) in header.levels.iter().enumerate() {
            let of_level = |reason: String| damaged(format!("level {index}: {reason}"));
            let own = rest.get(..level.bytes as usize);
            let own = own.ok_or_else(|| of_level("it ends before its last byte".to_owned()))?;
            rest = &rest[own.len()..];
            let (entry, section) = section(level);
            let chunk = chunk_file::unpack(own, &entry, &section, header.sh_degree, header.record);
            let chunk = Arc::new(chunk.map_err(of_level)?);
            levels.push(AssetLevel { error_m: level.error_m, chunk });
        }
        if !rest.is_empty() {
            return Err(damaged(format!("{} bytes are left over", rest.len())));
        }
        Ok(ActorAsset { description: header.description, levels })
    }

    fn encode_actor(
        &self,
        asset: &ActorAsset,
        record: RecordFormat,
    ) -> Result<(Header, Vec<u8>), StoreError> {
        let mut content = Vec::new();
        let mut levels = Vec::with_capacity(asset.levels.len());
        let sh_degree = asset.levels.first().map_or(0, |level| level.chunk.sh_degree());
        for (index, AssetLevel { error_m, chunk }) in asset.levels.iter().enumerate() {
            let mut clamped = Clamped::default();
            let level = LevelOfBlock { block: 0, level: index as u8, error_m: *error_m };
            let packed = chunk_file::pack(chunk, level, record, &mut clamped)
                .map_err(StoreError::io("compress for", self.dir()))?;
            let own = packed.into_bytes();
            // Merged Gaussians are approximations anyway: only level 0 counts.
            let gaussians = chunk.len() as u64;
            if let Some((field, count)) = clamped.worst().filter(|_| index == 0)
                && count as f64 > limits::CLAMPED_SHARE * gaussians as f64
            {
                return Err(StoreError::Clamped { record, field, count, gaussians });
            }
            let count = chunk.len() as u32;
            levels.push(StoredLevel { count, error_m: *error_m, bytes: own.len() as u32 });
            content.extend(own);
        }
        let header = Header { description: asset.description.clone(), sh_degree, record, levels };
        let json = self.encode(&header)?;
        let mut bytes = MAGIC.to_vec();
        bytes.extend(FORMAT.to_le_bytes());
        bytes.extend((json.len() as u32).to_le_bytes());
        bytes.extend(json);
        bytes.extend(content);
        Ok((header, bytes))
    }

    /// The header of an asset, and the bytes after it.
    fn header<'a>(&self, hash: &str, bytes: &'a [u8]) -> Result<(Header, &'a [u8]), StoreError> {
        let path = self.objects.object_path(ACTORS, hash);
        let damaged = |reason: String| StoreError::Damaged { path: path.clone(), reason };
        let start = bytes.split_first_chunk::<START_BYTES>();
        let (start, rest) = start.ok_or_else(|| damaged("it is shorter than its start".into()))?;
        let word = |at: usize| {
            u32::from_le_bytes([start[at], start[at + 1], start[at + 2], start[at + 3]])
        };
        if start[..8] != MAGIC {
            return Err(damaged("it does not start as an actor".into()));
        }
        if word(8) != FORMAT {
            let path = path.clone();
            return Err(StoreError::Format { path, found: word(8), supported: FORMAT });
        }
        let length = word(12) as usize;
        if length > limits::ACTOR_HEADER_BYTES {
            return Err(damaged("its header is longer than it may be".into()));
        }
        let json = rest.get(..length).ok_or_else(|| damaged("it ends in its header".into()))?;
        let header: Header =
            serde_json::from_slice(json).map_err(|error| damaged(error.to_string()))?;
        header.check().map_err(damaged)?;
        Ok((header, &rest[length..]))
    }
}

impl Header {
    /// Checks what the type does not say.
    fn check(&self) -> Result<(), String> {
        self.description.box_.check().map_err(|error| error.to_string())?;
        if self.sh_degree > sh::MAX_DEGREE {
            return Err(format!("SH degree is {}, not 0 to 3", self.sh_degree));
        }
        let first = self.levels.first().ok_or("it has no levels")?;
        if first.count as usize > ActorAsset::MOST_GAUSSIANS {
            return Err(format!("{} Gaussians are too many for an actor", first.count));
        }
        // Each condition states what must hold, so that NaN fails it.
        let rising = self.levels.is_sorted_by(|a, b| a.error_m <= b.error_m && a.count >= b.count);
        let finite = self.levels.iter().all(|level| level.error_m.is_finite());
        if rising && finite && first.error_m == 0.0 { Ok(()) } else { Err("wrong levels".into()) }
    }
}

impl StoredActor {
    fn new(hash: String, bytes: u64, header: Header) -> Self {
        let Header { description, sh_degree, record, levels } = header;
        Self { hash, bytes, description, sh_degree, record, levels }
    }

    /// Number of Gaussians at full detail.
    pub fn gaussians(&self) -> u64 {
        self.levels.first().map_or(0, |level| level.count.into())
    }
}

/// A level in the form of a chunk's section: what [`chunk_file::unpack`] reads of it is the count, the cell and the
/// origin.
fn section(level: &StoredLevel) -> (ChunkEntry, Section) {
    let entry = ChunkEntry {
        cell: [0, 0],
        object: String::new(),
        count: level.count.into(),
        bytes: level.bytes.into(),
        bounds: Bounds::EMPTY,
        origin_m: DVec3::ZERO,
        sections: Vec::new(),
    };
    let section = Section {
        block: 0,
        level: 0,
        count: level.count,
        error_m: level.error_m,
        min_m: [0.0; 3],
        max_m: [0.0; 3],
        offset_bytes: 0,
        bytes: level.bytes,
        hash: [0; 32],
    };
    (entry, section)
}
