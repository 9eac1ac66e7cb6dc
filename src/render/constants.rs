//! Numbers that every tiled backend shares.

/// Edge of a tile, in pixels: 256 pixels, of which a splat of a street covers ten rows.
pub const TILE_PX: u32 = 16;

/// Edge of a block, in pixels: 4 x 4 pixels are the 16 lanes of one vector, and a block fits a
/// small splat more tightly than a row of 16 pixels does (a third fewer evaluations on a street).
pub const BLOCK_PX: u32 = 4;

/// Most (Gaussian, tile) pairs of a frame; on the gpu backend of each part of a frame, and as many
/// (splat, macro tile) pairs. 2^27 of 4 B are 512 MiB, five times what 5 million visible Gaussians of a
/// street take.
pub const MAX_INSTANCES: u64 = 1 << 27;

/// How much wider than computed a splat's extent is taken when tiles and blocks are chosen, in
/// pixels. A mean at 16,384 px is rounded by 1e-3 px; what is chosen in vain contributes nothing,
/// since alpha decides per pixel.
pub const EXTENT_SLACK_PX: f32 = 2e-3;

/// How far beyond the image the projection is linearised at the centre itself, in half-widths.
/// Farther out the slope is clamped (gsplat's `persp_proj`; Kerbl et al. 2023's code has the same
/// rule for a centred principal point).
pub const SLOPE_SLACK: f64 = 0.3;

/// Widest splat that is computed in pixels. The determinant of its covariance is of fourth order:
/// 1e9 px give 1e36, and f32 ends at 3.4e38.
pub const MAX_SIGMA_PX: f32 = 1e9;

/// Bits of the depth key: exact f32 order of z from near up to 2^32 times near.
pub const DEPTH_BITS: u32 = 28;
