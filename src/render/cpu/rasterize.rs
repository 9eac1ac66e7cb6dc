//! Stage rasterize: each tile of 16 x 16 pixels blends its splats from front to back.
//!
//! **A thread draws one macro tile at a time**, with copies of its splats in the caches of its core ([`MacroTile`]).
//! Those with the most work are taken first, so that threads end at nearly the same time.
//!
//! **The 16 lanes of a vector are a block of 4 x 4 pixels, not a row of 16.** On the benchmark street a splat
//! touches 10.5 rows of a tile on average, but only 8 blocks, which saves a third of the evaluations.
//!
//! **Splats are matched in batches of 64.** Each splat of a batch is tested against the 16 blocks of the tile
//! at once, one block per lane, which gives a bit for each block. The matrix of 64 x 16 bits is transposed
//! with vector compares. Each block then takes the splats of its 64 bits in order, with all its sums in
//! registers. Building a list per block instead of transposing bits cost 25 % of the whole stage.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Instant;

use fearless_simd::{Level, dispatch, f32x16, prelude::*, u16x32};
use parking_lot::Mutex;
use rayon::prelude::*;

use super::appearance;
use super::background::Background;
use super::bin::{Bins, Grid, MacroTile};
use super::math::exp2;
use super::project::Projected;
use super::resolve::{self, BLOCKS, Band, HalvedBy, NOT_HALVED, TileSums};
use super::unfinished::{Continued, UnfinishedTile};
use crate::constants::{BLOCK_PX, TILE_PX};
use crate::layout::{Cutoffs, Splat};
use crate::{OnViewDone, Target, View};
use wildcity_scene::appearance::Appearance;
use wildcity_scene::chunk::LANES;

/// Splats of a batch: 64 of 308 B stay in the first-level cache beside the sums, and their bits in one u64.
const BATCH: usize = 64;

/// The outputs of the stages before.
#[derive(Clone, Copy)]
pub(super) struct Input<'a> {
    pub(super) projected: &'a Projected,
    pub(super) bins: &'a Bins,
    pub(super) views: &'a [View],
    /// One per view, or none.
    pub(super) backgrounds: &'a [Background],
    pub(super) cutoffs: &'a Cutoffs,
}

/// What threads keep from macro tile to macro tile. Not in use.
#[derive(Debug, Default)]
pub(super) struct Scratches(Mutex<Vec<Box<Scratch>>>);

impl Scratches {
    /// Frees what threads keep if it is more than `most_bytes`.
    pub(super) fn trim(&mut self, most_bytes: u64) {
        let scratches = self.0.get_mut();
        let bytes: usize = scratches.iter().map(|scratch| scratch.macro_tile.held_bytes()).sum();
        if bytes as u64 > most_bytes {
            scratches.clear();
        }
    }
}

/// Of one thread.
#[derive(Debug, Default)]
struct Scratch {
    macro_tile: MacroTile,
    batch: Batch,
}

/// What was done.
#[derive(Debug, Default)]
pub(super) struct Work {
    /// Number of Gaussian-pixel evaluations.
    pub(super) evaluations: u64,
    /// Time of all threads for stage sort, in ns.
    pub(super) sort_ns: u64,
    /// Time of all threads for the rest, in ns.
    pub(super) rasterize_ns: u64,
}

/// A view that is being drawn.
struct Drawing<'a> {
    view: usize,
    grid: Grid,
    wants: Wants,
    /// Exposure and overlay of the camera; `None` if they change nothing.
    appearance: Option<&'a Appearance>,
    background: Option<&'a Background>,
    /// One per row of tiles.
    bands: Vec<Mutex<Band<'a>>>,
}

