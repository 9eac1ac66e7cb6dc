//! Limits of logs.

/// Longest line of a table, in bytes. A row has some hundred.
pub const LINE_BYTES: u64 = 64 << 10;

/// Largest `log.json` and `rig.json`, in bytes. Overlays of a rig are in the file.
pub const SETTINGS_BYTES: u64 = 64 << 20;

/// Largest `map.json`, in bytes: that of a map of a scenario.
pub const MAP_BYTES: u64 = wildcity_sim::limits::MAP_BYTES as u64;

/// Largest file of a sweep, in bytes. One of 128 rows has 5 MB.
pub const SWEEP_BYTES: u64 = 256 << 20;

/// Most poses of a log that are in memory at once: 28 hours at 100 Hz.
pub const POSES: usize = 10_000_000;

/// Most LiDARs of a log.
pub const LIDARS: usize = 16;

/// Largest time between two poses for a pose between them, in microseconds.
pub const LARGEST_GAP_US: i64 = 200_000;

/// Largest side of a box, in metres.
pub const BOX_M: f64 = 100.0;

/// Longest exposure of an image, in microseconds.
pub const EXPOSURE_US: i64 = 1_000_000;
