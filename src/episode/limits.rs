//! Limits of this package, with the arithmetic behind each.

use std::time::Duration;

/// Longest line of an episode's file after the second, in bytes: 256 actors of 200 bytes and 256
/// image hashes of 67 take 70 kB.
pub const LINE_BYTES: usize = 1 << 20;

/// Longest second line, in bytes, which is that of a scenario. The road under a map's lanes and the
/// outlines of the lanes near the route take about as much as the map's file, which may have as
/// much. A route with a keyframe every 0.5 m takes 80 bytes a point, 8 MB for 50 km.
pub const SCENARIO_LINE_BYTES: usize = 256 << 20;

/// Longest first line, in bytes. It holds the rig: overlays of 2^24 pixels of 4 bytes are 90 MB in
/// base64 if PNG cannot compress them.
pub const HEAD_BYTES: usize = 96 << 20;

/// Largest number of steps of an episode: a day at 10 Hz.
// 24 x 3600 x 10 = 864,000, and 2²⁰ = 1,048,576.
pub const STEPS: usize = 1 << 20;

/// A temporary file of an export that was not written to for this time belongs to a killed process.
/// An export writes once per second of the episode, and with images such a second takes minutes on
/// a slow machine.
pub const LEFTOVER_AGE: Duration = Duration::from_secs(3600);

/// Largest number of episodes of a list.
// With name and path, an entry takes about 200 bytes: 2 MB in all.
pub const LISTED: usize = 10_000;

/// The part of a line in which the fields are that a list shows, in bytes: they come first.
pub const HEAD_FIELDS_BYTES: u64 = 1 << 16;

/// How much of the end of a record is read for its last frame, in bytes; more if the first part has
/// none. A line has at most [`LINE_BYTES`], and those of one step have less than two.
pub const TAIL_BYTES: [u64; 2] = [1 << 16, 3 << 20];

/// How long a record without an end is kept after it was last written to, whatever limit it is
/// beyond. A session may be silent for its time-out, and then wait to be resumed: minutes, unless
/// an operator says otherwise.
pub const UNFINISHED_AGE: Duration = Duration::from_secs(24 * 3600);

/// How long every record is kept after it was last written to: its export begins at once, and takes
/// seconds.
pub const FRESH_AGE: Duration = Duration::from_secs(60);
