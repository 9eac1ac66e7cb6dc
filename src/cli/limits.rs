//! Limits and defaults of the command line, with the arithmetic behind each.

use std::time::Duration;

/// How long a program whose server has stopped waits for its tasks. The last of them may drop the
/// render queue, which waits for its frames; a GPU's driver crashes if the process exits meanwhile.
pub const SHUTDOWN_TIMEOUT: Duration =
    wildcity_session::limits::LAST_FRAME_TIMEOUT.saturating_add(Duration::from_secs(1));

/// Default URL of the server.
pub const SERVER_URL: &str = "http://127.0.0.1:8080";

/// Default size of the disk cache for twins from an object store, in GiB: half of the 32 GB of a
/// driving log.
pub const CACHE_GIB: u32 = 16;

/// Versions that garbage collection keeps by default: two days of hourly pushes.
pub const GC_KEEP: u32 = 50;

/// How long garbage is kept by default: longer than the preparation of any commit takes.
pub const GC_GRACE: &str = "24h";

/// Largest rig or trajectory file: as much as fits into a manifest.
pub const SETTINGS_FILE_BYTES: u64 = wildcity_twin::limits::MANIFEST_BYTES;

/// Largest profile file. A profile has twelve fields of about 40 B; the rest is room for white
/// space.
pub const PROFILE_FILE_BYTES: u64 = 64 << 10;

/// Largest number of stations of a report: with four offsets and six cameras, 1,536 windows of the
/// reference.
pub const REPORT_STATIONS: i64 = 64;

/// Largest window of a report, in pixels: with the most stations, 100 million pixels of 40 B.
pub const REPORT_WINDOW_PX: i64 = 256;
