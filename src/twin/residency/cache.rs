//! The versions of twins that are open, and the memory that they share.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;

use crate::store::{Catalog, Version};
use wildcity_scene::actor::ActorAsset;
use wildcity_scene::manifest::SkyRef;
use wildcity_scene::{Manifest, Sky};

use super::actors::{ActorPool, ResidentActor};
use super::budget::{Budget, default_memory_bytes};
use super::pager::Pager;
use super::resident::Shared;
use super::{ResidencyError, Resident, SectionSource, Stats};

/// Opens versions of twins, and shares the memory for what their frames need.
#[derive(Debug)]
pub struct Cache {
    catalog: Catalog,
    shared: Arc<Shared>,
    /// By manifest hash and version number, because a rollback gives an old manifest a new number.
    slots: Mutex<BTreeMap<(String, u64), VersionSlot>>,
    /// The skies of the open versions.
    skies: Mutex<Vec<(SkyKey, Weak<Sky>)>>,
    /// The assets of actors in memory.
    actors: ActorPool,
    /// The version that was opened last stays open for the next session, because its table has
    /// megabytes.
    last: Mutex<Option<Arc<Resident>>>,
}

/// A version that is open or being opened. The lock is held while opening, so that concurrent
/// callers wait for the result and do not read the version again.
type VersionSlot = Arc<Mutex<Weak<Resident>>>;

/// A sky, and the `sky_error` that it is baked for.
type SkyKey = (SkyRef, f64);

impl Cache {
    /// An empty cache that may use three quarters of the machine's memory.
    pub fn new(catalog: Catalog) -> Self {
        Self::limited(catalog, None)
    }

    /// An empty cache that may use `limit_bytes`; by default three quarters of the machine's
    /// memory.
    pub fn limited(catalog: Catalog, limit_bytes: Option<u64>) -> Self {
        let source = Arc::new(catalog.clone());
        Self::with_source(catalog, source, limit_bytes)
    }

    /// As [`Cache::limited`], with sections read from a source other than the catalog.
    pub fn with_source(
        catalog: Catalog,
        source: Arc<dyn SectionSource>,
        limit_bytes: Option<u64>,
    ) -> Self {
        let limit_bytes = limit_bytes.unwrap_or_else(default_memory_bytes);
        let pager = Pager::new(source, limit_bytes);
        let budget = Mutex::new(Budget::new(limit_bytes));
        Self {
            catalog,
            shared: Arc::new(Shared { pager, budget }),
            slots: Mutex::default(),
            skies: Mutex::default(),
            actors: ActorPool::default(),
            last: Mutex::default(),
        }
    }

    /// The catalog that versions are read from.
    pub fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// Bytes that twins may take, and the frames that show them.
    pub fn limit_bytes(&self) -> u64 {
        self.shared.pager.memory().1
    }

    /// Opens one version of a twin, or the latest. Reads its table unless the version is open
    /// already; blocks meanwhile.
    ///
    /// # Errors
    /// As [`Catalog::version`]; [`ResidencyError::Thread`] on the first call.
    pub fn open(&self, name: &str, number: Option<u64>) -> Result<Arc<Resident>, ResidencyError> {
        self.shared.pager.start()?;
        let version = self.catalog.version(name, number)?;
        let slot = self.slot(&version);
        // Locks are taken in the order slot, skies, table of the pager. No holder of the others
        // waits for a slot.
        let mut held = slot.lock();
        let resident = match held.upgrade() {
            Some(resident) => resident,
            None => {
                let sky = self.sky(&version)?;
                Arc::new(Resident::new(version, sky, self.shared.clone()))
            }
        };
        *held = Arc::downgrade(&resident);
        *self.last.lock() = Some(resident.clone());
        Ok(resident)
    }

    /// The asset of a hash, 64 lower-case hex digits, in memory until its last copy is dropped.
    /// Reads it unless it is in memory already; blocks meanwhile.
    ///
    /// # Errors
    /// As [`Catalog::actor`]; [`ResidencyError::NoRoomForActor`].
    pub fn actor(&self, hash: &str) -> Result<Arc<ResidentActor>, ResidencyError> {
        self.actors.get(&self.catalog, &self.shared, hash)
    }

    /// An asset that is not in the store, in memory until its last copy is dropped; the existing
    /// one if the key has one already. `key` identifies everything that it is made from, and is not
    /// a hash.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoomForActor`].
    pub fn hold_actor(
        &self,
        key: &str,
        asset: ActorAsset,
    ) -> Result<Arc<ResidentActor>, ResidencyError> {
        self.actors.hold(&self.shared, key, asset)
    }

    /// Counts since the start, and what is in memory now.
    pub fn stats(&self) -> Stats {
        self.shared.stats()
    }

    /// The sky of a version, baked to its profile's `sky_error`. Versions with the same sky and
    /// error share it.
    fn sky(&self, version: &Version) -> Result<Option<Arc<Sky>>, ResidencyError> {
        let Manifest { sky: Some(named), profile, twin, .. } = &version.manifest else {
            return Ok(None);
        };
        let key = (named.clone(), profile.sky_error);
        // Locked while the sky is read and baked, so that sessions that open at once do not bake it
        // twice.
        let mut skies = self.skies.lock();
        skies.retain(|(_, sky)| sky.strong_count() > 0);
        let known = skies.iter().find(|(known, _)| *known == key);
        if let Some(sky) = known.and_then(|(_, sky)| sky.upgrade()) {
            return Ok(Some(sky));
        }
        let Some(sky) = self.catalog.sky(version)? else { return Ok(None) };
        let baked = sky.drawable(profile.sky_error);
        baked.map_err(|cause| ResidencyError::Sky { twin: twin.clone(), cause })?;
        let sky = Arc::new(sky);
        skies.push((key, Arc::downgrade(&sky)));
        Ok(Some(sky))
    }

    /// The slot of a version. Slots of closed versions are removed, so that they do not accumulate
    /// as versions come and go.
    fn slot(&self, version: &Version) -> VersionSlot {
        let mut slots = self.slots.lock();
        // A count above 1 means that a caller has the slot and may hold its lock for seconds. It is
        // tested first, so that `lock` here never waits.
        slots.retain(|_, slot| Arc::strong_count(slot) > 1 || slot.lock().strong_count() > 0);
        slots.entry((version.hash.clone(), version.number)).or_default().clone()
    }
}
