//! Stage rasterize: each tile blends its splats from the nearest, one block of 4 x 4 pixels in
//! the 16 lanes of a vector.
//!
//! A batch of splats is first matched against the tile's 16 blocks at once; then every block runs
//! through the splats that touch it with its sums in registers.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use fearless_simd::{Level, dispatch, f32x16, i32x16, prelude::*, u16x32};
use rayon::prelude::*;

use super::appearance;
use super::behind::Behind;
use super::bin::{Bins, Grid};
use super::project::Projected;
use super::resolve::{self, Band, TileSums};
use crate::constants::{BLOCK_PX, TILE_PX};
use crate::layout::{Cutoffs, Splat};
use crate::{OnViewDone, Target, View};
use wildcity_scene::chunk::LANES;

/// Splats of a batch: 64 of 308 B stay in the first-level cache beside the sums.
const BATCH: usize = 64;
/// Blocks of a tile: one lane each when a splat is matched.
const BLOCKS: usize = 16;

/// What the stages before have found.
#[derive(Clone, Copy)]
pub(super) struct Input<'a> {
    pub(super) projected: &'a Projected,
    pub(super) bins: &'a Bins,
    pub(super) views: &'a [View],
    pub(super) behind: &'a [Behind],
    pub(super) cutoffs: &'a Cutoffs,
}

