//! One copy in memory of every twin version in use.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use rayon::prelude::*;

use crate::scene::manifest::ChunkEntry;
use crate::scene::{Chunk, RenderProfile, Scene};
use crate::store::{Catalog, Listing, StoreError, Version};

use super::budget::{Budget, Room};
use super::{Eye, Needed, ResidencyError, demand};

/// A version of a twin, ready to be rendered.
#[derive(Debug)]
pub struct Resident {
    /// What was loaded.
    pub version: Version,
    /// `[chunk][section]`, as in the manifest.
    sections: Vec<Vec<Arc<Chunk>>>,
    _room: Room,
}

impl Resident {
    /// What a frame of these cameras draws; `profile` is the version's unless somebody knows better.
    pub fn scene(&self, eyes: &[Eye], profile: &RenderProfile) -> Scene {
        let needed = demand(&self.version.manifest, eyes, profile);
        let chunk = |n: Needed| self.sections[n.chunk][n.section].clone();
        Scene { chunks: needed.into_iter().map(chunk).collect() }
    }

    /// Memory that its Gaussians take, all levels, in bytes.
    pub fn bytes(&self) -> usize {
        self.sections.iter().flatten().map(|chunk| chunk.bytes()).sum()
    }
}

/// Loads twin versions and shares them between sessions for as long as one holds them; the one that
/// was opened last stays for the next session, so that episodes in a row load once.
#[derive(Debug)]
pub struct Cache {
    catalog: Catalog,
    budget: Budget,
    /// By manifest hash and number: a rollback gives an old manifest a new number. The inner lock is
    /// held while loading, so that others wait for the result rather than load again; a failed load
    /// leaves an empty slot, and the next one tries.
    slots: Mutex<BTreeMap<(String, u64), Slot>>,
    last: Mutex<Option<Arc<Resident>>>,
}

type Slot = Arc<Mutex<Weak<Resident>>>;

impl Cache {
    /// Nothing in memory yet, and room for three quarters of the machine's memory.
    pub fn new(catalog: Catalog) -> Self {
        Self::limited(catalog, None)
    }

    /// The same with room for so many bytes of twins, if it is said.
    pub fn limited(catalog: Catalog, limit_bytes: Option<u64>) -> Self {
        let budget = Budget::new(limit_bytes);
        Self { catalog, budget, slots: Mutex::default(), last: Mutex::default() }
    }

    /// The twins that can be opened.
    ///
    /// # Errors
    /// As [`Catalog::twins`].
    pub fn twins(&self) -> Result<Vec<Listing>, StoreError> {
        self.catalog.twins()
    }

    /// One version of a twin, or the latest, loaded if nobody holds it. Blocks while it loads.
    ///
    /// # Errors
    /// As [`Catalog::version`] and [`Catalog::section`]; [`ResidencyError::NoRoom`], before anything
    /// is loaded, if it does not fit beside the twins in use.
    pub fn open(&self, name: &str, number: Option<u64>) -> Result<Arc<Resident>, ResidencyError> {
        let version = self.catalog.version(name, number)?;
        let slot = self.slot(&version);
        let mut held = lock(&slot);
        let resident = match held.upgrade() {
            Some(resident) => resident,
            None => {
                // Let go first: never two twins in memory for one session's sake.
                *lock(&self.last) = None;
                Arc::new(self.load(version)?)
            }
        };
        *held = Arc::downgrade(&resident);
        *lock(&self.last) = Some(resident.clone());
        Ok(resident)
    }

    /// The slot of a version. Slots that nobody holds or loads are dropped, so that they do not
    /// pile up as versions come and go.
    fn slot(&self, version: &Version) -> Slot {
        let mut slots = lock(&self.slots);
        slots.retain(|_, slot| Arc::strong_count(slot) > 1 || lock(slot).strong_count() > 0);
        slots.entry((version.hash.clone(), version.number)).or_default().clone()
    }

    fn load(&self, version: Version) -> Result<Resident, ResidencyError> {
        let room = self.budget.take(&version.manifest)?;
        let load = |chunk: &ChunkEntry| {
            let sections = chunk.sections.par_iter();
            let loaded = sections.map(|s| self.catalog.section(&version, chunk, s).map(Arc::new));
            loaded.collect::<Result<Vec<_>, StoreError>>()
        };
        let sections = version.manifest.chunks.par_iter().map(load);
        let sections = sections.collect::<Result<_, StoreError>>()?;
        Ok(Resident { version, sections, _room: room })
    }
}

/// A panic elsewhere leaves nothing half-done behind these locks.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
