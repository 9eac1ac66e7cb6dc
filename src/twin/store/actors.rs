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
//! not touch assets; [`Catalog::remove_actor`] removes one. An asset that is damaged does not concern the others.

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
use wildcity_scene::rig::is_name;
use wildcity_scene::{RecordFormat, sh};

use super::backend::{HashedStart, ListedObject};
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

/// The assets of a catalog.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ActorList {
    /// Those that can be read, in order of name and hash.
    pub actors: Vec<StoredActor>,
    /// The others, in order of hash.
    pub damaged: Vec<DamagedActor>,
}

/// An asset that differs from what was stored, or cannot be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DamagedActor {
    /// Its hash, 64 lower-case hex digits.
    pub hash: String,
    /// The name that it states, if that can be read. It may be damaged, too, so that it stands for no asset.
    pub name: Option<String>,
    /// What is wrong.
    pub reason: String,
}

/// Assets, and those of which nothing is known, because the disk or the object store fails to read them.
#[derive(Default)]
struct ReadActors {
    list: ActorList,
    /// Hashes and errors.
    unread: Vec<(String, StoreError)>,
}

impl ReadActors {
    /// The list, if it is complete. Otherwise it cannot be said that no other asset has a name.
    ///
    /// # Errors
    /// One was not read.
    fn whole(self) -> Result<ActorList, StoreError> {
        match self.unread.into_iter().next() {
            None => Ok(self.list),
            Some((_, error)) => Err(error),
        }
    }
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
        let is_whole = |known: &ListedObject| known.is_file && known.bytes == bytes.len() as u64;
        let known = self.objects.list_objects(ACTORS)?.into_iter().find(|known| known.hash == hash);
        let is_new = !known.as_ref().is_some_and(is_whole);
        // It is written in any case, over one that is damaged as well.
        let stored = staging.put(Box::new(|out| out.write_all(&bytes)))?;
        staging.place_objects(&BTreeSet::from([&*stored.hash]))?;
        Ok(AddedActor { actor: StoredActor::new(stored.hash, stored.bytes, header), is_new })
    }

    /// Refuses the name of an asset of another hash.
    fn check_name_is_free(&self, name: &str, hash: &str) -> Result<(), StoreError> {
        let is_other = |actor: &StoredActor| actor.description.name == name && actor.hash != hash;
        let list = self.read_actors(self.objects.list_objects(ACTORS)?).whole()?;
        match list.actors.into_iter().find(is_other) {
            None => Ok(()),
            Some(other) => Err(StoreError::ActorExists { name: name.to_owned(), hash: other.hash }),
        }
    }

    /// All assets, and those that are damaged or that the disk fails to read.
    ///
    /// # Errors
    /// They cannot be listed.
    pub fn actors(&self) -> Result<ActorList, StoreError> {
        let ReadActors { mut list, unread } = self.read_actors(self.objects.list_objects(ACTORS)?);
        let unread = unread.into_iter().map(|(hash, error)| DamagedActor {
            hash,
            name: None,
            reason: reason_of(error),
        });
        list.damaged.extend(unread);
        list.damaged.sort_by_cached_key(|one| one.hash.clone());
        Ok(list)
    }

    fn read_actors(&self, objects: Vec<ListedObject>) -> ReadActors {
        let mut read = ReadActors::default();
        for object in objects {
            let hash = object.hash.clone();
            match self.stored_actor(object) {
                Ok(Ok(Some(actor))) => read.list.actors.push(actor),
                // It was removed in between.
                Ok(Ok(None)) => {}
                Ok(Err(damaged)) => read.list.damaged.push(damaged),
                Err(error) => read.unread.push((hash, error)),
            }
        }
        let actors = &mut read.list.actors;
        actors.sort_by_cached_key(|one| (one.description.name.clone(), one.hash.clone()));
        read
    }

    /// An asset without its Gaussians; `None` if it does not exist. The inner error is damage of the asset.
    ///
    /// # Errors
    /// The disk or the object store fails to read it: it may be whole.
    fn stored_actor(
        &self,
        object: ListedObject,
    ) -> Result<Result<Option<StoredActor>, DamagedActor>, StoreError> {
        let ListedObject { hash, bytes, is_file, .. } = object;
        let most = START_BYTES + limits::ACTOR_HEADER_BYTES;
        let read = match self.objects.read_and_hash(ACTORS, &hash, most) {
            Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => {
                return Ok(Ok(None));
            }
            read => read,
        };
        let HashedStart { start, hash: found } = match read {
            Ok(read) => read,
            Err(error @ StoreError::Io { .. }) if is_file => return Err(error),
            Err(error) => {
                return Ok(Err(DamagedActor { hash, name: None, reason: reason_of(error) }));
            }
        };
        Ok(match header(&start) {
            Ok((header, _)) if found == hash => Ok(Some(StoredActor::new(hash, bytes, header))),
            Ok((header, _)) => {
                let name = Some(header.description.name).filter(|name| is_name(name));
                Err(DamagedActor { hash, name, reason: format!("its bytes hash to {found}") })
            }
            Err(reason) => Err(DamagedActor { hash, name: None, reason }),
        })
    }

    /// The one asset of a name, of a hash, or of a hash that begins with at least 4 digits.
    ///
    /// # Errors
    /// [`StoreError::NoActor`] if there is none, or more than one; [`StoreError::ActorDamaged`] if the only ones are
    /// damaged; the disk fails to read one that may be it.
    pub fn find_actor(&self, text: &str) -> Result<StoredActor, StoreError> {
        let mut objects = self.objects.list_objects(ACTORS)?;
        // Sessions look the assets of each episode up by their whole hashes: no other asset is read then.
        if objects.iter().any(|object| object.hash == text) {
            objects.retain(|object| object.hash == text);
        }
        let ActorList { actors, damaged } = self.read_actors(objects).whole()?;
        let is_prefix = text.len() >= 4 && text.bytes().all(|b| b.is_ascii_hexdigit());
        let is_hash_of = |hash: &str| is_prefix && hash.starts_with(text);
        let is_it = |one: &&StoredActor| one.description.name == text || is_hash_of(&one.hash);
        let found: Vec<&StoredActor> = actors.iter().filter(is_it).collect();
        // A damaged asset keeps no other from its name.
        let is_damaged = |one: &&DamagedActor| {
            is_hash_of(&one.hash) || found.is_empty() && one.name.as_deref() == Some(text)
        };
        let found_damaged: Vec<&DamagedActor> = damaged.iter().filter(is_damaged).collect();
        let count = found.len() + found_damaged.len();
        match (&found[..], &found_damaged[..]) {
            ([one], []) => return Ok((*one).clone()),
            ([], [one]) => return Err((*one).clone().into()),
            _ => {}
        }
        let listed = if count == 0 { actors.iter().collect() } else { found };
        let named = |one: &StoredActor| format!("{} ({})", one.description.name, digits(&one.hash));
        let damaged = |one: &DamagedActor| format!("a damaged one ({})", digits(&one.hash));
        let known = listed.into_iter().map(named).chain(found_damaged.into_iter().map(damaged));
        Err(StoreError::NoActor { text: text.to_owned(), found: count, known: known.collect() })
    }

    /// Removes an asset, given as to [`Catalog::find_actor`]; a damaged one, too. Returns its hash. With `dry_run`
    /// nothing is removed.
    ///
    /// What has the asset in memory keeps it. Scenarios that name it are refused from now on, and recorded episodes
    /// that drew it cannot be replayed, until the same asset is stored again.
    ///
    /// # Errors
    /// [`StoreError::NoActor`]; it cannot be removed.
    pub fn remove_actor(&self, text: &str, dry_run: bool) -> Result<String, StoreError> {
        let find = || match self.find_actor(text) {
            Ok(actor) => Ok(actor.hash),
            Err(StoreError::ActorDamaged { hash, .. }) => Ok(hash),
            Err(error) => Err(error),
        };
        if dry_run {
            return find();
        }
        let mut removed = String::new();
        self.objects.remove_objects(ACTORS, &mut || {
            removed = find()?;
            Ok(vec![removed.clone()])
        })?;
        Ok(removed)
    }

    /// Reads an asset, and compares it with its hash, 64 lower-case hex digits.
    ///
    /// # Errors
    /// [`StoreError::NoActor`]; [`StoreError::ActorDamaged`] if it cannot be used.
    pub fn actor(&self, hash: &str) -> Result<ActorAsset, StoreError> {
        let none = || StoreError::NoActor { text: hash.to_owned(), found: 0, known: Vec::new() };
        if !is_hash(hash) {
            return Err(none());
        }
        let damaged = |name: Option<String>, reason: String| StoreError::ActorDamaged {
            hash: hash.to_owned(),
            name,
            reason,
        };
        let bytes = match self.objects.read_object(ACTORS, hash, limits::ACTOR_BYTES) {
            Ok(bytes) => bytes,
            // It does not exist, is no file, or cannot be read.
            Err(error @ StoreError::Io { .. }) => {
                return Err(self.find_actor(hash).err().unwrap_or(error));
            }
            Err(error) => return Err(damaged(None, reason_of(error))),
        };
        let (header, mut rest) = header(&bytes).map_err(|reason| damaged(None, reason))?;
        let damaged = |reason: String| damaged(Some(header.description.name.clone()), reason);
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
}

