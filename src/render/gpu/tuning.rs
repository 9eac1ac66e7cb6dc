//! Which kernels run on a device. No pixel depends on it.

use std::ops::RangeInclusive;

use wgpu::{AdapterInfo, DeviceType, Features, Limits};

use super::layout::RASTER_BATCH;

/// Thresholds between kernels that compute the same. Tests set them to run each kernel on every
/// device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tuning {
    /// Tiles with more splats than this are blended by a kernel of their own, with four times as
    /// many threads for a tile; with the largest number there are no such tiles.
    pub long_tile_splats: u32,
    /// The kernel that moves the keys of a sort.
    pub scatter: Scatter,
}

/// A kernel that moves the keys of a sort.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scatter {
    /// With workgroup memory only.
    Plain,
    /// With ballots of subgroups of 32 or 64 threads.
    Ballots,
    /// As `Ballots`, with subgroups that are emulated in workgroup memory: for tests.
    EmulatedBallots,
}

/// Threads of the kernel with ballots.
const BALLOT_THREADS: u32 = 512;
/// Sizes of subgroups with which it runs.
const BALLOT_SUBGROUPS: RangeInclusive<u32> = 32..=64;

impl Tuning {
    /// The fastest kernels of a device.
    pub(super) fn new(info: &AdapterInfo, features: Features, limits: &Limits) -> Self {
        // A software device takes as long for a thread of one pixel as for one of four.
        let is_software = info.device_type == DeviceType::Cpu;
        let mut tuning = Self {
            long_tile_splats: if is_software { u32::MAX } else { 16 * RASTER_BATCH },
            scatter: Scatter::Plain,
        };
        let sizes = info.subgroup_min_size..=info.subgroup_max_size;
        let has_ballots = features.contains(Features::SUBGROUP)
            && [sizes.start(), sizes.end()].iter().all(|size| BALLOT_SUBGROUPS.contains(size))
            && limits.max_compute_invocations_per_workgroup >= BALLOT_THREADS;
        if has_ballots && !is_software {
            tuning.scatter = Scatter::Ballots;
        }
        tuning
    }

    /// Whether there may be tiles with long lists.
    pub(super) fn has_long_tiles(self) -> bool {
        self.long_tile_splats < u32::MAX
    }
}
