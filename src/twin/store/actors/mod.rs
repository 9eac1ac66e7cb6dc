//! Assets of actors: objects in `<twins>/.actors`, next to the twins, that every twin shares.
//!
//! An asset is one immutable object, named by its BLAKE3, which is its identity:
//!
//! ```text
//! 0      magic "WILDACTR", format u32, length of the header u32
//! 16     header (JSON): name, class, box, provenance, SH degree, record format, levels
//! ...    the levels, from level 0 on: parts of zstd-compressed records, as the sections of a chunk
//! ```
//!
//! There is no log: an asset never changes, and the same input gives the same object. Garbage
//! collection of twins does not touch assets; [`Catalog::remove_actor`] removes one. A damaged
//! asset does not affect the others.

mod list;
mod object;

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use crate::limits;
use wildcity_scene::RecordFormat;
use wildcity_scene::actor::{ActorAsset, AssetDescription};

use super::backend::{ListedObject, ObjectListing};
use super::layout::{ACTORS, is_hash};
use super::{Catalog, StoreError};

use list::skip_reason;
use object::Header;

/// An asset in the store, without its Gaussians.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredActor {
    /// Its identity: BLAKE3 of the object, 64 lower-case hex digits.
    pub hash: String,
    /// Size of the object, in bytes.
    pub bytes: u64,
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
    /// The assets that can be read, in order of name and hash.
    pub actors: Vec<StoredActor>,
    /// The others, in order of hash.
    pub damaged: Vec<DamagedActor>,
}

/// An asset that differs from what was stored, or cannot be read; or a folder of assets that cannot
/// be listed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DamagedActor {
    /// Its hash, 64 lower-case hex digits; for a folder, the first two digits of the hashes of its
    /// assets.
    pub hash: String,
    /// The name that it states, if that can be read. It may be damaged, too, so that it stands for
    /// no asset.
    pub name: Option<String>,
    pub reason: String,
}

/// The result of [`Catalog::add_actor`].
#[derive(Clone, Debug, PartialEq)]
pub struct AddedActor {
    pub actor: StoredActor,
    /// Whether it was not there before.
    pub is_new: bool,
}

/// Whether an asset may get the name of an asset of another content. A name that two assets have
/// cannot be used for either.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SameName {
    Allowed,
    Refused,
}

