//! Limits of this package, with the arithmetic behind each.

use std::time::Duration;

/// Longest line of an episode's file after the first, in bytes: 256 actors of 200 bytes and 256
/// image hashes of 67 take 70 kB; the route of a scenario with a keyframe every 0.5 m takes 80
/// bytes a point, 8 MB for 50 km.
// 256 x 200 + 256 x 67 = 68 kB. 50 km / 0.5 m = 100,000 points, x 80 bytes = 8 MB: half of the
// limit.
pub const LINE_BYTES: usize = 16 << 20;

/// Longest first line, in bytes, as the session writes it: the overlays of a rig.
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
