//! A session's part of the memory.

use std::sync::{Arc, Mutex};

use wildcity_scene::RenderProfile;

use super::budget::Claim;
use super::cache::lock;
use super::requests::Urgency;
use super::{ResidencyError, Resident, SectionRef, Viewpoint};

/// Memory that is set aside for the frames of one session, and what it expects to need next. Given
/// back when dropped.
#[derive(Debug)]
pub struct Reservation {
    claim: Claim,
    prefetcher: Arc<Prefetcher>,
}

/// What somebody expects to need of a version. Shared by whoever finds that out, which takes a
/// while; it ends with its [`Reservation`] nevertheless.
#[derive(Debug)]
pub struct Prefetcher {
    resident: Arc<Resident>,
    prefetch: Mutex<PrefetchState>,
}

#[derive(Debug)]
enum PrefetchState {
    /// Number of the last prefetch.
    Open(Option<u64>),
    /// Nothing is expected any more.
    Ended,
}

impl Reservation {
    pub(super) fn new(resident: Arc<Resident>, bytes: u64) -> Result<Self, ResidencyError> {
        let claim = claim(&resident, bytes);
        lock(&resident.shared.budget).reserve(&claim)?;
        Ok(Self { claim, prefetcher: Arc::new(Prefetcher::new(resident)) })
    }

    /// Sets `bytes` aside for another version in place of this one, at once: there need not be room
    /// for both. What was expected of the old version is expected no more.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers; nothing has changed then.
    pub fn exchange(&mut self, resident: Arc<Resident>, bytes: u64) -> Result<(), ResidencyError> {
        let claim = claim(&resident, bytes);
        lock(&resident.shared.budget).exchange(&self.claim, &claim)?;
        self.prefetcher.end();
        (self.claim, self.prefetcher) = (claim, Arc::new(Prefetcher::new(resident)));
        Ok(())
    }

    /// The version.
    pub fn resident(&self) -> &Arc<Resident> {
        self.prefetcher.resident()
    }

    /// What is set aside, in bytes.
    pub fn bytes(&self) -> u64 {
        self.claim.bytes
    }

    /// What its session expects to need next.
    pub fn prefetcher(&self) -> &Arc<Prefetcher> {
        &self.prefetcher
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.prefetcher.end();
        lock(&self.resident().shared.budget).release(&self.claim);
    }
}

impl Prefetcher {
    /// Nothing yet, of a version.
    pub fn new(resident: Arc<Resident>) -> Self {
        Self { resident, prefetch: Mutex::new(PrefetchState::Open(None)) }
    }

    /// The version.
    pub fn resident(&self) -> &Arc<Resident> {
        &self.resident
    }

    /// Loads what frames from other places will need, in the order of the places, as far as there is
    /// room; in place of what was expected before. Never waits for it.
    pub fn prefetch(&self, places: &[(Urgency, Vec<Viewpoint>)], profile: &RenderProfile) {
        let (mut needed, mut urgencies): (Vec<SectionRef>, Vec<Urgency>) = Default::default();
        let mut seen = std::collections::BTreeSet::new();
        for (urgency, eyes) in places {
            for one in self.resident.demand(eyes, profile) {
                if seen.insert(one) {
                    needed.push(one);
                    urgencies.push(*urgency);
                }
            }
        }
        let wanted = self.resident.wanted(needed);
        if let PrefetchState::Open(number) = &mut *lock(&self.prefetch) {
            let pager = &self.resident.shared.pager;
            *number = Some(pager.prefetch(*number, wanted, &urgencies));
        }
    }

    /// Sections that are expected and may still come: not those for which there was no room, or which
    /// cannot be read.
    pub fn pending(&self) -> usize {
        match *lock(&self.prefetch) {
            PrefetchState::Open(Some(number)) => self.resident.shared.pager.pending(number),
            PrefetchState::Open(None) | PrefetchState::Ended => 0,
        }
    }

    fn end(&self) {
        if let PrefetchState::Open(Some(number)) =
            std::mem::replace(&mut *lock(&self.prefetch), PrefetchState::Ended)
        {
            self.resident.shared.pager.cancel_prefetch(number);
        }
    }
}

impl Drop for Prefetcher {
    fn drop(&mut self) {
        self.end();
    }
}

fn claim(resident: &Resident, bytes: u64) -> Claim {
    Claim {
        twin: resident.version.manifest.twin.clone(),
        version: resident.version.hash.clone(),
        bytes,
        total_bytes: resident.total_bytes(),
    }
}
