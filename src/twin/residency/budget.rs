//! How much memory twins may take together, and who has how much of it set aside.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;

use crate::limits;

use super::ResidencyError;

/// Bytes that are set aside for the worst frames of sessions, by version.
///
/// Sessions on one version share what they draw, so that together they never need more than all of
/// it.
#[derive(Debug)]
pub(super) struct Budget {
    limit_bytes: u64,
    versions: BTreeMap<String, VersionClaims>,
}

#[derive(Clone, Copy, Debug)]
struct VersionClaims {
    sessions: u64,
    sum_bytes: u64,
    total_bytes: u64,
}

/// The worst frame of a session.
#[derive(Clone, Debug)]
pub(super) struct Claim {
    /// The twin, for the error.
    pub(super) twin: String,
    /// The version's hash.
    pub(super) version: String,
    /// What it needs at once.
    pub(super) bytes: u64,
    /// What all of its version takes, in all levels of detail.
    pub(super) total_bytes: u64,
}

impl Budget {
    pub(super) fn new(limit_bytes: u64) -> Self {
        Self { limit_bytes, versions: BTreeMap::new() }
    }

    /// Sets memory aside.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers.
    pub(super) fn reserve(&mut self, claim: &Claim) -> Result<(), ResidencyError> {
        let Claim { twin, version, bytes, total_bytes } = claim;
        let held_bytes = self.reserved_bytes();
        let nobody = VersionClaims { sessions: 0, sum_bytes: 0, total_bytes: *total_bytes };
        let before = self.versions.get(version).copied().unwrap_or(nobody);
        let (sessions, sum_bytes) = (before.sessions + 1, before.sum_bytes.saturating_add(*bytes));
        let after = VersionClaims { sessions, sum_bytes, ..before };
        let needed_bytes = after.bytes() - before.bytes();
        if needed_bytes > self.limit_bytes.saturating_sub(held_bytes) {
            let (twin, limit_bytes) = (twin.clone(), self.limit_bytes);
            return Err(ResidencyError::NoRoom { twin, needed_bytes, held_bytes, limit_bytes });
        }
        self.versions.insert(version.clone(), after);
        Ok(())
    }

    /// Sets memory aside in place of what was taken before; if that is refused, nothing changes.
    ///
    /// # Errors
    /// As [`Budget::reserve`].
    pub(super) fn exchange(&mut self, old: &Claim, new: &Claim) -> Result<(), ResidencyError> {
        let before = self.versions.clone();
        self.release(old);
        self.reserve(new).inspect_err(|_| self.versions = before)
    }

    /// Gives back what [`Budget::reserve`] took.
    pub(super) fn release(&mut self, claim: &Claim) {
        if let Some(claims) = self.versions.get_mut(&claim.version) {
            claims.sessions -= 1;
            claims.sum_bytes -= claim.bytes;
            if claims.sessions == 0 {
                self.versions.remove(&claim.version);
            }
        }
    }

    /// Bytes that are set aside.
    pub(super) fn reserved_bytes(&self) -> u64 {
        self.versions.values().map(VersionClaims::bytes).sum()
    }
}

impl VersionClaims {
    fn bytes(&self) -> u64 {
        self.sum_bytes.min(self.total_bytes)
    }
}

/// Three quarters of the machine's memory.
pub(super) fn default_bytes() -> u64 {
    physical_bytes().map_or(limits::RESIDENT_BYTES, |physical| physical / 4 * 3)
}

/// Memory of the machine; none where /proc does not say.
fn physical_bytes() -> Option<u64> {
    let mut text = String::new();
    File::open("/proc/meminfo").ok()?.take(4096).read_to_string(&mut text).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib << 10)
}
