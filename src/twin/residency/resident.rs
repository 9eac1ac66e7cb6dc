//! An open version of a twin, and the frames that wait for its sections.

use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use crate::limits;
use crate::store::Version;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_scene::{Manifest, RenderProfile, Sky};

use super::budget::Budget;
use super::demand::{SectionRef, SelectedSections, Viewpoint};
use super::pager::{Pager, WaitingFrame};
use super::requests::RequestedSections;
use super::table::{Key, SlotId};
use super::worst_case::worst_case_bytes;
use super::{BlockIndex, PinnedScene, ResidencyError, RigExtent, SceneCallback, Stats};

/// The state that all open versions share.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) pager: Pager,
    pub(super) budget: Mutex<Budget>,
}

/// A version of a twin, ready to be rendered. Sections are loaded when frames request them.
#[derive(Debug)]
pub struct Resident {
    pub version: Arc<Version>,
    /// The sky behind its Gaussians, baked to its profile's `sky_error`.
    sky: Option<Arc<Sky>>,
    pub(super) shared: Arc<Shared>,
    index: BlockIndex,
    /// Slots in the pager's table, chunk by chunk, section by section.
    ids: Vec<SlotId>,
    /// Start of each chunk in `ids`.
    first: Vec<usize>,
    /// Bytes of all levels of the whole version, and of its sky.
    total_bytes: u64,
    /// The most that a frame needs, for the last few rigs and profiles: the search takes a while.
    worst_cases: Mutex<Vec<(WorstCaseKey, u64)>>,
}

/// The inputs of the worst case: the rig, and the two values of a profile that decide how much is
/// drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
struct WorstCaseKey {
    extent: RigExtent,
    tau_px: f64,
    reach_m: Option<f64>,
}

/// A frame that waits for its sections. Dropping it cancels the request.
#[derive(Debug)]
pub struct SceneRequest {
    /// Dropped first: as long as the frame waits, the queue names sections by slots that `resident`
    /// keeps.
    waiting: WaitingFrame,
    resident: Arc<Resident>,
    sections: usize,
    requested: Instant,
}

impl Shared {
    pub(super) fn stats(&self) -> Stats {
        let reserved_bytes = self.budget.lock().reserved_bytes();
        Stats { reserved_bytes, ..self.pager.stats() }
    }
}

impl Resident {
    pub(super) fn new(version: Version, sky: Option<Arc<Sky>>, shared: Arc<Shared>) -> Self {
        let manifest = &version.manifest;
        let mut keys = Vec::new();
        let mut first = Vec::with_capacity(manifest.chunks.len());
        for chunk in &manifest.chunks {
            // Sections are numbered through all chunks: section s of chunk c is number `first[c] +
            // s`.
            first.push(keys.len());
            keys.extend(chunk.sections.iter().map(|section| {
                // The size in memory, not in the file: the table counts what a loaded section will
                // take.
                let bytes = chunk.needed_bytes(manifest.sh_degree, section);
                (key(manifest, chunk, section), bytes)
            }));
        }
        let sky_bytes = sky.as_ref().map_or(0, |sky| sky.bytes() as u64);
        let total_bytes = sky_bytes + keys.iter().map(|(_, bytes)| bytes).sum::<u64>();
        // Under one lock of the pager: a version may have two million sections.
        let ids = shared.pager.with_table(|table| {
            keys.into_iter().map(|(key, bytes)| table.register(key, bytes)).collect()
        });
        let index = BlockIndex::new(manifest);
        Self {
            version: Arc::new(version),
            sky,
            shared,
            index,
            ids,
            first,
            total_bytes,
            worst_cases: Mutex::default(),
        }
    }

    /// The sections that views of these cameras draw, of all of them together. `profile` is the
    /// version's, unless the caller overrides it.
    pub fn demand(&self, viewpoints: &[Viewpoint], profile: &RenderProfile) -> Vec<SectionRef> {
        self.index.demand(&self.version.manifest, viewpoints, profile)
    }

    /// Requests everything that a frame needs. `callback` is called once everything is in memory:
    /// from a loader thread, or from this thread before the function returns if everything is in
    /// memory already. Until then the frame holds no memory.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`] if the frame can never fit into memory, or
    /// [`ResidencyError::Views`].
    pub fn request(
        self: &Arc<Self>,
        viewpoints: &[Viewpoint],
        profile: &RenderProfile,
        callback: SceneCallback,
    ) -> Result<SceneRequest, ResidencyError> {
        let selected = self.index.select(&self.version.manifest, viewpoints, profile)?;
        let requested_sections = self.requested(selected);
        let sections = requested_sections.sections.len();
        let requested = Instant::now();
        let waiting = self.shared.pager.request_frame(requested_sections, callback)?;
        Ok(SceneRequest { waiting, resident: self.clone(), sections, requested })
    }

