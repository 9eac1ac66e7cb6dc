//! A session's share of the memory, and what it prefetches.

use std::sync::Arc;

use parking_lot::Mutex;

use wildcity_scene::RenderProfile;

use super::budget::{Budget, Claim, FrameBytes};
use super::demand::{SectionRef, SelectedSections, Viewpoint};
use super::requests::Urgency;
use super::{ResidencyError, Resident, RigExtent};

/// Memory that is reserved for the frames of one session, and the session's prefetcher. Dropping it
/// releases both.
#[derive(Debug)]
pub struct Reservation {
    claim: Claim,
    /// Whether the memory is only enough for one view of a frame at a time.
    is_by_view: bool,
    prefetcher: Arc<Prefetcher>,
}

/// The most memory that the scenes of frames of a rig anywhere in the twin need, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SceneBytes {
    /// Of all views of a frame at once.
    pub together: u64,
    /// Of one view at a time, if frames may be drawn so.
    pub by_view: Option<u64>,
}

/// Loads sections of a version before the frames that will need them. It is shared with the
/// background task that determines these sections. It ends with its [`Reservation`] even if that
/// task still runs.
#[derive(Debug)]
pub struct Prefetcher {
    resident: Arc<Resident>,
    state: Mutex<PrefetchState>,
}

#[derive(Debug)]
enum PrefetchState {
    /// Holds the number of the last prefetch request.
    Open(Option<u64>),
    Ended,
}

impl Resident {
    /// Reserves the most memory that a frame of a rig anywhere in the twin needs.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers.
    pub fn reserve(self: &Arc<Self>, extent: RigExtent) -> Result<Reservation, ResidencyError> {
        let profile = &self.version.manifest.profile;
        self.reserve_with(extent, profile, FrameBytes::default())
    }

    /// As [`Resident::reserve`], for frames that are drawn with a profile other than the version's,
    /// and with the memory that they take in addition to their scenes.
    ///
    /// # Errors
    /// As [`Resident::reserve`].
    pub fn reserve_with(
        self: &Arc<Self>,
        extent: RigExtent,
        profile: &RenderProfile,
        frame: FrameBytes,
    ) -> Result<Reservation, ResidencyError> {
        let together = self.worst_case_bytes_with(extent, profile);
        self.reserve_scenes(SceneBytes { together, by_view: None }, frame)
    }

    /// The memory for the scenes of a rig's frames. `may_split` tells whether they may be drawn
    /// view by view.
    pub fn scene_bytes(
        &self,
        extent: RigExtent,
        profile: &RenderProfile,
        may_split: bool,
    ) -> SceneBytes {
        let together = self.worst_case_bytes_with(extent, profile);
        let by_view = || self.worst_case_bytes_with(extent.one_view(), profile);
        SceneBytes { together, by_view: may_split.then(by_view) }
    }

    /// Reserves memory for frames: for all of their views at once if there is room, or else view by
    /// view.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers.
    pub fn reserve_scenes(
        self: &Arc<Self>,
        scenes: SceneBytes,
        frame: FrameBytes,
    ) -> Result<Reservation, ResidencyError> {
        let (claim, is_by_view) =
            scenes.admit(self, frame, |budget, claim| budget.reserve(claim))?;
        if is_by_view {
            self.shared.pager.count_by_camera();
        }
        Ok(Reservation { claim, is_by_view, prefetcher: Arc::new(Prefetcher::new(self.clone())) })
    }
}

impl SceneBytes {
    /// Changes the budget by the first claim that it accepts: for all views at once, or else view
    /// by view.
    fn admit(
        self,
        resident: &Resident,
        frame: FrameBytes,
        mut change: impl FnMut(&mut Budget, &Claim) -> Result<(), ResidencyError>,
    ) -> Result<(Claim, bool), ResidencyError> {
        // All views at once take less time, so that is tried first.
        let together = claim(resident, self.together, frame);
        let refused = change_budget(resident, |budget| change(budget, &together));
        // Another error than a lack of room would be the same view by view.
        let (Err(ResidencyError::NoRoom { .. }), Some(bytes)) = (&refused, self.by_view) else {
            return refused.map(|()| (together, false));
        };
        let by_view = claim(resident, bytes, frame);
        change_budget(resident, |budget| change(budget, &by_view))?;
        Ok((by_view, true))
    }
}

impl Reservation {
    /// Reserves memory for frames of another version in place of this one, in one step: both need
    /// not fit at the same time. Prefetching of the old version ends.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers; nothing has changed then.
    pub fn exchange(
        &mut self,
        resident: Arc<Resident>,
        scenes: SceneBytes,
        frame: FrameBytes,
    ) -> Result<(), ResidencyError> {
        let old = &self.claim;
        let exchange = |budget: &mut Budget, new: &Claim| budget.exchange(old, new);
        let (claim, is_by_view) = scenes.admit(&resident, frame, exchange)?;
        // Counts changes to this way of drawing: a session that draws so already is not counted
        // again.
        if is_by_view && !self.is_by_view {
            resident.shared.pager.count_by_camera();
        }
        // Loads for the old version would take memory that the budget has given to others.
        self.prefetcher.end();
        self.claim = claim;
        self.is_by_view = is_by_view;
        self.prefetcher = Arc::new(Prefetcher::new(resident));
        Ok(())
    }