/// One level of a [`StoredActor`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StoredLevel {
    pub count: u32,
    /// Upper bound of the geometric error, in metres.
    pub error_m: f32,
    /// Length in the object, in bytes.
    pub bytes: u32,
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

    /// As [`Catalog::put_actor`], and returns whether the asset is new.
    ///
    /// In an object store, which has no locks, two processes that add different assets of one name
    /// at the same time both succeed.
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
        // The other assets cannot change from now on until this one is visible.
        staging.lock_publishing()?;
        let listing = self.objects.list_objects(ACTORS)?;
        // Whether the bytes of the object are right is not read here, only its kind and its size.
        let is_whole = |known: &ListedObject| known.is_file && known.bytes == bytes.len() as u64;
        let known = listing.objects.iter().find(|known| known.hash == hash);
        let is_new = !known.is_some_and(is_whole);
        if same_name == SameName::Refused {
            self.check_name_is_free(listing, &header.description.name, &hash)?;
        }
        // It is written in any case, over one that is damaged as well.
        let stored = staging.put(Box::new(|out| out.write_all(&bytes)))?;
        staging.place_objects(&BTreeSet::from([&*stored.hash]))?;
        Ok(AddedActor { actor: StoredActor::new(stored.hash, stored.bytes, header), is_new })
    }

    /// Refuses the name of an asset of another hash.
    fn check_name_is_free(
        &self,
        listing: ObjectListing,
        name: &str,
        hash: &str,
    ) -> Result<(), StoreError> {
        let is_other = |actor: &StoredActor| actor.description.name == name && actor.hash != hash;
        let list = self.read_actors(listing).whole()?;
        match list.actors.into_iter().find(is_other) {
            None => Ok(()),
            Some(other) => Err(StoreError::ActorExists { name: name.to_owned(), hash: other.hash }),
        }
    }

    /// All assets, and those that are damaged or that the disk fails to read or to list.
    ///
    /// # Errors
    /// The folder of all of them cannot be listed.
    pub fn actors(&self) -> Result<ActorList, StoreError> {
        let listing = self.objects.list_objects(ACTORS)?;
        Ok(self.read_actors(listing).into_list())
    }

    /// The one asset of a name, of a hash, or of a hash that begins with at least 4 digits.
    ///
    /// # Errors
    /// [`StoreError::NoActor`] if there is none, or more than one; [`StoreError::ActorDamaged`] if
    /// the only ones are damaged; the disk fails to read one that may be it.
    pub fn find_actor(&self, text: &str) -> Result<StoredActor, StoreError> {
        let mut listing = self.objects.list_objects(ACTORS)?;
        // Sessions look the assets of each episode up by their whole hashes: no other asset is read
        // then.
        if listing.objects.iter().any(|object| object.hash == text) {
            listing.objects.retain(|object| object.hash == text);
            listing.unlisted.clear();
        }
        let ActorList { actors, damaged } = self.read_actors(listing).whole()?;
        // A shorter text is a name only: several hashes would begin with it.
        let is_prefix = text.len() >= 4 && text.bytes().all(|b| b.is_ascii_hexdigit());
        let is_hash_of = |hash: &str| is_prefix && hash.starts_with(text);
        let is_it = |one: &&StoredActor| one.description.name == text || is_hash_of(&one.hash);
        let found: Vec<&StoredActor> = actors.iter().filter(is_it).collect();
        // A damaged asset keeps no other from its name. In a damaged folder may be whatever begins
        // with its digits.
        let is_damaged = |one: &&DamagedActor| {
            let is_in_folder = !is_hash(&one.hash) && is_prefix && text.starts_with(&one.hash);
            let is_named = found.is_empty() && one.name.as_deref() == Some(text);
            is_hash_of(&one.hash) || is_in_folder || is_named
        };
        let found_damaged: Vec<&DamagedActor> = damaged.iter().filter(is_damaged).collect();
        let count = found.len() + found_damaged.len();
        match (&found[..], &found_damaged[..]) {
            ([one], []) => return Ok((*one).clone()),
            ([], [one]) => return Err((*one).clone().into()),
            _ => {}
        }
        // Without a match all are named, so that the message shows what there is.
        let listed = if count == 0 { actors.iter().collect() } else { found };
        let named = |one: &StoredActor| format!("{} ({})", one.description.name, digits(&one.hash));
        let damaged = |one: &DamagedActor| format!("a damaged one ({})", digits(&one.hash));
        let known = listed.into_iter().map(named).chain(found_damaged.into_iter().map(damaged));
        Err(StoreError::NoActor { text: text.to_owned(), found: count, known: known.collect() })
    }

    /// Removes an asset, given as to [`Catalog::find_actor`]; a damaged one, too. Returns its hash.
    /// With `dry_run` nothing is removed.
    ///
    /// Sessions that have the asset in memory keep it. Scenarios that name it are refused from now
    /// on, and recorded episodes that drew it cannot be replayed, until the same asset is stored
    /// again.
    ///
    /// # Errors
    /// [`StoreError::NoActor`]; it cannot be removed.
    pub fn remove_actor(&self, text: &str, dry_run: bool) -> Result<String, StoreError> {
        let find = || match self.find_actor(text) {
            Ok(actor) => Ok(actor.hash),
            Err(StoreError::ActorDamaged { hash, .. }) if is_hash(&hash) => Ok(hash),
            Err(error) => Err(error),
        };
        if dry_run {
            return find();
        }
        let mut removed = String::new();
        // Looked up under the lock: until then another process may store a second asset of the
        // name.
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
            // It does not exist, is not a file, or cannot be read.
            Err(error @ StoreError::Io { .. }) => {
                // `find_actor` knows more about it: that there is none, or that it is damaged.
                return Err(self.find_actor(hash).err().unwrap_or(error));
            }
            Err(error) => return Err(damaged(None, skip_reason(error))),
        };
        let (header, rest) = Header::read(&bytes).map_err(|reason| damaged(None, reason))?;
        match header.levels(rest) {
            Ok(levels) => Ok(ActorAsset { description: header.description, levels }),
            Err(reason) => Err(damaged(Some(header.description.name), reason)),
        }
    }
}

/// The first digits of a hash, which are enough to find an asset.
fn digits(hash: &str) -> &str {
    hash.get(..12).unwrap_or(hash)
}

impl From<DamagedActor> for StoreError {
    fn from(damaged: DamagedActor) -> Self {
        let DamagedActor { hash, name, reason } = damaged;
        Self::ActorDamaged { hash, name, reason }
    }
}

impl StoredActor {
    fn new(hash: String, bytes: u64, header: Header) -> Self {
        let Header { description, sh_degree, record, levels, .. } = header;
        Self { hash, bytes, description, sh_degree, record, levels }
    }

    /// Number of Gaussians at full detail.
    pub fn gaussians(&self) -> u64 {
        self.levels.first().map_or(0, |level| level.count.into())
    }
}
