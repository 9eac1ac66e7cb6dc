//! Constants that all tiled backends share.

/// Edge of a tile, in pixels. On a street a splat touches ten rows of a tile on average.
pub const TILE_PX: u32 = 16;

/// Edge of a block, in pixels. Its 4 x 4 pixels are the 16 lanes of a vector on the CPU, and four
/// threads with four pixels each on a GPU. A block fits a small splat more tightly than a row of 16
/// pixels does, which saves a third of the evaluations on a street.
pub const BLOCK_PX: u32 = 4;

/// Most (Gaussian, tile) pairs of a frame. On the gpu backend it is the most of each region of a
/// frame, and also the most (splat, macro tile) pairs. 2^27 pairs of 4 B are 512 MiB, five times
/// what 5 million visible Gaussians of a street take.
pub const MAX_INSTANCES: u64 = 1 << 27;

/// Margin that is added to a splat's extent when its tiles and blocks are chosen, in pixels. It
/// covers rounding: the f32 of a mean at 16,384 px is off by up to 1e-3 px. A tile that is chosen
/// needlessly changes no pixel, because alpha decides per pixel.
pub const EXTENT_SLACK_PX: f32 = 2e-3;

/// Distance beyond the image's edges up to which the projection is linearised at the centre itself,
/// in half-widths of the image. Farther out the slope is clamped (gsplat's `persp_proj`; the code
/// of Kerbl et al. 2023 has the same rule for a centred principal point).
pub const SLOPE_SLACK: f64 = 0.3;

/// Widest splat that is computed in units of pixels. The determinant of its covariance is of fourth
/// order in the width: 1e9 px give 1e36, and f32 ends at 3.4e38.
pub const MAX_SIGMA_PX: f32 = 1e9;

/// Bits of the depth key: exact f32 order of z from near up to 2^32 times near.
pub const DEPTH_BITS: u32 = 28;

/// Least share of the determinant before the blur by whose root opacity is scaled, in twins that
/// are antialiased: gsplat's 0.005².
pub const MIN_BLUR_SHARE: f64 = 0.005 * 0.005;
