//! Which assets there are, and which of them cannot be read.

use std::io::ErrorKind;

use wildcity_scene::rig::is_name;

use crate::store::backend::{HashedStart, ListedObject, ObjectListing, UnlistedObjects};
use crate::store::layout::ACTORS;
use crate::store::{Catalog, StoreError};

use super::object::{HEAD_BYTES, Header};
use super::{ActorList, DamagedActor, StoredActor};

/// Assets, and those of which nothing is known, because the disk or the object store fails to read
/// them.
#[derive(Default)]
pub(super) struct ReadActors {
    list: ActorList,
    unread: Vec<UnlistedObjects>,
}

/// What reading one listed asset gave.
enum ReadActor {
    Whole(StoredActor),
    Damaged(DamagedActor),
    /// It was removed since it was listed.
    Removed,
    /// The disk or the object store fails to read it: it may be whole.
    Unread(StoreError),
}

impl ReadActors {
    /// The list, if it is complete. Otherwise it cannot be said that no other asset has a name.
    ///
    /// # Errors
    /// One was not read.
    pub(super) fn whole(self) -> Result<ActorList, StoreError> {
        match self.unread.into_iter().next() {
            None => Ok(self.list),
            Some(UnlistedObjects { error, .. }) => Err(error),
        }
    }

    /// The list, in which those that were not read are damaged.
    pub(super) fn into_list(self) -> ActorList {
        let Self { mut list, unread } = self;
        list.damaged.extend(unread.into_iter().map(DamagedActor::unlisted));
        list.damaged.sort_by_cached_key(|one| one.hash.clone());
        list
    }
}

impl DamagedActor {
    fn unlisted(unlisted: UnlistedObjects) -> Self {
        let UnlistedObjects { digits: hash, error } = unlisted;
        let mut reason = skip_reason(error);
        // Two digits name a folder; an object has 64.
        if hash.len() == 2 {
            reason = format!("the folder of all assets whose hashes begin so: {reason}");
        }
        Self { hash, name: None, reason }
    }
}

impl Catalog {
    /// Reads the assets of a listing, without their Gaussians.
    pub(super) fn read_actors(&self, listing: ObjectListing) -> ReadActors {
        let mut read = ReadActors::default();
        for unlisted in listing.unlisted {
            match &unlisted.error {
                StoreError::Damaged { .. } => {
                    read.list.damaged.push(DamagedActor::unlisted(unlisted));
                }
                _ => read.unread.push(unlisted),
            }
        }
        for object in listing.objects {
            let digits = object.hash.clone();
            match self.read_head(object) {
                ReadActor::Whole(actor) => read.list.actors.push(actor),
                ReadActor::Damaged(damaged) => read.list.damaged.push(damaged),
                ReadActor::Removed => {}
                ReadActor::Unread(error) => read.unread.push(UnlistedObjects { digits, error }),
            }
        }
        let ActorList { actors, damaged } = &mut read.list;
        // A listing is in order of hashes; people look for names.
        actors.sort_by_cached_key(|one| (one.description.name.clone(), one.hash.clone()));
        damaged.sort_by_cached_key(|one| one.hash.clone());
        read
    }

    fn read_head(&self, object: ListedObject) -> ReadActor {
        let ListedObject { hash, bytes, is_file, .. } = object;
        // All bytes are hashed, although only the head is kept: damage anywhere makes an asset
        // unusable.
        let HashedStart { start, hash: found } =
            match self.objects.read_and_hash(ACTORS, &hash, HEAD_BYTES) {
                Ok(read) => read,
                Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => {
                    return ReadActor::Removed;
                }
                // A file that the system fails to read may be whole. A link or a pipe in its place
                // is damage.
                Err(error @ StoreError::Io { .. }) if is_file => return ReadActor::Unread(error),
                Err(error) => {
                    let reason = skip_reason(error);
                    return ReadActor::Damaged(DamagedActor { hash, name: None, reason });
                }
            };
        match Header::read(&start) {
            Ok((header, _)) if found == hash => {
                ReadActor::Whole(StoredActor::new(hash, bytes, header))
            }
            // The header can be parsed, so that the message can name the asset. The name may be
            // damaged, too: `is_name` keeps control characters out of the message.
            Ok((header, _)) => {
                let name = Some(header.description.name).filter(|name| is_name(name));
                let reason = format!("its bytes hash to {found}");
                ReadActor::Damaged(DamagedActor { hash, name, reason })
            }
            Err(reason) => ReadActor::Damaged(DamagedActor { hash, name: None, reason }),
        }
    }
}

/// The error of an asset that cannot be read, without its path, because clients of a server get
/// this text.
pub(super) fn skip_reason(error: StoreError) -> String {
    match error {
        StoreError::Io { action, cause, .. } => format!("cannot {action} it: {cause}"),
        StoreError::Damaged { reason, .. } => reason,
        error => error.to_string(),
    }
}
