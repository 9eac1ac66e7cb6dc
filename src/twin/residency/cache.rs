//! The twins that are open, and the memory that they share.

use std::collections::BTreeMap;
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use crate::store::{Catalog, StoreError, TwinListing, Version};
use wildcity_scene::manifest::{ChunkEntry, Section, SkyRef};
use wildcity_scene::{Chunk, Manifest, RenderProfile, Sky};

use super::budget::{Budget, default_bytes};
use super::pager::{Pager, WaitingFrame};
use super::requests::{RequestedSections, SceneCallback};
use super::reservation::Reservation;
use super::table::{Key, SlotId};
use super::worst_case::{RigExtent, worst_case_bytes};
use super::{BlockIndex, PinnedScene, ResidencyError, SectionRef, SectionSource, Stats, Viewpoint};

/// Opens versions of twins, and shares the memory for what their frames need.
#[derive(Debug)]
pub struct Cache {
    catalog: Catalog,
    shared: Arc<Shared>,
    /// By manifest hash and number: a rollback gives an old manifest a new number. The inner lock is
    /// held while opening, so that others wait for the result rather than read again.
    slots: Mutex<BTreeMap<(String, u64), Slot>>,
    /// The skies of the versions that are open, by what they are and how finely they are baked.
    skies: Mutex<Vec<(SkyKey, Weak<Sky>)>>,
    /// The version that was opened last stays for the next session: its table has megabytes.
    last: Mutex<Option<Arc<Resident>>>,
}

type Slot = Arc<Mutex<Weak<Resident>>>;

/// A sky, and the error that it is baked for.
type SkyKey = (SkyRef, f64);

/// What all versions share.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) pager: Pager,
    pub(super) budget: Mutex<Budget>,
}

/// A version of a twin, ready to be rendered. What its frames need comes into memory as they ask.
#[derive(Debug)]
pub struct Resident {
    /// The version.
    pub version: Arc<Version>,
    /// What is behind its Gaussians, baked as its profile asks.
    sky: Option<Arc<Sky>>,
    pub(super) shared: Arc<Shared>,
    index: BlockIndex,
    /// Names in the pager's table, chunk after chunk, section after section.
    ids: Vec<SlotId>,
    /// Where each chunk begins in `ids`.
    first: Vec<usize>,
    /// All levels of all of it, in bytes.
    total_bytes: u64,
    /// The most that a frame needs, by lens: looking for it takes a while.
    worst: Mutex<Vec<(WorstCaseKey, u64)>>,
}

/// A frame that waits for what it needs. Dropped, it waits no more.
#[derive(Debug)]
pub struct SceneRequest {
    /// Dropped first: as long as it waits, the queue names sections by ids that `resident` keeps.
    waiting: WaitingFrame,
    resident: Arc<Resident>,
    needed: usize,
    asked: Instant,
}

/// A lens, and the tau_px and reach_m that it is drawn with.
type WorstCaseKey = (RigExtent, f64, Option<f64>);

impl Cache {
    /// Nothing in memory yet, and room for three quarters of the machine's memory.
    pub fn new(catalog: Catalog) -> Self {
        Self::limited(catalog, None)
    }

    /// The same with room for so many bytes of twins, if it is said.
    pub fn limited(catalog: Catalog, limit_bytes: Option<u64>) -> Self {
        let source = Arc::new(catalog.clone());
        Self::with_source(catalog, source, limit_bytes)
    }

    /// The same with sections that come from somewhere else.
    pub fn with_source(
        catalog: Catalog,
        source: Arc<dyn SectionSource>,
        limit_bytes: Option<u64>,
    ) -> Self {
        let limit_bytes = limit_bytes.unwrap_or_else(default_bytes);
        let pager = Pager::new(source, limit_bytes);
        let shared = Arc::new(Shared { pager, budget: Mutex::new(Budget::new(limit_bytes)) });
        let (slots, skies, last) = Default::default();
        Self { catalog, shared, slots, skies, last }
    }

    /// The twins that can be opened.
    ///
    /// # Errors
    /// As [`Catalog::twins`].
    pub fn twins(&self) -> Result<Vec<TwinListing>, StoreError> {
        self.catalog.twins()
    }

