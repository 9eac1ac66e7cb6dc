//! Stage resolve: the sums of a tile become the pixels of the requested images.

use fearless_simd::{f32x16, prelude::*, u32x16};

use super::project::Projected;
use crate::constants::{BLOCK_PX, TILE_PX};
use crate::samples::{SAMPLES, most_frequent};
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

/// The blocks of a tile, row by row.
const ALL_BLOCKS: [usize; BLOCKS] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

/// The blocks of each quarter of a tile.
const QUARTERS: [[usize; 4]; 4] = [[0, 1, 4, 5], [2, 3, 6, 7], [8, 9, 12, 13], [10, 11, 14, 15]];

/// The pixels of an image that a tile becomes.
#[derive(Clone, Copy, Debug)]
pub(super) struct TilePixels {
    /// The first pixel of the image's tile that has them.
    pub(super) at_px: [u32; 2],
    /// Their blocks in it.
    pub(super) blocks: &'static [usize],
    /// Row of tiles of the image.
    pub(super) band: usize,
    /// Which quarter of the image's tile they are, for a tile of samples.
    quarter: usize,
}

impl TilePixels {
    /// Of a tile by its column and row, which has the image's pixels, or 2 x 2 samples of each.
    pub(super) fn new([column, row]: [u32; 2], is_sampled: bool) -> Self {
        if !is_sampled {
            let at_px = [column * TILE_PX, row * TILE_PX];
            return Self { at_px, blocks: &ALL_BLOCKS, band: row as usize, quarter: 0 };
        }
        let at_px = [column / SAMPLES * TILE_PX, row / SAMPLES * TILE_PX];
        let quarter = (row % SAMPLES * SAMPLES + column % SAMPLES) as usize;
        let band = (row / SAMPLES) as usize;
        Self { at_px, blocks: &QUARTERS[quarter], band, quarter }
    }

    /// Where the 2 x 2 pixels of a block of samples lie: their block, and the lane of the first.
    fn sample_pixels(&self, block: usize) -> (usize, u32) {
        let [left, top] = block_corner(block).map(|px| px / SAMPLES);
        let into = QUARTERS[self.quarter][(top / BLOCK_PX * 2 + left / BLOCK_PX) as usize];
        (into, top % BLOCK_PX * BLOCK_PX + left % BLOCK_PX)
    }
}

/// The lane of the first sample of each of a block's 2 x 2 pixels; the others are 1, 4 and 5 after
/// it.
const FIRST_SAMPLES: [usize; 4] = [0, 2, 8, 10];

/// The lanes of 2 x 2 pixels, given the first.
fn four_lanes(first: u32) -> [u32; 4] {
    [first, first + 1, first + BLOCK_PX, first + BLOCK_PX + 1]
}

/// The owner of each sample of a tile, block by block: the instance, and the class in the high
/// half.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct SampleOwners([[u32; LANES]; BLOCKS]);

impl SampleOwners {
    /// Records the owners of samples that were halved.
    pub(super) fn note(&mut self, halved_by: &HalvedBy, projected: &Projected) {
        for (owner, place) in self.0.as_flattened_mut().iter_mut().zip(halved_by.as_flattened()) {
            if let Some(place) = place.checked_sub(1) {
                let class = u32::from(projected.class(place).value());
                *owner = u32::from(projected.instance(place)) | class << 16;
            }
        }
    }
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

impl TileSums {
    /// Writes the sums of the pixels that a tile of samples becomes to their blocks: the means of
    /// 2 x 2 samples. `depth` tells whether depth is requested.
    #[inline(always)]
    pub(super) fn write_means(&self, pixels: &TilePixels, depth: bool, means: &mut Self) {
        let each = |from: &[[f32; LANES]; BLOCKS], to: &mut [[f32; LANES]; BLOCKS]| {
            for (block, from) in from.iter().enumerate() {
                let (into, first) = pixels.sample_pixels(block);
                let to = &mut to[into];
                for (k, lane) in FIRST_SAMPLES.into_iter().zip(four_lanes(first)) {
                    to[lane as usize % LANES] =
                        0.25 * ((from[k] + from[k + 1]) + (from[k + 4] + from[k + 5]));
                }
            }
        };
        for (from, to) in self.rgb.iter().zip(&mut means.rgb) {
            each(from, to);
        }
        if depth {
            each(&self.depth_m, &mut means.depth_m);
        }
        each(&self.transmittance, &mut means.transmittance);
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

impl Band<'_> {
    /// Writes the instances and classes of the pixels that a tile of samples becomes.
    pub(super) fn write_sampled_owners(&mut self, owners: &SampleOwners, pixels: &TilePixels) {
        for (block, owners) in owners.0.iter().enumerate() {
            let (into, first) = pixels.sample_pixels(block);
            let [left, top] = block_corner(into);
            for (k, lane) in FIRST_SAMPLES.into_iter().zip(four_lanes(first)) {
                let column = (pixels.at_px[0] + left + lane % BLOCK_PX) as usize;
                let row = (top + lane / BLOCK_PX) as usize;
                // Beyond the image's edge there are no pixels.
                if column >= self.width || row >= self.rows {
                    continue;
                }
                let pixel = row * self.width + column;
                let samples = [owners[k], owners[k + 1], owners[k + 4], owners[k + 5]];
                // Each by itself, so that neither depends on whether the other is asked for.
                if let Some(instances) = &mut self.instances {
                    instances[pixel] = most_frequent(samples.map(|owner| owner as u16));
                }
                if let Some(semantics) = &mut self.semantics {
                    semantics[pixel] = most_frequent(samples.map(|owner| (owner >> 16) as u8));
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

/// Writes the pixels of one tile.
#[inline(always)]
pub(super) fn resolve<S: Simd>(simd: S, sums: &TileSums, pixels: &TilePixels, band: &mut Band<'_>) {
    for &block in pixels.blocks {
        resolve_block(simd, sums, block, pixels.at_px[0], band);
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
            let a = of_row[0];
            let b = of_row[1];
            let c = of_row[2];
            let d = of_row[3];
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