    /// Everything that a frame of these cameras draws, in memory. Blocks until it is.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`] or [`ResidencyError::Views`], or [`ResidencyError::Load`] if a
    /// section cannot be read.
    pub fn scene(
        self: &Arc<Self>,
        viewpoints: &[Viewpoint],
        profile: &RenderProfile,
    ) -> Result<PinnedScene, ResidencyError> {
        let (sender, receiver) = sync_channel(1);
        let callback: SceneCallback = Box::new(move |pinned| {
            // Sending fails only if this call has returned.
            let _ = sender.send(pinned);
        });
        let request = self.request(viewpoints, profile, callback)?;
        // The sender is dropped without an answer only if the pager has crashed.
        receiver.recv().unwrap_or_else(|_| Err(request.timeout_error()))
    }

    /// The most that a frame of a rig anywhere in the twin needs, in bytes.
    pub fn worst_case_bytes(&self, extent: RigExtent) -> u64 {
        self.worst_case_bytes_with(extent, &self.version.manifest.profile)
    }

    /// As [`Resident::worst_case_bytes`], for frames that are drawn with a profile other than the
    /// version's.
    pub fn worst_case_bytes_with(&self, extent: RigExtent, profile: &RenderProfile) -> u64 {
        let key = WorstCaseKey { extent, tau_px: profile.tau_px, reach_m: profile.reach_m };
        let find = |cases: &[(WorstCaseKey, u64)]| {
            cases.iter().find(|(known, _)| *known == key).map(|&(_, bytes)| bytes)
        };
        let known = find(&self.worst_cases.lock());
        let bytes = known.unwrap_or_else(|| {
            // Searched without the lock: at worst, two threads search for the same.
            let bytes = worst_case_bytes(&self.index, &self.version.manifest, extent, profile);
            let mut cases = self.worst_cases.lock();
            cases.truncate(limits::REMEMBERED_WORST_CASES - 1);
            cases.insert(0, (key, bytes));
            bytes
        });
        // Added last, because the sky grows: each `sky_error` that a session asks for may add a
        // cube map.
        bytes + self.sky.as_ref().map_or(0, |sky| sky.bytes() as u64)
    }

    /// The sky behind its Gaussians.
    pub fn sky(&self) -> Option<&Arc<Sky>> {
        self.sky.as_ref()
    }

    /// Number of its blocks.
    pub fn blocks(&self) -> usize {
        self.index.blocks()
    }

    /// Memory that all levels of the whole version would take, in bytes.
    pub fn total_bytes(&self) -> u64 {
        self.total_bytes
    }

    /// Counts since the start, and what is in memory now, of all twins.
    pub fn stats(&self) -> Stats {
        self.shared.stats()
    }

    /// Bytes of memory that all twins use now, including sections that are being loaded, and bytes
    /// that they may use.
    pub fn memory(&self) -> (u64, u64) {
        self.shared.pager.memory()
    }

    /// 99th percentile of the duration of the last loads of all twins.
    pub fn load_p99(&self) -> Duration {
        self.shared.pager.load_times().quantile(0.99)
    }

    /// Number of its sections.
    pub(super) fn sections(&self) -> usize {
        self.ids.len()
    }

    /// Which of all sections it is, chunk by chunk.
    pub(super) fn position(&self, section: SectionRef) -> usize {
        self.first[section.chunk] + section.section
    }

    pub(super) fn requested(&self, selected: SelectedSections) -> RequestedSections {
        let SelectedSections { sections, selection } = selected;
        let id = |&section: &SectionRef| self.ids[self.position(section)];
        RequestedSections {
            version: self.version.clone(),
            sky: self.sky.clone(),
            ids: sections.iter().map(id).collect(),
            sections,
            selection,
        }
    }
}

impl Drop for Resident {
    fn drop(&mut self) {
        // Sections in memory stay. Frames that still wait own an `Arc` of this, so that their slots
        // are registered.
        self.shared.pager.with_table(|table| self.ids.iter().for_each(|&id| table.unregister(id)));
    }
}

impl SceneRequest {
    /// The error of a frame that did not become complete by its deadline.
    pub fn timeout_error(&self) -> ResidencyError {
        ResidencyError::TimedOut {
            twin: self.resident.version.manifest.twin.clone(),
            missing: self.waiting.missing(),
            needed: self.sections,
            waited: self.requested.elapsed(),
        }
    }
}

/// A hash of everything that the chunk of a section depends on.
fn key(manifest: &Manifest, chunk: &ChunkEntry, section: &Section) -> Key {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&section.hash);
    for coordinate in chunk.cell {
        hasher.update(&coordinate.to_le_bytes());
    }
    for m in chunk.origin_m.to_array() {
        hasher.update(&m.to_le_bytes());
    }
    hasher.update(&section.count.to_le_bytes());
    hasher.update(&[section.block, section.level, manifest.sh_degree, manifest.record as u8]);
    // The bytes of a section do not say whether they end with classes.
    hasher.update(&[u8::from(chunk.classes)]);
    // 128 bits: with 10^9 sections a collision has a probability of about 10^-21.
    let mut key = [0; 16];
    key.copy_from_slice(&hasher.finalize().as_bytes()[..16]);
    Key(key)
}
