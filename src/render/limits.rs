//! Limits and defaults of this package, with the arithmetic behind each.

/// Most render threads: above any machine's cores, below what exhausts a machine's processes.
pub const RENDER_THREADS: usize = 1024;

/// Frames that are in flight on a GPU at once: one is drawn, one is encoded, and one is ready to be drawn as
/// soon as the first is done. Encoding six JPEGs takes longer than a fast GPU needs to draw the images. Each
/// frame holds its images, 27 MB for six full cameras.
pub const GPU_FRAMES: usize = 3;

/// Number of frames, among those that did not fit a GPU at once, whose regions are remembered: a few kB in all,
/// for more rigs than are used at the same time.
pub const PARTITION_CACHE_ENTRIES: usize = 64;

/// Smallest limit of a binding that the gpu backend supports: one cluster of SH degree 3 takes 34 kB.
pub const BINDING_BYTES_MIN: u64 = 64 << 10;

/// Most splats of the views that the cpu backend renders together, counted as all Gaussians of the visible
/// clusters. A splat takes about 66 B with its places in macro tiles: 280 MB if every Gaussian of these clusters were
/// visible, and half of that is usual. One view alone may have more.
pub const FRAME_SPLATS: usize = 4 << 20;
