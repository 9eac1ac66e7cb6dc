//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// Most render threads: above any machine's cores, below what exhausts a machine's processes.
pub const RENDER_THREADS: usize = 1024;

/// Frames that are in flight on a GPU at once: one is drawn, one is encoded, and one is ready to be
/// drawn as soon as the first is done. Encoding six JPEGs takes longer than a fast GPU needs to
/// draw the images. Each frame holds its images, 27 MB for six full cameras.
pub const GPU_FRAMES: usize = 3;

/// Time for which a backend that is dropped waits for devices that have failed: dropping one takes
/// about 10 ms, unless its driver hangs.
pub const DISCARD: Duration = Duration::from_secs(2);

/// Number of frames, among those that did not fit a GPU at once, whose regions are remembered: a
/// few kB in all, for more rigs than are used at the same time.
pub const PARTITION_CACHE_ENTRIES: usize = 64;

/// Smallest limit of a binding that the gpu backend supports: one cluster of SH degree 3 takes 34
/// kB.
pub const BINDING_BYTES_MIN: u64 = 64 << 10;

/// Expected size of a Gaussian of a visible cluster in the intermediate buffers of the cpu backend,
/// in bytes: 48 of its splat, and for each of the 1.3 macro tiles that it touches 24 of a pair, 16
/// of keys and a list. This is twice the usual size, since half of these Gaussians are not visible.
pub const SPLAT_BYTES: u64 = 128;

/// Smallest size of a splat in these buffers, with one macro tile and one tile, in bytes.
pub const LEAST_SPLAT_BYTES: u64 = 92;

/// Most bytes of the cpu backend's intermediate buffers for a large frame: 4 million Gaussians of
/// visible clusters, as many as six full-size views of a street of 700,000 have. A small frame that
/// is rendered meanwhile gets a quarter.
pub const LANE_BYTES: u64 = 512 << 20;

/// Smallest limit of these buffers, in bytes: 32,000 Gaussians, so that each slab is worth the time
/// to find it.
pub const LANE_BYTES_MIN: u64 = 4 << 20;
