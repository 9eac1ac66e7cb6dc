//! One step of a drive.

use std::time::Duration;

/// One rendered pose: its time, and the activity of the cache of sections during this time.
#[derive(Clone, Copy, Debug)]
pub(super) struct DriveStep {
    /// Position along the trajectory, in metres.
    pub(super) station_m: f64,
    /// Time of the whole step.
    pub(super) step: Duration,
    /// Time in which the step waited for sections.
    pub(super) waited: Duration,
    /// Sections that were not in memory when the frame needed them.
    pub(super) misses: u64,
    /// Sections that were loaded.
    pub(super) loads: u64,
    /// Sections that were evicted.
    pub(super) evictions: u64,
    /// Memory of all sections after the step.
    pub(super) held_bytes: u64,
    /// Memory of the process after the step.
    pub(super) rss_bytes: u64,
}