/// The header of an asset, and the bytes after it. The error says what is wrong with them.
fn header(bytes: &[u8]) -> Result<(Header, &[u8]), String> {
    let start = bytes.split_first_chunk::<START_BYTES>();
    let (start, rest) = start.ok_or("it is shorter than its start")?;
    let word =
        |at: usize| u32::from_le_bytes([start[at], start[at + 1], start[at + 2], start[at + 3]]);
    if start[..8] != MAGIC {
        return Err("it does not start as an actor".to_owned());
    }
    if word(8) != FORMAT {
        return Err(format!("it has format {}; this build reads format {FORMAT}", word(8)));
    }
    let length = word(12) as usize;
    if length > limits::ACTOR_HEADER_BYTES {
        return Err("its header is longer than it may be".to_owned());
    }
    let json = rest.get(..length).ok_or("it ends in its header")?;
    let header: Header = serde_json::from_slice(json).map_err(|error| error.to_string())?;
    header.check()?;
    Ok((header, &rest[length..]))
}

/// The first digits of a hash, which are enough to find an asset.
fn digits(hash: &str) -> &str {
    hash.get(..12).unwrap_or(hash)
}

/// What is wrong with an asset that cannot be read, without its path: clients of a server get this text.
fn reason_of(error: StoreError) -> String {
    match error {
        StoreError::Io { action, cause, .. } => format!("cannot {action} it: {cause}"),
        StoreError::Damaged { reason, .. } => reason,
        error => error.to_string(),
    }
}

impl From<DamagedActor> for StoreError {
    fn from(damaged: DamagedActor) -> Self {
        let DamagedActor { hash, name, reason } = damaged;
        Self::ActorDamaged { hash, name, reason }
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
