//! Limits and defaults of this package, with the arithmetic behind each.

/// The server that clients talk to unless told otherwise.
pub(super) const SERVER_URL: &str = "http://127.0.0.1:8080";

/// What is kept on disk of twins from elsewhere, in GiB, unless told otherwise: half of a log's 32 GB.
pub(super) const CACHE_GIB: u32 = 16;

/// Versions that garbage collection keeps, unless told otherwise: a day of hourly pushes, twice.
pub(super) const GC_KEEP: u32 = 50;

/// How long garbage stays, unless told otherwise: longer than any commit is in preparation.
pub(super) const GC_GRACE: &str = "24h";

/// Largest rig or trajectory file: what fits a manifest.
pub(super) const SETTINGS_FILE_BYTES: u64 = wildcity_twin::limits::MANIFEST_BYTES;

/// Largest profile file: nine fields of at most 40 B.
pub(super) const PROFILE_FILE_BYTES: u64 = 64 << 10;

/// Most stations of a report: with four offsets and six cameras, 1,536 windows of the reference.
pub(super) const REPORT_STATIONS: i64 = 64;

/// Largest window of a report, in pixels: with the most stations, 100 million pixels of 40 B.
pub(super) const REPORT_WINDOW_PX: i64 = 256;

/// Most Gaussians of a street of `wildcity bench gpu`: 200 B each while it is made.
pub(super) const BENCH_GAUSSIANS: i64 = 100_000_000;
