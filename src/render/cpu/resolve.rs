//! Stage resolve: the sums of a tile become the pixels of the requested images.

use fearless_simd::{f32x16, prelude::*, u32x16};

use super::project::Projected;
use crate::constants::{BLOCK_PX, TILE_PX};
use crate::{Target, View};
use wildcity_scene::SemanticClass;
use wildcity_scene::appearance::Appearance;
use wildcity_scene::chunk::LANES;

/// Blocks of a tile, row by row.
pub(super) const BLOCKS: usize = (TILE_PX / BLOCK_PX * (TILE_PX / BLOCK_PX)) as usize;

/// Column and row of a block's top left pixel, from that of its tile.
#[inline(always)]
pub(super) fn block_corner(block: usize) -> [u32; 2] {
    let per_row = TILE_PX / BLOCK_PX;
    [block as u32 % per_row * BLOCK_PX, block as u32 / per_row * BLOCK_PX]
}

/// For each pixel of a tile, the place of the splat that brings its transmittance to a half or
/// less, plus 1; 0 if none has.
pub(super) type HalvedBy = [[u32; LANES]; BLOCKS];

/// Before any splat is blended.
pub(super) const NOT_HALVED: HalvedBy = [[0; LANES]; BLOCKS];

/// Accumulated values of the 256 pixels of a tile, block by block.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(super) struct TileSums {
    /// Linear premultiplied red, green, blue.
    pub(super) rgb: [[[f32; LANES]; BLOCKS]; 3],
    /// Depth weighted by contribution, in metres; 0 unless depth is requested.
    pub(super) depth_m: [[f32; LANES]; BLOCKS],
    /// Share of the background that is visible.
    pub(super) transmittance: [[f32; LANES]; BLOCKS],
    /// Transmittance that continues to fall after a pixel has stopped (see `blend::blend`).
    pub(super) running: [[f32; LANES]; BLOCKS],
}

impl Default for TileSums {
    fn default() -> Self {
        let zero = [[0.0; LANES]; BLOCKS];
        let one = [[1.0; LANES]; BLOCKS];
        Self { rgb: [zero; 3], depth_m: zero, transmittance: one, running: one }
    }
}

/// The part of a target that one row of tiles covers.
#[derive(Debug, Default)]
pub(super) struct Band<'a> {
    width: usize,
    rows: usize,
    rgba: Option<&'a mut [f32]>,
    rgb8: Option<&'a mut [u8]>,
    depth_m: Option<&'a mut [f32]>,
    opacity: Option<&'a mut [f32]>,
    instances: Option<&'a mut [u16]>,
    semantics: Option<&'a mut [u8]>,
}

impl Band<'_> {
    /// Writes the instances and classes of one tile with its left edge at column `left`. If earlier
    /// slabs wrote some, those of pixels that were halved in those slabs stay.
    pub(super) fn write_owners(
        &mut self,
        halved_by: &HalvedBy,
        left: u32,
        projected: &Projected,
        has_some: bool,
    ) {
        let edge = BLOCK_PX as usize;
        for (block, halved_by) in halved_by.iter().enumerate() {
            let [block_left, row] = block_corner(block).map(|px| px as usize);
            let column = left as usize + block_left;
            // A block beyond the image's edge has no rows or columns here.
            for y in 0..edge.min(self.rows.saturating_sub(row)) {
                for x in 0..edge.min(self.width.saturating_sub(column)) {
                    let pixel = (row + y) * self.width + column + x;
                    let place = halved_by[y * edge + x].checked_sub(1);
                    if place.is_none() && has_some {
                        continue;
                    }
                    if let Some(instances) = &mut self.instances {
                        instances[pixel] = place.map_or(0, |place| projected.instance(place));
                    }
                    if let Some(semantics) = &mut self.semantics {
                        let class = place.map(|place| projected.class(place));
                        semantics[pixel] = class.unwrap_or(SemanticClass::None).value();
                    }
                }
            }
        }
    }
}

/// Exposure and overlay of a target's camera; `None` if they change nothing.
pub(super) fn appearance<'a>(target: &Target<'a>) -> Option<&'a Appearance> {
    target.appearance.filter(|appearance| !appearance.is_identity())
}

