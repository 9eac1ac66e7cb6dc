//! Limits and defaults of this package, with the arithmetic behind each.

/// Pushes that wait or run, unless the operator says otherwise. Each holds its request, and nothing
/// of its files.
pub const OPEN_PUSHES: usize = 16;

/// Ended pushes that keep their status: a report of 100,000 cells takes 3 MB, and most
/// reports have a hundred cells.
pub const REMEMBERED_PUSHES: usize = 64;

/// Files of one push.
pub const PUSH_FILES: usize = 256;

/// Gaussians of one push, all its files together: 248 B each in memory at SH degree 3 are 62 GB, and
/// as much again while files are joined. The largest upload holds no more, unless it is compressed.
pub const PUSH_GAUSSIANS: u64 = 250_000_000;

/// Poses of one preview: 32 small images before, and 32 after.
pub const PREVIEW_POSES: usize = 32;

/// Gaussians of a push that gets a preview. They are in memory as a scene beside the push itself: 92 B
/// each at SH degree 1, 1.8 GB.
pub const PREVIEW_GAUSSIANS: usize = 20_000_000;

/// Characters of a push's note.
pub const NOTE_CHARS: usize = 1000;

/// A push that names no cells is refused if it leaves less than this share of the Gaussians of a cell:
/// the few Gaussians that it has there are taken for stray ones of a neighbour's margin.
pub const SHRUNK_SHARE: f64 = 0.1;
