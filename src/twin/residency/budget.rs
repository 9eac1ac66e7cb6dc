//! The memory that all twins may take together, and the share of it that each session has reserved.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;

use crate::limits;

use super::ResidencyError;

/// Bytes that are reserved for the worst frames of sessions, by version.
///
/// Sessions on one version share what they draw, so together they never need more than the whole
/// version takes. Their frames are rendered in turn, so that of what frames hold between the stages only the
/// largest counts; each has images of its own.
#[derive(Clone, Debug)]
pub(super) struct Budget {
    limit_bytes: u64,
    versions: BTreeMap<String, VersionClaims>,
    /// Number of claims by [`FrameBytes::stages`].
    stages: BTreeMap<u64, u64>,
    images_bytes: u64,
}

/// What the frames of a session take beside their scenes, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameBytes {
    /// What a frame holds while it is rendered. All sessions share it.
    pub stages: u64,
    /// The images that a session holds.
    pub images: u64,
}

impl FrameBytes {
    /// Both.
    pub fn sum(&self) -> u64 {
        self.stages.saturating_add(self.images)
    }
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
    /// Bytes that the scene of the frame needs at once.
    pub(super) bytes: u64,
    /// What the frame takes beside its scene.
    pub(super) frame: FrameBytes,
    /// Bytes that all levels of detail of the whole version take.
    pub(super) total_bytes: u64,
}

impl Budget {
    pub(super) fn new(limit_bytes: u64) -> Self {
        let versions = BTreeMap::new();
        Self { limit_bytes, versions, stages: BTreeMap::new(), images_bytes: 0 }
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
        let images_bytes = self.images_bytes.saturating_add(claim.frame.images);
        let of_frame = claim.frame.stages.max(self.stages_bytes())
            + images_bytes.min(limits::IMAGE_BYTES)
            - self.frame_bytes();
        let needed_bytes = (after.bytes() - before.bytes()).saturating_add(of_frame);
        if needed_bytes > self.limit_bytes.saturating_sub(held_bytes) {
            let twin = claim.twin.clone();
            let limit_bytes = self.limit_bytes;
            return Err(ResidencyError::NoRoom { twin, needed_bytes, held_bytes, limit_bytes });
        }
        self.versions.insert(claim.version.clone(), after);
        *self.stages.entry(claim.frame.stages).or_default() += 1;
        self.images_bytes += claim.frame.images;
        Ok(())
    }

    /// Reserves memory in place of an earlier claim. If the new claim is refused, the old one
    /// stays.
    ///
    /// # Errors
    /// As [`Budget::reserve`].
    pub(super) fn exchange(&mut self, old: &Claim, new: &Claim) -> Result<(), ResidencyError> {
        let before = self.clone();
        self.release(old);
        self.reserve(new).inspect_err(|_| *self = before)
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
        if let Some(claims) = self.stages.get_mut(&claim.frame.stages) {
            *claims -= 1;
            if *claims == 0 {
                self.stages.remove(&claim.frame.stages);
            }
        }
        self.images_bytes -= claim.frame.images;
    }

    /// Bytes that are reserved.
    pub(super) fn reserved_bytes(&self) -> u64 {
        self.versions.values().map(VersionClaims::bytes).sum::<u64>() + self.frame_bytes()
    }

    /// Bytes of these that frames take beside their scenes.
    pub(super) fn frame_bytes(&self) -> u64 {
        self.stages_bytes() + self.images_bytes.min(limits::IMAGE_BYTES)
    }

    fn stages_bytes(&self) -> u64 {
        self.stages.last_key_value().map_or(0, |(&bytes, _)| bytes)
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
