//! The memory that all twins may take together, and the share of it that each session has reserved.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;

use crate::limits;

use super::ResidencyError;

/// Bytes that are reserved for the worst frames of sessions, by version.
///
/// Sessions on one version share its sections, so together they never need more than the whole
/// version takes. Frames are rendered one at a time, except that a small frame may be rendered
/// while a large one is. So the intermediate buffers count twice at most: the largest of all
/// frames, and the largest of the small frames. The images of every session count.
#[derive(Clone, Debug)]
pub(super) struct Budget {
    limit_bytes: u64,
    versions: BTreeMap<String, VersionClaims>,
    /// Number of claims by [`FrameBytes::stages`].
    stages: BTreeMap<u64, u64>,
    /// Number of claims by [`FrameBytes::beside`].
    beside: BTreeMap<u64, u64>,
    /// Number of claims of large frames.
    large: u64,
    images_bytes: u64,
}

/// Memory of a session's frames in addition to their scenes, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameBytes {
    /// Intermediate buffers of a frame while it is rendered. All sessions share them.
    pub stages: u64,
    /// Intermediate buffers of a small frame that is rendered while a large one is; 0 for large
    /// frames, which are never rendered while another large frame is.
    pub beside: u64,
    /// Whether it is a large frame, during which small ones are rendered.
    pub is_large: bool,
    /// The images that a session holds.
    pub images: u64,
}

impl FrameBytes {
    /// Memory of a session's frames if no other session renders.
    pub fn alone(&self) -> u64 {
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
    pub(super) version: String,
    /// Bytes that the scene of the frame needs at once.
    pub(super) bytes: u64,
    /// Memory of the frame in addition to its scene.
    pub(super) frame: FrameBytes,
    /// Bytes that all levels of detail of the whole version take.
    pub(super) total_bytes: u64,
}

impl Budget {
    pub(super) fn new(limit_bytes: u64) -> Self {
        Self {
            limit_bytes,
            versions: BTreeMap::new(),
            stages: BTreeMap::new(),
            beside: BTreeMap::new(),
            large: 0,
            images_bytes: 0,
        }
    }

    /// Reserves memory.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers.
    pub(super) fn reserve(&mut self, claim: &Claim) -> Result<(), ResidencyError> {
        let held_bytes = self.reserved_bytes();
        let mut after = self.clone();
        // Only a copy tells what the claim adds: bytes that are shared with other claims cost
        // nothing. The maps have an entry per open version and per size of frame, a few dozen.
        after.add(claim);
        let needed_bytes = after.reserved_bytes() - held_bytes;
        // Not `held + needed > limit`, which can overflow. The limit may be below what is held
        // already.
        if needed_bytes > self.limit_bytes.saturating_sub(held_bytes) {
            let twin = claim.twin.clone();
            let limit_bytes = self.limit_bytes;
            return Err(ResidencyError::NoRoom { twin, needed_bytes, held_bytes, limit_bytes });
        }
        *self = after;
        Ok(())
    }

    fn add(&mut self, claim: &Claim) {
        let unused = VersionClaims { sessions: 0, sum_bytes: 0, total_bytes: claim.total_bytes };
        let version = self.versions.entry(claim.version.clone()).or_insert(unused);
        version.sessions += 1;
        version.sum_bytes = version.sum_bytes.saturating_add(claim.bytes);
        let FrameBytes { stages, beside, is_large, images } = claim.frame;
        *self.stages.entry(stages).or_default() += 1;
        *self.beside.entry(beside).or_default() += 1;
        self.large += u64::from(is_large);
        self.images_bytes = self.images_bytes.saturating_add(images);
    }

    /// Reserves memory in place of an earlier claim. If the new claim is refused, the old one
    /// stays.
    ///
    /// # Errors
    /// As [`Budget::reserve`].
    pub(super) fn exchange(&mut self, old: &Claim, new: &Claim) -> Result<(), ResidencyError> {
        // The old claim goes first, because both need not fit at the same time. The copy undoes
        // that.
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
        remove_one(&mut self.stages, claim.frame.stages);
        remove_one(&mut self.beside, claim.frame.beside);
        self.large -= u64::from(claim.frame.is_large);
        self.images_bytes -= claim.frame.images;
    }

    /// Bytes that are reserved.
    pub(super) fn reserved_bytes(&self) -> u64 {
        self.versions.values().map(VersionClaims::bytes).sum::<u64>() + self.frame_bytes()
    }

    /// The part of these bytes that frames take in addition to their scenes.
    pub(super) fn frame_bytes(&self) -> u64 {
        // The server bounds the images of all answers together by the same number.
        self.stages_bytes() + self.images_bytes.min(limits::IMAGE_BYTES)
    }

    fn stages_bytes(&self) -> u64 {
        // The maps are ordered by bytes, so that the last key is the largest, and a removal finds
        // the next one. A single maximum could not be taken back.
        let most =
            |claims: &BTreeMap<u64, u64>| claims.last_key_value().map_or(0, |(&bytes, _)| bytes);
        // Without a large frame no two frames are rendered at once, so that nothing is beside
        // another.
        let beside = if self.large > 0 { most(&self.beside) } else { 0 };
        most(&self.stages).saturating_add(beside)
    }
}

/// Removes one of the claims of a number of bytes.
fn remove_one(claims: &mut BTreeMap<u64, u64>, bytes: u64) {
    if let Some(count) = claims.get_mut(&bytes) {
        *count -= 1;
        if *count == 0 {
            claims.remove(&bytes);
        }
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
    // MemTotal is the first line; 4 kB are more than enough for it.
    File::open("/proc/meminfo").ok()?.take(4096).read_to_string(&mut text).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    // The kernel's kB are 1024 bytes.
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib << 10)
}
