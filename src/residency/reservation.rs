//! A session's part of the memory.

use std::sync::{Arc, Mutex};

use crate::scene::RenderProfile;

use super::budget::Claim;
use super::cache::lock;
use super::pager::Urgency;
use super::{Eye, Needed, ResidencyError, Resident};

/// Memory that is set aside for the frames of one session, and what it expects to need next. Given
/// back when dropped.
#[derive(Debug)]
pub struct Reservation {
    resident: Arc<Resident>,
    claim: Claim,
    /// Number of its last prefetch.
    prefetch: Mutex<Option<u64>>,
}

impl Reservation {
    pub(super) fn new(resident: Arc<Resident>, bytes: u64) -> Result<Self, ResidencyError> {
        let claim = Claim {
            twin: resident.version.manifest.twin.clone(),
            version: resident.version.hash.clone(),
            bytes,
            whole_bytes: resident.whole_bytes(),
        };
        lock(&resident.shared.budget).take(&claim)?;
        Ok(Self { resident, claim, prefetch: Mutex::default() })
    }

    /// The version.
    pub fn resident(&self) -> &Arc<Resident> {
        &self.resident
    }

    /// What is set aside, in bytes.
    pub fn bytes(&self) -> u64 {
        self.claim.bytes
    }

    /// Loads what frames from other places will need, in the order of the places, as far as there is
    /// room; in place of what was expected before. Never waits.
    pub fn prefetch(&self, places: &[(Urgency, Vec<Eye>)], profile: &RenderProfile) {
        let (mut needed, mut urgencies): (Vec<Needed>, Vec<Urgency>) = Default::default();
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
        let mut prefetch = lock(&self.prefetch);
        *prefetch = Some(self.resident.shared.pager.prefetch(*prefetch, wanted, &urgencies));
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        if let Some(number) = lock(&self.prefetch).take() {
            self.resident.shared.pager.withdraw_prefetch(number);
        }
        lock(&self.resident.shared.budget).give_back(&self.claim);
    }
}