    /// Where the twins are.
    pub fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// One version of a twin, or the latest. Reads its table, if nobody has it open; blocks meanwhile.
    ///
    /// # Errors
    /// As [`Catalog::version`]; [`ResidencyError::Thread`] the first time.
    pub fn open(&self, name: &str, number: Option<u64>) -> Result<Arc<Resident>, ResidencyError> {
        self.shared.pager.start()?;
        let version = self.catalog.version(name, number)?;
        let slot = self.slot(&version);
        let mut held = lock(&slot);
        let resident = match held.upgrade() {
            Some(resident) => resident,
            None => {
                let sky = self.sky(&version)?;
                Arc::new(Resident::new(version, sky, self.shared.clone()))
            }
        };
        *held = Arc::downgrade(&resident);
        *lock(&self.last) = Some(resident.clone());
        Ok(resident)
    }

    /// What was done so far, and what is held now.
    pub fn stats(&self) -> Stats {
        self.shared.stats()
    }

    /// The sky of a version, baked as its profile asks; shared by all versions that look at it alike.
    fn sky(&self, version: &Version) -> Result<Option<Arc<Sky>>, ResidencyError> {
        let Manifest { sky: Some(named), profile, twin, .. } = &version.manifest else {
            return Ok(None);
        };
        let key = (named.clone(), profile.sky_error);
        let mut skies = lock(&self.skies);
        skies.retain(|(_, sky)| sky.strong_count() > 0);
        let known = skies.iter().find(|(known, _)| *known == key);
        if let Some(sky) = known.and_then(|(_, sky)| sky.upgrade()) {
            return Ok(Some(sky));
        }
        let Some(sky) = self.catalog.sky(version)? else { return Ok(None) };
        let baked = sky.drawn(profile.sky_error);
        baked.map_err(|cause| ResidencyError::Sky { twin: twin.clone(), cause })?;
        let sky = Arc::new(sky);
        skies.push((key, Arc::downgrade(&sky)));
        Ok(Some(sky))
    }

    /// The slot of a version. Slots that nobody holds or opens are dropped, so that they do not
    /// pile up as versions come and go.
    fn slot(&self, version: &Version) -> Slot {
        let mut slots = lock(&self.slots);
        slots.retain(|_, slot| Arc::strong_count(slot) > 1 || lock(slot).strong_count() > 0);
        slots.entry((version.hash.clone(), version.number)).or_default().clone()
    }
}

impl Shared {
    fn stats(&self) -> Stats {
        let reserved_bytes = lock(&self.budget).reserved_bytes();
        Stats { reserved_bytes, ..self.pager.stats() }
    }
}

impl Resident {
    fn new(version: Version, sky: Option<Arc<Sky>>, shared: Arc<Shared>) -> Self {
        let manifest = &version.manifest;
        let (mut keys, mut first) = (Vec::new(), Vec::with_capacity(manifest.chunks.len()));
        for chunk in &manifest.chunks {
            first.push(keys.len());
            keys.extend(chunk.sections.iter().map(|section| {
                let bytes = Chunk::bytes_of(manifest.sh_degree, section.count.into());
                (key(manifest, chunk, section), bytes)
            }));
        }
        let sky_bytes = sky.as_ref().map_or(0, |sky| sky.bytes() as u64);
        let total_bytes = sky_bytes + keys.iter().map(|(_, bytes)| bytes).sum::<u64>();
        let ids = shared.pager.with_table(|table| {
            keys.into_iter().map(|(key, bytes)| table.register(key, bytes)).collect()
        });
        let index = BlockIndex::new(manifest);
        let (version, worst) = (Arc::new(version), Mutex::default());
        Self { version, sky, shared, index, ids, first, total_bytes, worst }
    }

    /// What a frame of these cameras draws; `profile` is the version's unless somebody knows better.
    pub fn demand(&self, eyes: &[Viewpoint], profile: &RenderProfile) -> Vec<SectionRef> {
        self.index.demand(&self.version.manifest, eyes, profile)
    }

    /// Tells `done` as soon as everything that a frame needs is in memory, from another thread or
    /// from this one: at once if it is. Until then the frame holds nothing.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`] if it can never be.
    pub fn request(
        self: &Arc<Self>,
        eyes: &[Viewpoint],
        profile: &RenderProfile,
        done: SceneCallback,
    ) -> Result<SceneRequest, ResidencyError> {
        let wanted = self.wanted(self.demand(eyes, profile));
        let (needed, asked) = (wanted.needed.len(), Instant::now());
        let waiting = self.shared.pager.request_frame(wanted, done)?;
        Ok(SceneRequest { waiting, resident: self.clone(), needed, asked })
    }

