//! Pixels of a row are computed together, so that the compiler makes SIMD instructions of them.

/// Pixels that are computed together.
pub(super) const LANES: usize = 16;
