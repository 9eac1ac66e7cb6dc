//! A batch of 64 splats, matched against the blocks of one tile.
//!
//! Each splat is tested against the 16 blocks of the tile at once, one block per lane, which gives
//! a bit for each block. The matrix of 64 x 16 bits is transposed with vector compares. Each block
//! then takes the splats of its 64 bits in order, with all its sums in registers. Building a list
//! per block instead of transposing bits cost 25 % of the whole stage rasterize.

use fearless_simd::{f32x16, prelude::*, u16x32};

use super::bin::MacroTile;
use super::project::Projected;
use super::resolve::BLOCKS;
use crate::constants::BLOCK_PX;
use crate::layout::{Cutoffs, Splat};
use wildcity_scene::chunk::LANES;

/// Splats of a batch: 64 of 308 B stay in the first-level cache together with the sums, and their
/// bits in one u64.
pub(super) const BATCH: usize = 64;

/// A splat, with the linear forms `u` and `v` of its exponent ([`Splat::factor`]) prepared for a
/// tile: at a pixel they are the value at the centre of its block plus the offset of its lane.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(super) struct Matched {
    /// `u` at each block's centre.
    pub(super) u: [f32; BLOCKS],
    /// `v` at each block's centre.
    pub(super) v: [f32; BLOCKS],
    /// Offset of `u` from its block's centre, of each lane.
    pub(super) lane_u: [f32; LANES],
    /// Offset of `v` from its block's centre, of each lane.
    pub(super) lane_v: [f32; LANES],
    pub(super) log2_opacity: f32,
    pub(super) rgb: [f32; 3],
    pub(super) depth_m: f32,
}

/// A batch of splats, and the blocks that each of them touches.
#[derive(Debug)]
pub(super) struct Batch {
    pub(super) splats: [Splat; BATCH],
    pub(super) matched: [Matched; BATCH],
    /// For each splat, a bit for each block that it touches.
    pub(super) blocks: [u16; BATCH],
    /// For each block, a bit for each splat that touches it.
    pub(super) touching: [u64; BLOCKS],
    /// The place of each splat. Only written if owners are wanted.
    pub(super) places: [u32; BATCH],
}

impl Default for Batch {
    fn default() -> Self {
        Self {
            splats: [Splat::default(); BATCH],
            matched: [Matched::default(); BATCH],
            blocks: [0; BATCH],
            touching: [0; BLOCKS],
            places: [0; BATCH],
        }
    }
}

impl Batch {
    /// Reads the splats of a macro tile with these indices.
    #[inline(always)]
    pub(super) fn read(&mut self, macro_tile: &MacroTile, projected: &Projected, indices: &[u32]) {
        // All splats first: their cache misses overlap, and cost little more than one.
        let splats = self.splats.iter_mut().zip(indices);
        match macro_tile.copies() {
            Some(copies) => {
                for (splat, &index) in splats {
                    *splat = copies[index as usize];
                }
            }
            None => {
                for (splat, &index) in splats {
                    *splat = *projected.splat(macro_tile.place(index));
                }
            }
        }
    }

    /// Finds the blocks of the tile at `at_px` that each of the first `len` splats touches.
    ///
    /// A splat's ellipse lies within three slabs: `|dx| <= extent_x`, `|dy| <= extent_y` and
    /// `|u| <= √power`, which together are tight for needles at any angle; and it is the disc
    /// `u² + v² <= power`, which leaves out the corners of the box of a round splat, a fifth of it.
    /// A block is touched if its centre lies within the slabs, each widened by half a block, and
    /// within the disc, widened by how far the block's pixels are from its centre in `(u, v)`.
    #[inline(always)]
    pub(super) fn match_blocks<S: Simd>(
        &mut self,
        simd: S,
        cutoffs: &Cutoffs,
        len: usize,
        at_px: [u32; 2],
    ) {
        let splat = |value: f32| f32x16::splat(simd, value);

        // Offsets of pixel centres from the centre of their block: -1.5, -0.5, 0.5, 1.5 px; and of
        // the 16 block centres from the first one.
        let half_px = 0.5 * (BLOCK_PX as f32 - 1.0);
        let lane_x = f32x16::from_fn(simd, |lane| (lane as u32 % BLOCK_PX) as f32 - half_px);
        let lane_y = f32x16::from_fn(simd, |lane| (lane as u32 / BLOCK_PX) as f32 - half_px);
        let block_x = (lane_x + splat(half_px)) * splat(BLOCK_PX as f32);
        let block_y = (lane_y + splat(half_px)) * splat(BLOCK_PX as f32);
        // The centre of the first block: half a pixel to the first pixel's centre, and 1.5 px on.
        let [tile_x, tile_y] = at_px.map(|px| px as f32 + 0.5 + half_px);

        for k in 0..len.min(BATCH) {
            let Splat { mean_px, factor: [l0, l1, l2], log2_opacity, rgb, depth_m, extent_px } =
                &self.splats[k];
            let dx = block_x - splat(mean_px[0] - tile_x);
            let dy = block_y - splat(mean_px[1] - tile_y);
            // Both forms are linear, so that a block's value and a lane's offset add up to
            // a pixel's.
            let u = dx.mul_add(splat(*l0), dy * splat(*l1));
            let v = dy * splat(*l2);
            // √power, and the change of (u, v) within half a block, both increased by more than the
            // rounding error of f32.
            let [half_u, half_v] = [l0.abs() + l1.abs(), *l2].map(|l| (half_px + 2e-3) * l);
            let root = (log2_opacity - cutoffs.log2_alpha_cut).sqrt() * (1.0 + 1e-5);
            let reach = root + (half_u * half_u + half_v * half_v).sqrt();
            let touches = dx.abs().simd_le(splat(extent_px[0] + half_px))
                & dy.abs().simd_le(splat(extent_px[1] + half_px))
                & u.abs().simd_le(splat(root + half_u))
                & u.mul_add(u, v * v).simd_le(splat(reach * reach));

            let matched = &mut self.matched[k];
            u.store_array(&mut matched.u);
            v.store_array(&mut matched.v);
            lane_x.mul_add(splat(*l0), lane_y * splat(*l1)).store_array(&mut matched.lane_u);
            (lane_y * splat(*l2)).store_array(&mut matched.lane_v);
            matched.log2_opacity = *log2_opacity;
            matched.rgb = *rgb;
            matched.depth_m = *depth_m;

            // 16 lanes give 16 bits, so that the cast drops nothing.
            self.blocks[k] = touches.to_bitmask() as u16;
        }

        self.blocks[len.min(BATCH)..].fill(0);
    }

    /// Finds the splats that touch each block, from the blocks that each splat touches.
    #[inline(always)]
    pub(super) fn transpose<S: Simd>(&mut self, simd: S) {
        // Bit k of `touching[block]` is bit `block` of `blocks[k]`. 32 splats are compared at a
        // time.
        let (low, high) = self.blocks.split_at(BATCH / 2);
        let low = u16x32::from_slice(simd, low);
        let high = u16x32::from_slice(simd, high);
        for (block, touching) in self.touching.iter_mut().enumerate() {
            let bit = u16x32::splat(simd, 1 << block);
            let low = (low & bit).simd_eq(bit).to_bitmask();
            let high = (high & bit).simd_eq(bit).to_bitmask();
            *touching = low | high << (BATCH / 2);
        }
    }
}