/// Sorts and draws all views, and calls `on_view_done` as each is complete. Of a slab there is one view, complete after
/// the last one.
pub(super) fn rasterize(
    level: Level,
    input: Input<'_>,
    continued: Option<Continued<'_>>,
    scratches: &Scratches,
    targets: &mut [Target<'_>],
    on_view_done: OnViewDone<'_>,
) -> Work {
    let [evaluations, sort_ns, rasterize_ns] = [const { AtomicU64::new(0) }; 3];
    targets.par_iter_mut().zip(input.views).enumerate().with_max_len(1).for_each(
        |(index, (target, view))| {
            let drawing = Drawing {
                view: index,
                grid: Grid::new(view),
                wants: Wants {
                    depth: target.depth_m.is_some(),
                    instances: target.instances.is_some(),
                },
                appearance: resolve::appearance(target),
                background: input.backgrounds.get(index),
                bands: resolve::bands(target, view).into_iter().map(Mutex::new).collect(),
            };
            // A bridge hands them out in this order.
            input.bins.by_work(index).into_iter().par_bridge().for_each(|number| {
                let mut scratch = scratches.0.lock().pop().unwrap_or_default();
                let work = dispatch!(level, simd => {
                    draw_macro_tile(simd, input, continued, &drawing, number, &mut scratch)
                });
                scratch.macro_tile.trim();
                scratches.0.lock().push(scratch);
                evaluations.fetch_add(work.evaluations, Relaxed);
                sort_ns.fetch_add(work.sort_ns, Relaxed);
                rasterize_ns.fetch_add(work.rasterize_ns, Relaxed);
            });
            drop(drawing);
            if continued.is_none_or(|slab| slab.is_last) {
                target.finish(view);
                on_view_done(index, target);
            }
        },
    );
    Work {
        evaluations: evaluations.into_inner(),
        sort_ns: sort_ns.into_inner(),
        rasterize_ns: rasterize_ns.into_inner(),
    }
}

/// A splat, with the linear forms `u` and `v` of its exponent ([`Splat::factor`]) prepared for a tile: at a
/// pixel they are the value at the centre of its block plus the offset of its lane.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
struct Matched {
    /// `u` at each block's centre.
    u: [f32; BLOCKS],
    /// `v` at each block's centre.
    v: [f32; BLOCKS],
    /// Offset of `u` from its block's centre, of each lane.
    lane_u: [f32; LANES],
    /// Offset of `v` from its block's centre, of each lane.
    lane_v: [f32; LANES],
    log2_opacity: f32,
    rgb: [f32; 3],
    depth_m: f32,
}

/// A batch of splats, and which of them touch each block.
#[derive(Debug)]
struct Batch {
    splats: [Splat; BATCH],
    matched: [Matched; BATCH],
    /// For each splat, a bit for each block that it touches.
    blocks: [u16; BATCH],
    /// For each block, a bit for each splat that touches it.
    touching: [u64; BLOCKS],
    /// The place of each splat. Only written if instances are wanted.
    places: [u32; BATCH],
}

/// What is accumulated beside colours and transmittance.
#[derive(Clone, Copy)]
struct Wants {
    depth: bool,
    instances: bool,
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

/// Where one tile is accumulated.
struct TileOutput<'a> {
    sums: &'a mut TileSums,
    /// A bit for each block in which some pixel has not stopped.
    live: &'a mut u16,
    halved_by: &'a mut HalvedBy,
    wants: Wants,
}

/// Sorts and draws one macro tile of one view, and resolves its tiles into the target's bands after the last slab.
#[inline(always)]
fn draw_macro_tile<S: Simd>(
    simd: S,
    input: Input<'_>,
    continued: Option<Continued<'_>>,
    drawing: &Drawing<'_>,
    number: usize,
    scratch: &mut Scratch,
) -> Work {
    let Drawing { view, wants, background, .. } = *drawing;
    let Scratch { macro_tile, batch } = scratch;
    let start = Instant::now();
    let mut unfinished = continued.map(|slab| slab.tiles.0[number].lock());
    let is_last = continued.is_none_or(|slab| slab.is_last);
    input.bins.load(view, number, macro_tile);
    if !is_last && macro_tile.is_empty() {
        return Work::default();
    }
    let sorted = Instant::now();
    macro_tile.copy_splats(input.projected);

    let mut sky_scratch = background.and_then(Background::scratch);
    let mut halved_by = NOT_HALVED;
    let mut evaluations = 0;
    // Of earlier slabs.
    let has_sums = unfinished.as_ref().is_some_and(|tiles| !tiles.is_empty());
    for (index, (within, [column, row])) in drawing.grid.tiles_of(number).enumerate() {
        let at_px = [column * TILE_PX, row * TILE_PX];
        let mut sums = TileSums::default();
        let mut live = u16::MAX;
        if let (true, Some(tiles)) = (has_sums, &mut unfinished) {
            sums = tiles[index].sums;
            live = tiles[index].live;
        }
        let mut output =
            TileOutput { sums: &mut sums, live: &mut live, halved_by: &mut halved_by, wants };
        evaluations += rasterize_tile(simd, input, macro_tile, within, at_px, batch, &mut output);
        if wants.instances {
            let mut band = drawing.bands[row as usize].lock();
            band.write_instances(&halved_by, at_px[0], input.projected, has_sums);
            halved_by = NOT_HALVED;
        }
        if let (false, Some(tiles)) = (is_last, &mut unfinished) {
            let tile = UnfinishedTile { sums, live };
            match has_sums {
                true => tiles[index] = tile,
                false => tiles.push(tile),
            }
            continue;
        }
        if let Some(background) = background {
            background.add(simd, at_px, &mut sky_scratch, &mut sums);
        }
        if let Some(appearance) = drawing.appearance {
            appearance::apply(simd, appearance, at_px, &mut sums);
        }
        resolve::resolve(simd, &sums, at_px[0], &mut drawing.bands[row as usize].lock());
    }
    Work {
        evaluations,
        sort_ns: (sorted - start).as_nanos() as u64,
        rasterize_ns: sorted.elapsed().as_nanos() as u64,
    }
}

/// Blends the splats of one tile, batch by batch, until all of its blocks are opaque.
#[inline(always)]
fn rasterize_tile<S: Simd>(
    simd: S,
    input: Input<'_>,
    macro_tile: &MacroTile,
    within: usize,
    at_px: [u32; 2],
    batch: &mut Batch,
    output: &mut TileOutput<'_>,
) -> u64 {
    let mut live = *output.live;
    let mut evaluations = 0;
    for indices in macro_tile.tile(within).chunks(BATCH) {
        if live == 0 {
            break;
        }
        // Read all splats first: their cache misses overlap, and cost little more than one.
        let splats = batch.splats.iter_mut().zip(indices);
        match macro_tile.copies() {
            Some(copies) => {
                for (splat, &index) in splats {
                    *splat = copies[index as usize];
                }
            }
            None => {
                for (splat, &index) in splats {
                    *splat = *input.projected.splat(macro_tile.place(index));
                }
            }
        }
        match_batch(simd, input.cutoffs, indices.len(), at_px, batch);
        if output.wants.instances {
            for (place, &index) in batch.places.iter_mut().zip(indices) {
                *place = macro_tile.place(index);
            }
        }
        for block in 0..BLOCKS {
            let touching = batch.touching[block];
            if touching == 0 || live >> block & 1 == 0 {
                continue;
            }
            let cutoffs = input.cutoffs;
            let (stopped, count) = match output.wants {
                Wants { depth: false, instances: false } => {
                    blend::<S, false, false>(simd, batch, touching, block, cutoffs, output)
                }
                Wants { depth: true, instances: false } => {
                    blend::<S, true, false>(simd, batch, touching, block, cutoffs, output)
                }
                Wants { depth: false, instances: true } => {
                    blend::<S, false, true>(simd, batch, touching, block, cutoffs, output)
                }
                Wants { depth: true, instances: true } => {
                    blend::<S, true, true>(simd, batch, touching, block, cutoffs, output)
                }
            };
            live &= !(u16::from(stopped) << block);
            evaluations += count as u64 * LANES as u64;
        }
    }
    *output.live = live;
    evaluations
}

/// Finds which splats of a batch, `len` in number, touch each block of the tile.
///
/// A splat's ellipse lies within three slabs: `|dx| <= extent_x`, `|dy| <= extent_y` and `|u| <= √power`,
/// which together are tight for needles at any angle. A block is touched if its centre lies within the slabs,
/// each widened by half a block.
#[inline(always)]
fn match_batch<S: Simd>(
    simd: S,
    cutoffs: &Cutoffs,
    len: usize,
    at_px: [u32; 2],
    batch: &mut Batch,
) {
    let splat = |value: f32| f32x16::splat(simd, value);

    // Offsets of pixel centres from the centre of their block: -1.5, -0.5, 0.5, 1.5 px; and of the 16 block
    // centres from the first one.
    let half_px = 0.5 * (BLOCK_PX as f32 - 1.0);
    let lane_x = f32x16::from_fn(simd, |lane| (lane as u32 % BLOCK_PX) as f32 - half_px);
    let lane_y = f32x16::from_fn(simd, |lane| (lane as u32 / BLOCK_PX) as f32 - half_px);
    let block_x = (lane_x + splat(half_px)) * splat(BLOCK_PX as f32);
    let block_y = (lane_y + splat(half_px)) * splat(BLOCK_PX as f32);
    let [tile_x, tile_y] = at_px.map(|px| px as f32 + 0.5 + half_px);

    for k in 0..len.min(BATCH) {
        let Splat { mean_px, factor: [l0, l1, l2], log2_opacity, rgb, depth_m, extent_px } =
            &batch.splats[k];
        let dx = block_x - splat(mean_px[0] - tile_x);
        let dy = block_y - splat(mean_px[1] - tile_y);
        let u = dx.mul_add(splat(*l0), dy * splat(*l1));
        let v = dy * splat(*l2);
        // √power, and the change of u within half a block, both increased by more than the rounding error of f32.
        let reach_u = (log2_opacity - cutoffs.log2_alpha_cut).sqrt() * (1.0 + 1e-5)
            + (half_px + 2e-3) * (l0.abs() + l1.abs());
        let touches = dx.abs().simd_le(splat(extent_px[0] + half_px))
            & dy.abs().simd_le(splat(extent_px[1] + half_px))
            & u.abs().simd_le(splat(reach_u));

        let matched = &mut batch.matched[k];
        u.store_array(&mut matched.u);
        v.store_array(&mut matched.v);
        lane_x.mul_add(splat(*l0), lane_y * splat(*l1)).store_array(&mut matched.lane_u);
        (lane_y * splat(*l2)).store_array(&mut matched.lane_v);
        matched.log2_opacity = *log2_opacity;
        matched.rgb = *rgb;
        matched.depth_m = *depth_m;

        batch.blocks[k] = touches.to_bitmask() as u16;
    }

    // Transpose the bits: bit k of `touching[block]` is bit `block` of `blocks[k]`. 32 splats are compared at
    // a time.
    batch.blocks[len.min(BATCH)..].fill(0);
    let (low, high) = batch.blocks.split_at(BATCH / 2);
    let low = u16x32::from_slice(simd, low);
    let high = u16x32::from_slice(simd, high);
    for (block, touching) in batch.touching.iter_mut().enumerate() {
        let bit = u16x32::splat(simd, 1 << block);
        let low = (low & bit).simd_eq(bit).to_bitmask();
        let high = (high & bit).simd_eq(bit).to_bitmask();
        *touching = low | high << (BATCH / 2);
    }
}

/// Blends the splats with a bit in `touching` over one block, from front to back. Returns whether all pixels
/// of the block have stopped, and how many splats were blended.
///
/// Each splat has `alpha = min(cap, 2^(log2(opacity) - u² - v²))`, and adds `alpha T` of its colour; then the
/// transmittance T is multiplied by `1 - alpha` (Kerbl et al. 2023, eq. 3). A pixel stops before the splat
/// that would bring T to the stop or below.
///
/// **The transmittance that decides about stopping continues to fall after a pixel has stopped.** It never
/// rises, so that the test `after > stop` remains false without a mask, and each iteration depends on the one
/// before by a single multiply-add. The transmittance of the image is a separate value, which changes only
/// where the test holds.
#[inline(always)]
fn blend<S: Simd, const DEPTH: bool, const INSTANCES: bool>(
    simd: S,
    batch: &Batch,
    mut touching: u64,
    block: usize,
    cutoffs: &Cutoffs,
    output: &mut TileOutput<'_>,
) -> (bool, usize) {
    let sums = &mut *output.sums;
    let splat = |value: f32| f32x16::splat(simd, value);
    let load = |values: &[f32; LANES]| f32x16::load_array_ref(simd, values);
    let cap = splat(cutoffs.alpha_cap);
    let cut = splat(cutoffs.log2_alpha_cut);
    let stop = splat(cutoffs.stop);
    // Below any stop, and above the denormal numbers, which multiply slowly.
    let floor = splat(1e-20);

    // All sums in registers.
    let mut r = load(&sums.rgb[0][block]);
    let mut g = load(&sums.rgb[1][block]);
    let mut b = load(&sums.rgb[2][block]);
    let mut depth = load(&sums.depth_m[block]);
    let mut transmittance = load(&sums.transmittance[block]);
    let mut running = load(&sums.running[block]);
    let mut count = 0;
    let mut stopped = false;
    while touching != 0 {
        count += 1;
        let index = touching.trailing_zeros() as usize % BATCH;
        let matched = &batch.matched[index];
        touching &= touching - 1;

        // Alpha; 0 where it is below the cut.
        let u = load(&matched.lane_u) + splat(matched.u[block]);
        let v = load(&matched.lane_v) + splat(matched.v[block]);
        let exponent = (-v).mul_add(v, (-u).mul_add(u, splat(matched.log2_opacity)));
        let alpha = exp2(simd, exponent).min(cap);
        let alpha = exponent.simd_ge(cut).select(alpha, splat(0.0));

        // The weight; 0 in pixels that stop here or stopped before.
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
        if INSTANCES {
            let half = splat(0.5);
            let halves = counts & after.simd_le(half) & transmittance.simd_gt(half);
            let mut lanes = halves.to_bitmask();
            while lanes != 0 {
                let lane = lanes.trailing_zeros() as usize % LANES;
                output.halved_by[block][lane] = batch.places[index] + 1;
                lanes &= lanes - 1;
            }
        }
        transmittance = counts.select(after, transmittance);
        if counts.all_false() {
            stopped = true;
            break;
        }
    }
    r.store_array(&mut sums.rgb[0][block]);
    g.store_array(&mut sums.rgb[1][block]);
    b.store_array(&mut sums.rgb[2][block]);
    depth.store_array(&mut sums.depth_m[block]);
    transmittance.store_array(&mut sums.transmittance[block]);
    running.store_array(&mut sums.running[block]);
    (stopped, count)
}
