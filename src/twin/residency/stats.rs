//! What the pager has done, in numbers.

use std::time::Duration;

/// Counts since the start, and what is held now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    /// Sections that frames found in memory.
    pub hits: u64,
    /// Sections that frames had to wait for.
    pub misses: u64,
    /// Sections that were loaded.
    pub loads: u64,
    /// Loads that failed because the bytes are not what was committed.
    pub failed_damaged: u64,
    /// Loads that failed because the bytes could not be read.
    pub failed_unreadable: u64,
    /// Loads that ended in a panic: a defect of the program.
    pub failed_crashed: u64,
    /// Loads that were tried again after a failure.
    pub retries: u64,
    /// Sections that made room for others.
    pub evictions: u64,
    /// Sections that were not prefetched for want of room.
    pub prefetches_dropped: u64,
    /// Frames that had to wait for a section.
    pub waits: u64,
    /// How long those waited, together.
    pub wait_time: Duration,
    /// Frames that were not complete by their deadline, or whose requester went away.
    pub waits_given_up: u64,
    /// Bytes of memory in use, what is being loaded included.
    pub held_bytes: u64,
    /// Bytes of memory there are.
    pub limit_bytes: u64,
    /// Bytes that are set aside for the worst frames of open sessions.
    pub reserved_bytes: u64,
    /// Sections in memory.
    pub held_sections: u64,
    /// Median time of the last loads.
    pub load_p50: Duration,
    /// 99th percentile of the time of the last loads.
    pub load_p99: Duration,
}
