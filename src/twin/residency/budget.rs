//! The memory that all twins may take together, and the share of it that each session has reserved.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;

use crate::limits;

use super::ResidencyError;

/// Bytes that are reserved for the worst frames of sessions, by version.
///
/// Sessions on one version share what they draw, so together they never need more than the whole
/// version takes.
#[derive(Debug)]
pub(super) struct Budget {
    limit_bytes: u64,
    versions: BTreeMap<String, VersionClaims>,
}

/// The claims of all sessions on one version.
#[derive(Clone, Copy, Debug)]
struct VersionClaims {
    sessions: u64,
    sum_bytes: u64,
    total_bytes: u64,
}

/// The memory for the worst frame of one session.
#[derive(Clone, Debug)]
pub(super) struct Claim {
    /// The twin's name, for the error.
    pub(super) twin: String,
    /// The version's hash.
    pub(super) version: String,
    /// Bytes that the frame needs at once.
    pub(super) bytes: u64,
    /// Bytes that all levels of detail of the whole version take.
    pub(super) total_bytes: u64,
}

impl Budget {
    pub(super) fn new(limit_bytes: u64) -> Self {
        Self { limit_bytes, versions: BTreeMap::new() }
    }

    /// Reserves memory.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers.
    pub(super) fn reserve(&mut self, claim: &Claim) -> Result<(), ResidencyError> {
        let held_bytes = self.reserved_bytes();
        let unused = VersionClaims { sessions: 0, sum_bytes: 0, total_bytes: claim.total_bytes };
        let before = self.versions.get(&claim.version).copied().unwrap_or(unused);
        let after = VersionClaims {
            sessions: before.sessions + 1,
            sum_bytes: before.sum_bytes.saturating_add(claim.bytes),
            ..before
        };
        let needed_bytes = after.bytes() - before.bytes();
        if needed_bytes > self.limit_bytes.saturating_sub(held_bytes) {
            let twin = claim.twin.clone();
            let limit_bytes = self.limit_bytes;
            return Err(ResidencyError::NoRoom { twin, needed_bytes, held_bytes, limit_bytes });
        }
        self.versions.insert(claim.version.clone(), after);
        Ok(())
    }

    /// Reserves memory in place of an earlier claim. If the new claim is refused, the old one
    /// stays.
    ///
    /// # Errors
    /// As [`Budget::reserve`].
    pub(super) fn exchange(&mut self, old: &Claim, new: &Claim) -> Result<(), ResidencyError> {
        let before = self.versions.clone();
        self.release(old);
        self.reserve(new).inspect_err(|_| self.versions = before)
    }

    /// Returns what [`Budget::reserve`] reserved.
    pub(super) fn release(&mut self, claim: &Claim) {
        if let Some(claims) = self.versions.get_mut(&claim.version) {
            claims.sessions -= 1;
            claims.sum_bytes -= claim.bytes;
            if claims.sessions == 0 {
                self.versions.remove(&claim.version);
            }
        }
    }

    /// Bytes that are reserved.
    pub(super) fn reserved_bytes(&self) -> u64 {
        self.versions.values().map(VersionClaims::bytes).sum()
    }
}

impl VersionClaims {
    fn bytes(&self) -> u64 {
        self.sum_bytes.min(self.total_bytes)
    }
}

/// The memory that twins may take by default, in bytes: three quarters of the machine's memory.
pub fn default_memory_bytes() -> u64 {
    physical_bytes().map_or(limits::RESIDENT_BYTES, |physical| physical / 4 * 3)
}

/// Memory of the machine in bytes; `None` where /proc/meminfo does not say. By hand, because it is
/// shorter than the dependency on a crate for system information.
fn physical_bytes() -> Option<u64> {
    let mut text = String::new();
    File::open("/proc/meminfo").ok()?.take(4096).read_to_string(&mut text).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib << 10)
}
