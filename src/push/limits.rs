//! Limits and defaults of this package, with the arithmetic behind each.

use std::ops::RangeInclusive;
use std::time::Duration;

/// Default maximum of pushes that wait or run. A waiting push holds its request in memory, but not
/// its files.
pub const OPEN_PUSHES: usize = 16;

/// Bytes of memory that a push may use per byte of its files, in addition to [`MEMORY_BASE_BYTES`].
/// Compressed formats have 12 to 24 bytes per Gaussian, which take 68 to 248 in memory; joining
/// files and the preview make copies.
pub const MEMORY_PER_FILE_BYTE: u64 = 24;

/// Bytes of memory that the smallest push may take: a mesh becomes 400,000 Gaussians of 68 bytes,
/// and its textures are decoded.
pub const MEMORY_BASE_BYTES: u64 = 256 << 20;

/// Bytes of memory that running pushes are assigned at a time.
pub const MEMORY_UNIT_BYTES: u64 = 1 << 20;

/// Part of the memory for twins that running pushes may take in addition: a third, which with the
/// default for twins is a quarter of the machine's memory.
pub const MEMORY_SHARE_OF_TWINS: u64 = 3;

/// Default for how long reading and checking one push may take. 60 GB at 100 MB/s are 10 minutes.
pub const CHECK_TIMEOUT: Duration = Duration::from_secs(1800);

/// Bytes of memory that a push of files of `file_bytes` bytes may use.
pub fn push_memory_bytes(file_bytes: u64) -> u64 {
    // The sizes come from the disk, so the sum saturates; the queue then caps it at its limit.
    file_bytes.saturating_mul(MEMORY_PER_FILE_BYTE).saturating_add(MEMORY_BASE_BYTES)
}

/// Number of ended pushes whose status is kept. A report of 100,000 cells takes 3 MB, and most
/// reports have about a hundred cells.
pub const REMEMBERED_PUSHES: usize = 64;

/// Gaussians for the triangles of an actor's mesh, unless the request says otherwise: the smallest
/// number at which edges of a lorry at 8 m are at most a tenth wider than those of its triangles
/// (BENCHMARKS.md, "Actors"); `tests/actors/softness.py` measures it. It is one Gaussian every 18
/// mm, and as many as `wildcity import` takes.
pub const ACTOR_MESH_GAUSSIANS: u32 = 200_000;

/// Gaussians that may be asked for. With the most, small triangles add as many again, which is the
/// most of an actor.
pub const ACTOR_MESH_GAUSSIANS_RANGE: RangeInclusive<u32> = 1_000..=1_000_000;

/// Bytes of memory that an asset uses per requested Gaussian, in addition to [`push_memory_bytes`]
/// of its files. Small triangles make two of each; each is 68 B as it is read and 68 B in level 0,
/// the other levels are as much again, and all levels are encoded twice, at 68 B at most.
pub const MEMORY_PER_MESH_GAUSSIAN: u64 = 2 * 7 * 68;

/// Files of one push.
pub const PUSH_FILES: usize = 256;

/// Bytes of the name by which a scene names another file.
pub const FILE_NAME_BYTES: usize = 1024;

/// Gaussians of one push, all its files together: 248 B each in memory at SH degree 3 are 62 GB,
/// and as much again while files are joined. The largest upload holds no more, unless it is
/// compressed.
pub const PUSH_GAUSSIANS: u64 = 250_000_000;

/// Largest number of poses of one preview: 32 small images of the base version, and 32 of the new
/// one.
pub const PREVIEW_MAX_POSES: usize = 32;

/// Poses of a preview whose push names none, along the twin's trajectories.
pub const PREVIEW_DEFAULT_POSES: usize = 4;

/// Longest side of the images that are compared, in pixels.
pub const PREVIEW_SIDE_PX: u32 = 320;

/// Largest number of Gaussians of a push that gets a preview, and of the cells that it replaces.
/// Both are in memory as scenes in addition to the push itself: 92 B each at SH degree 1, 1.8 GB.
pub const PREVIEW_GAUSSIANS: u64 = 20_000_000;

/// Largest number of Gaussians in which the ground is searched: 236 B each at SH degree 3 are 240
/// MB, less than the smallest push may use.
pub const SURVEYED_GAUSSIANS: u64 = 1_000_000;

/// Characters of a push's note.
pub const NOTE_CHARS: usize = 1000;

/// A push that names no cells is refused if a cell would keep less than this share of its
/// Gaussians: the few Gaussians that the push has there are assumed to be strays from the margin of
/// a neighbouring cell.
pub const SHRUNK_SHARE: f64 = 0.1;