/// Splits a target into bands, one per row of tiles of its view.
pub(super) fn bands<'a>(target: &'a mut Target<'_>, view: &View) -> Vec<Band<'a>> {
    let width = view.camera.width_px as usize;
    let height = view.camera.height_px as usize;
    let pixels = width * TILE_PX as usize;
    let mut rgba = target.rgba.as_mut().map(|b| b.chunks_mut(4 * pixels));
    let mut rgb8 = target.rgb8.as_mut().map(|b| b.chunks_mut(3 * pixels));
    let mut depth_m = target.depth_m.as_mut().map(|b| b.chunks_mut(pixels));
    let mut opacity = target.opacity.as_mut().map(|b| b.chunks_mut(pixels));
    // All iterators advance together: band k has the rows of tile row k in every image.
    let mut instances = target.instances.as_mut().map(|b| b.chunks_mut(pixels));
    let mut semantics = target.semantics.as_mut().map(|b| b.chunks_mut(pixels));
    (0..height)
        .step_by(TILE_PX as usize)
        .map(|top| Band {
            width,
            rows: (height - top).min(TILE_PX as usize),
            rgba: rgba.as_mut().and_then(Iterator::next),
            rgb8: rgb8.as_mut().and_then(Iterator::next),
            depth_m: depth_m.as_mut().and_then(Iterator::next),
            opacity: opacity.as_mut().and_then(Iterator::next),
            instances: instances.as_mut().and_then(Iterator::next),
            semantics: semantics.as_mut().and_then(Iterator::next),
        })
        .collect()
}

/// Writes one tile with its left edge at column `left`.
#[inline(always)]
pub(super) fn resolve<S: Simd>(simd: S, sums: &TileSums, left: u32, band: &mut Band<'_>) {
    for block in 0..BLOCKS {
        resolve_block(simd, sums, block, left, band);
    }
}

#[inline(always)]
fn resolve_block<S: Simd>(simd: S, sums: &TileSums, block: usize, left: u32, band: &mut Band<'_>) {
    let edge = BLOCK_PX as usize;
    let [block_left, row] = block_corner(block).map(|px| px as usize);
    let column = left as usize + block_left;
    // An image's size need not be a multiple of 16 px: pixels beyond its edges are not written.
    let columns = edge.min(band.width.saturating_sub(column));
    let rows = edge.min(band.rows.saturating_sub(row));
    if columns == 0 || rows == 0 {
        return;
    }
    let each = |write: &mut dyn FnMut(usize, usize)| {
        for y in 0..rows {
            for x in 0..columns {
                write((row + y) * band.width + column + x, y * edge + x);
            }
        }
    };

    let one = f32x16::splat(simd, 1.0);
    let transmittance = f32x16::load_array_ref(simd, &sums.transmittance[block]);
    let opacity = (one - transmittance).to_array();
    if let Some(rgba) = &mut band.rgba {
        each(&mut |pixel, lane| {
            let [r, g, b] = [0, 1, 2].map(|channel| sums.rgb[channel][block][lane]);
            rgba[4 * pixel..4 * pixel + 4].copy_from_slice(&[r, g, b, opacity[lane]]);
        });
    }
    if let Some(rgb8) = &mut band.rgb8 {
        let r = to_8_bit(simd, &sums.rgb[0][block]);
        let g = to_8_bit(simd, &sums.rgb[1][block]);
        let b = to_8_bit(simd, &sums.rgb[2][block]);
        // Each pixel is 0x00BBGGRR; three words take the twelve bytes of four pixels.
        let pixels = (r | g << 8 | b << 16).to_array();
        for (y, of_row) in pixels.chunks_exact(edge).take(rows).enumerate() {
            let first = 3 * ((row + y) * band.width + column);
            // Four pixels of three bytes each.
            let mut bytes = [0; 3 * BLOCK_PX as usize];
            let [a, b, c, d] = [of_row[0], of_row[1], of_row[2], of_row[3]];
            bytes[..4].copy_from_slice(&(a | b << 24).to_le_bytes());
            bytes[4..8].copy_from_slice(&(b >> 8 | c << 16).to_le_bytes());
            bytes[8..].copy_from_slice(&(c >> 16 | d << 8).to_le_bytes());
            let to = &mut rgb8[first..first + 3 * columns];
            // A slice of a fixed length, so that the compiler makes few stores of it.
            match <&mut [u8; 3 * BLOCK_PX as usize]>::try_from(&mut *to) {
                Ok(to) => *to = bytes,
                // The last block of a row may be narrower than four pixels.
                Err(_) => to.copy_from_slice(&bytes[..to.len()]),
            }
        }
    }
    if let Some(depth_m) = &mut band.depth_m {
        let sum = &sums.depth_m[block];
        each(&mut |pixel, lane| {
            // The quotient is 0/0 where no splat was blended.
            let covered = opacity[lane] > 0.0;
            depth_m[pixel] = if covered { sum[lane] / opacity[lane] } else { 0.0 };
        });
    }
    if let Some(to) = &mut band.opacity {
        each(&mut |pixel, lane| to[pixel] = opacity[lane]);
    }
}

/// Clamps to [0, 1] and rounds to the nearest of 0 to 255.
#[inline(always)]
fn to_8_bit<S: Simd>(simd: S, linear: &[f32; LANES]) -> u32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let clamped = f32x16::load_array_ref(simd, linear).max(splat(0.0)).min(splat(1.0));
    // The conversion truncates: adding 1/2 rounds to the nearest.
    clamped.mul_add(splat(255.0), splat(0.5)).to_int()
}
