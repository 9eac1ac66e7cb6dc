//! The disk cache and the counts of twins in an object store, in every build.

use std::path::PathBuf;

/// Where parts of remote twins are cached on the local disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiskCacheSettings {
    /// The directory, created if need be. Several processes may share it.
    pub dir: PathBuf,
    /// The most that it may hold, in bytes.
    pub limit_bytes: u64,
}

/// Counts of requests to a store since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Requests; each attempt counts.
    pub requests: u64,
    /// Attempts after a request's first.
    pub retries: u64,
    /// Requests that failed after the last attempt. An object that does not exist is not a failure.
    pub failures: u64,
    /// Parts that were found in the disk cache.
    pub cache_hits: u64,
    /// Parts that were not.
    pub cache_misses: u64,
}