/// Draws all views, and tells of each one that is done. Returns Gaussian-pixel evaluations.
pub(super) fn rasterize(
    level: Level,
    input: Input<'_>,
    targets: &mut [Target<'_>],
    finished: OnViewDone<'_>,
) -> u64 {
    let evaluations = AtomicU64::new(0);
    targets.par_iter_mut().zip(input.views).enumerate().with_max_len(1).for_each(
        |(index, (target, view))| {
            let grid = Grid::new(view);
            let mut bands = resolve::bands(target, view);
            bands.par_iter_mut().enumerate().with_max_len(1).for_each(|(row, band)| {
                let count = dispatch!(level, simd => {
                    rasterize_band(simd, input, index, row, grid.columns, band)
                });
                evaluations.fetch_add(count, Relaxed);
            });
            drop(bands);
            target.finish(view);
            finished(index, target);
        },
    );
    evaluations.into_inner()
}

/// A splat matched against a tile.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
struct Matched {
    /// `u` of each block's centre.
    u: [f32; BLOCKS],
    /// `v` of each block's centre.
    v: [f32; BLOCKS],
    /// `u` of each lane relative to its block's centre.
    lane_u: [f32; LANES],
    /// `v` of each lane relative to its block's centre.
    lane_v: [f32; LANES],
    log2_opacity: f32,
    rgb: [f32; 3],
    depth_m: f32,
}

/// A batch, and which of it touches each block.
struct Lists {
    splats: [Splat; BATCH],
    batch: [Matched; BATCH],
    /// Per splat, a bit for each block that it touches.
    blocks: [u16; BATCH],
    /// Per block, a bit for each splat that touches it.
    touching: [u64; BLOCKS],
}

impl Default for Lists {
    fn default() -> Self {
        Self {
            splats: [Splat::default(); BATCH],
            batch: [Matched::default(); BATCH],
            blocks: [0; BATCH],
            touching: [0; BLOCKS],
        }
    }
}

#[inline(always)]
fn rasterize_band<S: Simd>(
    simd: S,
    input: Input<'_>,
    view: usize,
    row: usize,
    columns: u32,
    band: &mut Band<'_>,
) -> u64 {
    let mut lists = Lists::default();
    let behind = input.behind.get(view);
    let mut scratch = behind.and_then(Behind::scratch);
    let mut evaluations = 0;
    for column in 0..columns {
        let tile = input.bins.tile(view, row * columns as usize + column as usize);
        let at = [column * TILE_PX, row as u32 * TILE_PX];
        let mut sums = TileSums::default();
        evaluations +=
            rasterize_tile(simd, input, tile, at, &mut lists, (&mut sums, band.wants_depth()));
        if let Some(behind) = behind {
            behind.add(simd, at, &mut scratch, &mut sums);
        }
        if let Some(appearance) = band.appearance {
            appearance::apply(simd, appearance, at, &mut sums);
        }
        resolve::resolve(simd, &sums, at[0], band);
    }
    evaluations
}

#[inline(always)]
fn rasterize_tile<S: Simd>(
    simd: S,
    input: Input<'_>,
    tile: &[AtomicU32],
    at_px: [u32; 2],
    lists: &mut Lists,
    (sums, wants_depth): (&mut TileSums, bool),
) -> u64 {
    let mut live = u16::MAX;
    let mut evaluations = 0;
    for batch in tile.chunks(BATCH) {
        match_batch(simd, input, batch, at_px, lists);
        for block in 0..BLOCKS {
            let touching = lists.touching[block];
            if touching == 0 || live >> block & 1 == 0 {
                continue;
            }
            let (done, count) = if wants_depth {
                blend::<S, true>(simd, &lists.batch, touching, block, input.cutoffs, sums)
            } else {
                blend::<S, false>(simd, &lists.batch, touching, block, input.cutoffs, sums)
            };
            live &= !(u16::from(done) << block);
            evaluations += count as u64 * LANES as u64;
        }
        if live == 0 {
            break;
        }
    }
    evaluations
}

/// Fills the batch, and finds which of it touches each block.
///
/// A splat's ellipse lies within `|dx| <= extent_x`, `|dy| <= extent_y` and `|u| <= √power`: three
/// slabs, tight for needles at any angle. Each is widened by half a block.
#[inline(always)]
fn match_batch<S: Simd>(
    simd: S,
    input: Input<'_>,
    batch: &[AtomicU32],
    at_px: [u32; 2],
    lists: &mut Lists,
) {
    let splat = |value: f32| f32x16::splat(simd, value);
    // Offsets of pixel centres from their block's centre: -1.5, -0.5, 0.5, 1.5 px.
    let half_px = 0.5 * (BLOCK_PX as f32 - 1.0);
    let lane_x = f32x16::from_fn(simd, |lane| (lane as u32 % BLOCK_PX) as f32 - half_px);
    let lane_y = f32x16::from_fn(simd, |lane| (lane as u32 / BLOCK_PX) as f32 - half_px);
    let block_x = (lane_x + splat(half_px)) * splat(BLOCK_PX as f32);
    let block_y = (lane_y + splat(half_px)) * splat(BLOCK_PX as f32);
    let [tile_x, tile_y] = at_px.map(|px| px as f32 + 0.5 + half_px);

    // All reads first: side by side, the cache misses of a batch cost little more than one.
    for (splat, place) in lists.splats.iter_mut().zip(batch) {
        *splat = *input.projected.splat(place.load(Relaxed));
    }
    for k in 0..batch.len().min(BATCH) {
        let Splat { mean_px, factor: [l0, l1, l2], log2_opacity, rgb, depth_m, extent_px } =
            &lists.splats[k];
        let dx = block_x - splat(mean_px[0] - tile_x);
        let dy = block_y - splat(mean_px[1] - tile_y);
        let u = dx.mul_add(splat(*l0), dy * splat(*l1));
        let v = dy * splat(*l2);
        let reach_u = (log2_opacity - input.cutoffs.log2_alpha_cut).sqrt() * (1.0 + 1e-5)
            + (half_px + 2e-3) * (l0.abs() + l1.abs());
        let touches = dx.abs().simd_le(splat(extent_px[0] + half_px))
            & dy.abs().simd_le(splat(extent_px[1] + half_px))
            & u.abs().simd_le(splat(reach_u));

        let matched = &mut lists.batch[k];
        u.store_array(&mut matched.u);
        v.store_array(&mut matched.v);
        lane_x.mul_add(splat(*l0), lane_y * splat(*l1)).store_array(&mut matched.lane_u);
        (lane_y * splat(*l2)).store_array(&mut matched.lane_v);
        (matched.log2_opacity, matched.rgb, matched.depth_m) = (*log2_opacity, *rgb, *depth_m);

        lists.blocks[k] = touches.to_bitmask() as u16;
    }

    // Transpose: bit k of `touching[block]` is bit `block` of `blocks[k]`.
    lists.blocks[batch.len().min(BATCH)..].fill(0);
    let (low, high) = lists.blocks.split_at(BATCH / 2);
    let (low, high) = (u16x32::from_slice(simd, low), u16x32::from_slice(simd, high));
    for (block, touching) in lists.touching.iter_mut().enumerate() {
        let bit = u16x32::splat(simd, 1 << block);
        let [low, high] = [(low & bit).simd_eq(bit), (high & bit).simd_eq(bit)];
        *touching = low.to_bitmask() | high.to_bitmask() << (BATCH / 2);
    }
}

/// Blends splats over one block. Returns whether the block is opaque, and how many were blended.
///
/// The transmittance used for stopping runs on after a lane has stopped: it only falls, so the
/// test `after > stop` stays false, and the loop depends on one multiply-add. The one that counts
/// is kept beside it.
#[inline(always)]
fn blend<S: Simd, const DEPTH: bool>(
    simd: S,
    batch: &[Matched; BATCH],
    mut touching: u64,
    block: usize,
    cutoffs: &Cutoffs,
    sums: &mut TileSums,
) -> (bool, usize) {
    let splat = |value: f32| f32x16::splat(simd, value);
    let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
    let (cap, cut, stop) =
        (splat(cutoffs.alpha_cap), splat(cutoffs.log2_alpha_cut), splat(cutoffs.stop));
    // Far below any stop, and far above what slows a multiplication down.
    let floor = splat(1e-20);
    let [mut r, mut g, mut b] =
        [load(&sums.rgb[0][block]), load(&sums.rgb[1][block]), load(&sums.rgb[2][block])];
    let mut depth = load(&sums.depth_m[block]);
    let mut transmittance = load(&sums.transmittance[block]);
    let mut running = load(&sums.running[block]);
    let mut count = 0;
    let mut done = false;
    while touching != 0 {
        count += 1;
        let matched = &batch[touching.trailing_zeros() as usize % BATCH];
        touching &= touching - 1;
        let u = load(&matched.lane_u) + splat(matched.u[block]);
        let v = load(&matched.lane_v) + splat(matched.v[block]);
        let exponent = (-v).mul_add(v, (-u).mul_add(u, splat(matched.log2_opacity)));
        let alpha = exp2(simd, exponent).min(cap);
        let alpha = exponent.simd_ge(cut).select(alpha, splat(0.0));
        let after = (-alpha).mul_add(running, running);
        let counts = after.simd_gt(stop);
        let weight = counts.select(alpha * running, splat(0.0));
        running = after.max(floor);
        r = weight.mul_add(splat(matched.rgb[0]), r);
        g = weight.mul_add(splat(matched.rgb[1]), g);
        b = weight.mul_add(splat(matched.rgb[2]), b);
        if DEPTH {
            depth = weight.mul_add(splat(matched.depth_m), depth);
        }
        transmittance = counts.select(after, transmittance);
        if counts.all_false() {
            done = true;
            break;
        }
    }
    r.store_array(&mut sums.rgb[0][block]);
    g.store_array(&mut sums.rgb[1][block]);
    b.store_array(&mut sums.rgb[2][block]);
    depth.store_array(&mut sums.depth_m[block]);
    transmittance.store_array(&mut sums.transmittance[block]);
    running.store_array(&mut sums.running[block]);
    (done, count)
}

/// `2^x` for x in [-126, 0], within 2e-7 and exact for whole x; anything, but no trap, elsewhere.
///
/// The fraction's polynomial is the minimax fit of degree 5 to `2^f` on [0, 1) in relative error
/// (8e-8) among those with value 1 at 0.
#[inline(always)]
fn exp2<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let whole = x.floor();
    let f = x - whole;
    let power = f
        .mul_add(splat(1.867_130_2e-3), splat(9.017_03e-3))
        .mul_add(f, splat(5.579_991_3e-2))
        .mul_add(f, splat(2.401_644_4e-1))
        .mul_add(f, splat(6.931_513e-1))
        .mul_add(f, splat(1.0));
    let whole: i32x16<S> = whole.to_int();
    let power: i32x16<S> = power.bitcast();
    (power + (whole << 23)).bitcast()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp2_is_within_two_units_of_f32() {
        for i in 0..=16_000 {
            let x = -8.0 * i as f32 / 16_000.0;
            let power = dispatch!(Level::new(), simd => {
                exp2(simd, f32x16::splat(simd, x)).to_array()[0]
            });
            let error = f64::from(power) / f64::from(x).exp2() - 1.0;
            assert!(error.abs() < 2e-7, "2^{x} is {power}, off by {error:e}");
            if x.fract() == 0.0 {
                assert_eq!(power, x.exp2());
            }
        }
    }
}
