//! Assets of actors in memory: one copy for all sessions.
//!
//! A scenario's assets are in memory from when it opens, with all levels of detail, until its last
//! episode ends: no frame waits for an actor. They count against the memory of twins, and sections
//! get what is left. So do assets that a program makes and the store does not have.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;

use super::ResidencyError;
use super::budget::{Claim, FrameBytes};
use super::resident::Shared;
use crate::store::Catalog;
use wildcity_scene::actor::ActorAsset;

/// The assets in memory, by their hash, or by the key of one that is not in the store.
#[derive(Debug, Default)]
pub(super) struct ActorPool(Mutex<Actors>);

/// An asset in memory, until its last copy is dropped.
#[derive(Debug)]
pub struct ResidentActor {
    hash: String,
    asset: ActorAsset,
    claim: Claim,
    shared: Arc<Shared>,
}

impl ResidentActor {
    /// BLAKE3 of the asset, 64 lower-case hex digits; of an asset that is not in the store, its
    /// key.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// The asset.
    pub fn asset(&self) -> &ActorAsset {
        &self.asset
    }
}

impl ActorPool {
    /// The asset of a hash, read from the catalog unless it is in memory already.
    ///
    /// # Errors
    /// As [`Catalog::actor`]; [`ResidencyError::NoRoomForActor`].
    pub(super) fn get(
        &self,
        catalog: &Catalog,
        shared: &Arc<Shared>,
        hash: &str,
    ) -> Result<Arc<ResidentActor>, ResidencyError> {
        // Locked while reading, so that sessions that open at once do not read an asset twice.
        let mut actors = self.0.lock();
        match present(&mut actors, hash) {
            Some(actor) => Ok(actor),
            None => add(&mut actors, shared, hash, catalog.actor(hash)?),
        }
    }

    /// An asset that is not in the store, under a key that is not a hash; the existing one if the
    /// key has one already.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoomForActor`].
    pub(super) fn hold(
        &self,
        shared: &Arc<Shared>,
        key: &str,
        asset: ActorAsset,
    ) -> Result<Arc<ResidentActor>, ResidencyError> {
        let mut actors = self.0.lock();
        match present(&mut actors, key) {
            Some(actor) => Ok(actor),
            None => add(&mut actors, shared, key, asset),
        }
    }
}

/// The assets of a pool.
type Actors = BTreeMap<String, Weak<ResidentActor>>;

/// The asset of a hash or a key, if it is in memory. Forgets those that are not any more.
fn present(actors: &mut Actors, hash: &str) -> Option<Arc<ResidentActor>> {
    actors.retain(|_, actor| actor.strong_count() > 0);
    actors.get(hash).and_then(|actor| actor.upgrade())
}

/// Counts an asset against the memory of twins.
///
/// # Errors
/// [`ResidencyError::NoRoomForActor`].
fn add(
    actors: &mut Actors,
    shared: &Arc<Shared>,
    hash: &str,
    asset: ActorAsset,
) -> Result<Arc<ResidentActor>, ResidencyError> {
    let bytes = asset.bytes();
    let name = asset.description.name.clone();
    let frame = FrameBytes::default();
    // The asset takes the place of a version in the budget: all of it is needed at once, so that
    // `bytes` and `total_bytes` are equal and a second claim of the same hash would cost nothing.
    let claim = Claim { twin: name, version: hash.to_owned(), bytes, total_bytes: bytes, frame };
    // The budget is asked first: if it refuses, the table is unchanged.
    shared.budget.lock().reserve(&claim).map_err(ResidencyError::for_actor)?;
    shared.pager.with_table(|table| table.add_outside_bytes(bytes));
    let shared = shared.clone();
    let actor = Arc::new(ResidentActor { hash: hash.to_owned(), asset, claim, shared });
    actors.insert(hash.to_owned(), Arc::downgrade(&actor));
    Ok(actor)
}

impl ResidencyError {
    /// The error of an asset for which there is not enough memory.
    fn for_actor(self) -> Self {
        match self {
            Self::NoRoom { twin, needed_bytes, held_bytes, limit_bytes } => {
                Self::NoRoomForActor { actor: twin, needed_bytes, held_bytes, limit_bytes }
            }
            other => other,
        }
    }
}

impl Drop for ResidentActor {
    fn drop(&mut self) {
        // In the reverse order of `add`, so that the budget never grants bytes that the table still
        // counts.
        self.shared.pager.with_table(|table| table.remove_outside_bytes(self.claim.bytes));
        self.shared.budget.lock().release(&self.claim);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::residency::Cache;
    use wildcity_scene::actor::AssetDescription;
    use wildcity_scene::manifest::Provenance;
    use wildcity_scene::{ActorBox, ActorClass, Gaussians};

    fn asset() -> ActorAsset {
        let gaussians = Gaussians {
            sh_degree: 0,
            means_m: vec![[0.0, 0.0, 1.0]],
            quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]],
            ln_scales: vec![[-2.0; 3]],
            logit_opacities: vec![1.0],
            sh: vec![0.0; 3],
            ..Gaussians::default()
        };
        let description = AssetDescription {
            name: "box".to_owned(),
            class: ActorClass::Object,
            box_: ActorBox::PEDESTRIAN,
            provenance: Provenance::new("test".to_owned()),
        };
        ActorAsset::new(&gaussians, description).unwrap()
    }

    #[test]
    fn a_held_asset_is_counted_once_until_its_last_copy_is_dropped() {
        let asset = asset();
        let bytes = asset.bytes();
        let dir = tempfile::tempdir().unwrap();
        // The limit has room for exactly one asset, so that a second one under another key is
        // refused.
        let cache = Cache::limited(Catalog::open(dir.path()).unwrap(), Some(bytes));
        let first = cache.hold_actor("4x2x1#808080", asset.clone()).unwrap();
        let again = cache.hold_actor("4x2x1#808080", asset.clone()).unwrap();
        assert!(Arc::ptr_eq(&first, &again));
        // Two holds of one key, counted once.
        assert_eq!(cache.stats().reserved_bytes, bytes);
        let refused = cache.hold_actor("5x2x1#808080", asset.clone()).unwrap_err();
        assert!(matches!(refused, ResidencyError::NoRoomForActor { .. }), "{refused}");
        drop((first, again));
        assert_eq!(cache.stats().reserved_bytes, 0);
        assert!(cache.hold_actor("5x2x1#808080", asset).is_ok());
    }
}