    /// Most views that a frame may draw at a time: all, unless there was only room for one.
    pub fn views_at_once(&self) -> usize {
        if self.is_by_view { 1 } else { Viewpoint::MAX }
    }

    /// Whether the reserved memory is enough for frames with these needs.
    pub fn covers(&self, scenes: SceneBytes, frame: FrameBytes) -> bool {
        let FrameBytes { stages, beside, is_large, images } = self.claim.frame;
        // Each purpose by itself: memory of one is not lent to another.
        let frame_fits = frame.stages <= stages
            && frame.beside <= beside
            && (is_large || !frame.is_large)
            && frame.images <= images;
        // Each way of drawing is compared with its own needs. Frames that may not be split fit no
        // reservation for one view.
        let needed = if self.is_by_view { scenes.by_view } else { Some(scenes.together) };
        frame_fits && needed.is_some_and(|needed| needed <= self.claim.bytes)
    }

    /// The version.
    pub fn resident(&self) -> &Arc<Resident> {
        self.prefetcher.resident()
    }

    /// The reserved memory, in bytes.
    pub fn bytes(&self) -> u64 {
        self.claim.bytes.saturating_add(self.claim.frame.alone())
    }

    /// The part of it that is for scenes, in bytes.
    pub fn scene_bytes(&self) -> u64 {
        self.claim.bytes
    }

    /// The part of it that frames take in addition to their scenes.
    pub fn frame(&self) -> FrameBytes {
        self.claim.frame
    }

    /// The session's prefetcher.
    pub fn prefetcher(&self) -> &Arc<Prefetcher> {
        &self.prefetcher
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        // Before the memory is released: a prefetch of an ended session would load into it.
        self.prefetcher.end();
        change_budget(self.resident(), |budget| budget.release(&self.claim));
    }
}

impl Prefetcher {
    /// A prefetcher that has requested nothing yet.
    pub fn new(resident: Arc<Resident>) -> Self {
        Self { resident, state: Mutex::new(PrefetchState::Open(None)) }
    }

    /// The version.
    pub fn resident(&self) -> &Arc<Resident> {
        &self.resident
    }

    /// Loads what frames at other places will need, in the order of the places, as far as there is
    /// room. This replaces the previous prefetch. Returns without waiting for the loads.
    pub fn prefetch(&self, places: &[(Urgency, Vec<Viewpoint>)], profile: &RenderProfile) {
        let mut sections: Vec<SectionRef> = Vec::new();
        let mut urgencies: Vec<Urgency> = Vec::new();
        let mut seen = vec![false; self.resident.sections()];
        for (urgency, viewpoints) in places {
            for section in self.resident.demand(viewpoints, profile) {
                // A section is prefetched at the urgency of the first place that needs it, which is
                // the soonest.
                if !std::mem::replace(&mut seen[self.resident.position(section)], true) {
                    sections.push(section);
                    urgencies.push(*urgency);
                }
            }
        }
        // A prefetch draws nothing, so it need not know which view needs which section.
        let requested = self.resident.requested(SelectedSections { sections, selection: None });
        // The state is locked during the request, so that `end` cannot fall between the two and
        // leave a prefetch that is never cancelled.
        if let PrefetchState::Open(number) = &mut *self.state.lock() {
            let pager = &self.resident.shared.pager;
            *number = Some(pager.prefetch(*number, requested, &urgencies));
        }
    }

    /// Number of requested sections that may still be loaded: without those for which there was no
    /// room, or which cannot be read.
    pub fn pending(&self) -> usize {
        match *self.state.lock() {
            PrefetchState::Open(Some(number)) => self.resident.shared.pager.pending(number),
            PrefetchState::Open(None) | PrefetchState::Ended => 0,
        }
    }

    fn end(&self) {
        let before = std::mem::replace(&mut *self.state.lock(), PrefetchState::Ended);
        if let PrefetchState::Open(Some(number)) = before {
            self.resident.shared.pager.cancel_prefetch(number);
        }
    }
}

impl Drop for Prefetcher {
    fn drop(&mut self) {
        // Does nothing if the reservation has ended it before.
        self.end();
    }
}

/// Changes the budget. The memory of frames is taken from the sections at once.
fn change_budget<R>(resident: &Resident, change: impl FnOnce(&mut Budget) -> R) -> R {
    // The budget is locked until the table knows the frames' bytes: two changes at once would
    // otherwise set them in the wrong order.
    let mut budget = resident.shared.budget.lock();
    let changed = change(&mut budget);
    let bytes = budget.frame_bytes();
    resident.shared.pager.with_table(|table| table.set_frame_bytes(bytes));
    changed
}

fn claim(resident: &Resident, bytes: u64, frame: FrameBytes) -> Claim {
    Claim {
        twin: resident.version.manifest.twin.clone(),
        version: resident.version.hash.clone(),
        bytes,
        frame,
        total_bytes: resident.total_bytes(),
    }
}
