//! Counters and gauges of the pager.

use std::time::Duration;

/// Counts since the start, and what is in memory now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    /// Sections that frames found in memory.
    pub hits: u64,
    /// Sections that frames had to wait for.
    pub misses: u64,
    /// Sections that were loaded.
    pub loads: u64,
    /// Loads that failed because the bytes differ from what was committed.
    pub failed_damaged: u64,
    /// Loads that failed because the bytes could not be read.
    pub failed_unreadable: u64,
    /// Loads that ended in a panic, which is a defect of the program.
    pub failed_crashed: u64,
    /// Loads that were tried again after a failure.
    pub retries: u64,
    /// Sections that were evicted to free memory for others.
    pub evictions: u64,
    /// Sections that were not prefetched because there was not enough memory.
    pub prefetches_dropped: u64,
    /// Sessions and their changes of version for which there was only memory to draw a frame
    /// camera by camera.
    pub by_camera: u64,
    /// Frames that had to wait for a section.
    pub waits: u64,
    /// Total time that those frames waited.
    pub wait_time: Duration,
    /// Frames that were not complete when their request was dropped, for example at their deadline.
    pub waits_given_up: u64,
    /// Bytes of memory in use, including sections that are being loaded.
    pub held_bytes: u64,
    /// Bytes of memory that twins may use.
    pub limit_bytes: u64,
    /// Bytes that are reserved for the worst frames of open sessions.
    pub reserved_bytes: u64,
    pub held_sections: u64,
    /// Median duration of the last loads.
    pub load_p50: Duration,
    /// 99th percentile of the duration of the last loads.
    pub load_p99: Duration,
}