    /// What a frame of these cameras draws, all of it in memory. Blocks until it is.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`], or [`ResidencyError::Load`] if something cannot be read.
    pub fn scene(
        self: &Arc<Self>,
        eyes: &[Viewpoint],
        profile: &RenderProfile,
    ) -> Result<PinnedScene, ResidencyError> {
        let (tell, told) = sync_channel(1);
        let done: SceneCallback = Box::new(move |pinned| {
            // Nobody listens any more only if this very call has ended.
            let _ = tell.send(pinned);
        });
        let request = self.request(eyes, profile, done)?;
        told.recv().unwrap_or_else(|_| Err(request.timeout_error()))
    }

    /// Sets aside the most that a frame of a rig anywhere in the twin needs.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers.
    pub fn reserve(self: &Arc<Self>, lens: RigExtent) -> Result<Reservation, ResidencyError> {
        self.reserve_with(lens, &self.version.manifest.profile)
    }

    /// The same for frames that are drawn with another profile than the version's.
    ///
    /// # Errors
    /// As [`Resident::reserve`].
    pub fn reserve_with(
        self: &Arc<Self>,
        lens: RigExtent,
        profile: &RenderProfile,
    ) -> Result<Reservation, ResidencyError> {
        Reservation::new(self.clone(), self.worst_case_bytes_with(lens, profile))
    }

    /// The most that a frame of a rig anywhere in the twin needs, in bytes.
    pub fn worst_case_bytes(&self, lens: RigExtent) -> u64 {
        self.worst_case_bytes_with(lens, &self.version.manifest.profile)
    }

    /// The same of frames that are drawn with another profile than the version's.
    pub fn worst_case_bytes_with(&self, lens: RigExtent, profile: &RenderProfile) -> u64 {
        // What of a profile decides how much is drawn.
        let looks = (lens, profile.tau_px, profile.reach_m);
        let known =
            lock(&self.worst).iter().find(|(known, _)| *known == looks).map(|known| known.1);
        let bytes = known.unwrap_or_else(|| {
            let bytes = worst_case_bytes(&self.index, &self.version.manifest, lens, profile);
            let mut worst = lock(&self.worst);
            worst.truncate(crate::limits::REMEMBERED_LENSES - 1);
            worst.insert(0, (looks, bytes));
            bytes
        });
        // Every other `sky_error` that somebody asks for may add a map.
        bytes + self.sky.as_ref().map_or(0, |sky| sky.bytes() as u64)
    }

    /// What is behind its Gaussians.
    pub fn sky(&self) -> Option<&Arc<Sky>> {
        self.sky.as_ref()
    }

    /// Memory that all levels of all of it would take, in bytes.
    pub fn total_bytes(&self) -> u64 {
        self.total_bytes
    }

    /// What was done for all twins so far, and what is held now.
    pub fn stats(&self) -> Stats {
        self.shared.stats()
    }

    /// Bytes of memory that twins take now, what is being loaded included, and bytes there are.
    pub fn memory(&self) -> (u64, u64) {
        self.shared.pager.memory()
    }

    /// What all but one of a hundred of the last loads took, of all twins.
    pub fn load_p99(&self) -> Duration {
        self.shared.pager.load_times().quantile(0.99)
    }

    pub(super) fn wanted(&self, needed: Vec<SectionRef>) -> RequestedSections {
        let ids = needed.iter().map(|n| self.ids[self.first[n.chunk] + n.section]).collect();
        RequestedSections { version: self.version.clone(), sky: self.sky.clone(), needed, ids }
    }
}

impl Drop for Resident {
    fn drop(&mut self) {
        self.shared.pager.with_table(|table| self.ids.iter().for_each(|&id| table.unregister(id)));
    }
}

impl SceneRequest {
    /// Why there is no frame, now that its time is up.
    pub fn timeout_error(&self) -> ResidencyError {
        ResidencyError::TimedOut {
            twin: self.resident.version.manifest.twin.clone(),
            missing: self.waiting.missing(),
            needed: self.needed,
            waited: self.asked.elapsed(),
        }
    }
}

/// What the chunk of a section is a function of.
fn key(manifest: &Manifest, chunk: &ChunkEntry, section: &Section) -> Key {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&section.hash);
    chunk.cell.iter().for_each(|cell| {
        hasher.update(&cell.to_le_bytes());
    });
    chunk.origin_m.to_array().iter().for_each(|m| {
        hasher.update(&m.to_le_bytes());
    });
    hasher.update(&section.count.to_le_bytes());
    hasher.update(&[section.block, section.level, manifest.sh_degree, manifest.record as u8]);
    let mut key = [0; 16];
    key.copy_from_slice(&hasher.finalize().as_bytes()[..16]);
    Key(key)
}

/// A panic elsewhere leaves nothing half-done behind these locks.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
