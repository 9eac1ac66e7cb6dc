//! Limits and defaults of this package, with the arithmetic behind each.

use std::time::Duration;

/// Most render threads: above any machine's cores, below what exhausts a machine's processes.
pub const RENDER_THREADS: usize = 1024;

/// Frames that a GPU holds at once: one is computed, and the next one is ready in its queue, so
/// that it need not wait for the host. A third would only wait longer.
pub const GPU_FRAMES_ON_DEVICE: usize = 2;

/// Most frames that are in flight with a GPU at once. Each holds its images, 27 MB for six full
/// cameras, and those of its render thread.
pub const GPU_FRAMES_MAX: usize = 16;

/// Number of frames in flight with a GPU for this number of threads that encode: two on the device,
/// and one that is encoded for every two threads. Six JPEGs keep about five threads busy at first,
/// and one in the end.
pub fn gpu_frames(threads: usize) -> usize {
    (GPU_FRAMES_ON_DEVICE + threads.div_ceil(2)).min(GPU_FRAMES_MAX)
}

/// How long the callbacks of mapped buffers may take to be called once the device has finished:
/// another thread calls them at once, unless the system does not let it run.
pub const MAP_CALLBACK: Duration = Duration::from_secs(10);

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
