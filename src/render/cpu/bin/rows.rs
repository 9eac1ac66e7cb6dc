//! The tiles that a splat touches, row by row.

use crate::constants::{EXTENT_SLACK_PX, TILE_PX};
use crate::layout::Splat;

use super::grid::Grid;

/// The tiles that a splat's bounding box touches: first and last column, first and last row.
pub(super) struct TileBox {
    pub(super) left: u32,
    pub(super) right: u32,
    pub(super) top: u32,
    pub(super) bottom: u32,
}

impl TileBox {
    /// `None` if it touches no pixel's centre.
    #[inline(always)]
    pub(super) fn new(splat: &Splat, grid: &Grid) -> Option<Self> {
        let [x, y] = splat.mean_px;
        let [extent_x, extent_y] = splat.extent_px;
        let (left, right) = tiles(x, -extent_x, extent_x, grid.size_px[0])?;
        let (top, bottom) = tiles(y, -extent_y, extent_y, grid.size_px[1])?;
        Some(Self { left, right, top, bottom })
    }
}

/// Calls `visit` with the first and last tile of every row of tiles that the ellipse
/// `u² + v² <= power` touches, where `u = l0 dx + l1 dy` and `v = l2 dy` (see [`Splat`]) and power
/// is `log2(opacity) - log2(alpha_cut)`: row, first column, last column.
///
/// At the height dy the ellipse reaches to the right as far as
/// `x(dy) = s dy + √(power - (l2 dy)²)/l0`, with `s = -l1/l0`. This is concave in dy, and its
/// maximum over the whole ellipse lies at `dy* = s (power/l2²)/extent_x`. So its maximum over a
/// band of rows lies at dy*, or at the end of the band that is nearest to dy*. The left edge is the
/// mirror image. (Speedy-Splat, Hanson et al. 2025, finds the same set of tiles by following the
/// ellipse's bounds.)
#[inline(always)]
pub(super) fn for_each_row(
    splat: &Splat,
    area: &TileBox,
    grid: &Grid,
    log2_cut: f32,
    mut visit: impl FnMut(u32, u32, u32),
) {
    let TileBox { left, right, top, bottom } = *area;
    // A diagonal needle may cross a box of several rows and columns and touch few of its tiles.
    // In one row or one column of tiles the ellipse touches all tiles of its box.
    if left == right || top == bottom {
        for row in top..=bottom {
            visit(row, left, right);
        }
        return;
    }

    // Otherwise row by row, between the extremes of the left and right edge.
    let [x, y] = splat.mean_px;
    let [extent_x, extent_y] = splat.extent_px;
    let [l0, l1, l2] = splat.factor;
    let power = splat.log2_opacity - log2_cut;
    let inverse_l0 = 1.0 / l0;
    let skew = -l1 * inverse_l0;
    // dy* of the comment above: s power/(l2^2 extent_x).
    let widest_dy = skew * power / (l2 * l2 * extent_x);
    let half_width = |dy: f32| (power - (l2 * dy) * (l2 * dy)).max(0.0).sqrt() * inverse_l0;
    for row in top..=bottom {
        // The centres of the first and last pixel row of this row of tiles, within the ellipse.
        // `clamp` panics if its bounds are reversed, which rounding could do in the outermost rows.
        let band_top = ((row * TILE_PX) as f32 + 0.5 - y).max(-extent_y);
        let last_px = (row * TILE_PX + TILE_PX - 1) as f32;
        let band_bottom = (last_px + 0.5 - y).min(extent_y).max(band_top);
        let right_dy = widest_dy.clamp(band_top, band_bottom);
        let left_dy = (-widest_dy).clamp(band_top, band_bottom);
        let high = skew * right_dy + half_width(right_dy) + EXTENT_SLACK_PX;
        // The ellipse is symmetric about its centre: its left edge is widest at -dy*.
        let low = skew * left_dy - half_width(left_dy) - EXTENT_SLACK_PX;
        if let Some((first, last)) = tiles(x, low, high, grid.size_px[0]) {
            visit(row, first, last);
        }
    }
}

/// First and last tile of a row or column of `size_px` pixels with a pixel's centre, at +0.5,
/// between `center + low` and `center + high`; `None` if there is no such pixel.
#[inline(always)]
fn tiles(center: f32, low: f32, high: f32, size_px: u32) -> Option<(u32, u32)> {
    // A pixel k has its centre at k + 0.5: the first is the ceiling, the last the floor.
    let last_px = (size_px - 1) as f32;
    // Use comparisons and not `max` and `min`, which take additional instructions for a NaN.
    let from = (center + low - 0.5).ceil();
    let first = if from > 0.0 { from } else { 0.0 };
    let to = (center + high - 0.5).floor();
    let last = if to < last_px { to } else { last_px };
    (first <= last).then(|| (whole(first) / TILE_PX, whole(last) / TILE_PX))
}

/// A whole number from 0 to 2^23 - 1 as an integer: 2^23 + n has the bits of n as its mantissa. A
/// conversion takes six instructions, since it handles all other numbers as well.
#[inline(always)]
fn whole(value: f32) -> u32 {
    (value + 8_388_608.0).to_bits() & 0x7F_FFFF
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_are_those_with_a_centre_in_between() {
        // 100 px have seven tiles.
        assert_eq!(tiles(50.0, -10.0, 10.0, 100), Some((2, 3)));
        // Centres next to 16 px lie at 15.5, in tile 0, and at 16.5, in tile 1.
        assert_eq!(tiles(16.5, 0.0, 0.0, 100), Some((1, 1)), "on a centre");
        assert_eq!(tiles(16.0, -0.4, 0.4, 100), None, "between two centres");
        assert_eq!(tiles(16.0, -0.5, 0.5, 100), Some((0, 1)), "from centre to centre");
        for (far, expected) in [(1e30, Some((0, 6))), (f32::INFINITY, Some((0, 6)))] {
            assert_eq!(tiles(50.0, -far, far, 100), expected);
        }
        // Both end 0.1 px before the centre of the image's first or last pixel.
        assert_eq!(tiles(-8.0, -4.0, 8.4, 100), None);
        assert_eq!(tiles(108.0, -8.4, 4.0, 100), None);
        // The last pixel of the widest image is 16,383, in tile 1,023; 16,084/16 is 1,005.25.
        assert_eq!(tiles(16_384.0, -300.0, 1.0, 16_384), Some((1005, 1023)));
    }
}
