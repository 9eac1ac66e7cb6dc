//! Stage rasterize: each tile of 16 x 16 pixels blends its splats from front to back.
//!
//! **A thread draws one macro tile at a time**, with copies of its splats in the caches of its core
//! ([`MacroTile`]). Those with the most work are taken first, so that threads end at nearly the
//! same time.
//!
//! **The 16 lanes of a vector are a block of 4 x 4 pixels, not a row of 16.** On the benchmark
//! street a splat touches 10.5 rows of a tile on average, but only 8 blocks, which saves a third of
//! the evaluations.
//!
//! **Splats are matched in batches of 64** ([`Batch`]). Each block then blends the splats that
//! touch it ([`blend`]).

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Instant;

use fearless_simd::{Level, Simd, dispatch};
use parking_lot::Mutex;
use rayon::prelude::*;

use super::appearance;
use super::background::Background;
use super::batch::{BATCH, Batch};
use super::bin::{Bins, Grid, MacroTile};
use super::blend::blend;
use super::project::Projected;
use super::resolve::{
    self, BLOCKS, Band, HalvedBy, NOT_HALVED, SampleOwners, TilePixels, TileSums,
};
use super::unfinished::{Continued, UnfinishedTile};
use crate::constants::TILE_PX;
use crate::layout::Cutoffs;
use crate::samples::is_sampled;
use crate::{OnViewDone, Target, View};
use wildcity_scene::appearance::Appearance;
use wildcity_scene::chunk::LANES;

/// The outputs of the previous stages.
#[derive(Clone, Copy)]
pub(super) struct Input<'a> {
    pub(super) projected: &'a Projected,
    pub(super) bins: &'a Bins,
    /// Those of the samples, where pixels have several.
    pub(super) views: &'a [View],
    /// The views of the images.
    pub(super) shown: &'a [View],
    /// One per view, or none.
    pub(super) backgrounds: &'a [Background],
    pub(super) cutoffs: &'a Cutoffs,
}

/// Unused scratch memory, which threads keep from macro tile to macro tile.
#[derive(Debug, Default)]
pub(super) struct Scratches(Mutex<Vec<Box<Scratch>>>);

impl Scratches {
    /// Frees the scratch memory of threads if it is more than `most_bytes`.
    pub(super) fn trim(&mut self, most_bytes: u64) {
        let scratches = self.0.get_mut();
        let bytes: usize = scratches.iter().map(|scratch| scratch.macro_tile.held_bytes()).sum();
        if bytes as u64 > most_bytes {
            scratches.clear();
        }
    }
}

/// The scratch memory of one thread.
#[derive(Debug, Default)]
struct Scratch {
    macro_tile: MacroTile,
    batch: Batch,
}

/// The work that was done.
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
    is_sampled: bool,
    wants: Wants,
    /// Exposure and overlay of the camera; `None` if they change nothing.
    appearance: Option<&'a Appearance>,
    background: Option<&'a Background>,
    /// One per row of tiles.
    bands: Vec<Mutex<Band<'a>>>,
}

/// Sorts and draws all views, and calls `on_view_done` as each is complete. A slab has one view,
/// which is complete after the last slab.
pub(super) fn rasterize(
    level: Level,
    input: Input<'_>,
    continued: Option<Continued<'_>>,
    scratches: &Scratches,
    targets: &mut [Target<'_>],
    on_view_done: OnViewDone<'_>,
) -> Work {
    // Sums only, which no other data depends on: relaxed order is enough.
    let [evaluations, sort_ns, rasterize_ns] = [const { AtomicU64::new(0) }; 3];
    targets.par_iter_mut().zip(input.shown).enumerate().with_max_len(1).for_each(
        |(index, (target, shown))| {
            let view = &input.views[index];
            let drawing = Drawing {
                view: index,
                grid: Grid::new(view),
                is_sampled: is_sampled(view, shown),
                wants: Wants {
                    depth: target.depth_m.is_some(),
                    owners: target.instances.is_some() || target.semantics.is_some(),
                },
                appearance: resolve::appearance(target),
                background: input.backgrounds.get(index),
                bands: resolve::bands(target, shown).into_iter().map(Mutex::new).collect(),
            };
            // `par_bridge` hands them out in this order.
            input.bins.by_work(index).into_iter().par_bridge().for_each(|number| {
                // A list and not thread-local memory, so that the backend bounds it between frames.
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
            // The bands borrow the target's buffers, which `finish` and the caller need as a whole.
            drop(drawing);
            if continued.is_none_or(|slab| slab.is_last) {
                target.finish(shown);
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

/// The values that are accumulated in addition to colours and transmittance.
#[derive(Clone, Copy)]
pub(super) struct Wants {
    pub(super) depth: bool,
    /// Whose Gaussian halves the transmittance of each pixel.
    pub(super) owners: bool,
}

/// The accumulated values of one tile.
pub(super) struct TileOutput<'a> {
    pub(super) sums: &'a mut TileSums,
    /// A bit for each block in which some pixel has not stopped.
    pub(super) live: &'a mut u16,
    pub(super) halved_by: &'a mut HalvedBy,
    pub(super) wants: Wants,
}

/// Sorts and draws one macro tile of one view, and resolves its tiles into the target's bands after
/// the last slab.
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
    // Every macro tile is drawn once per slab, so that this lock never waits.
    let mut unfinished = continued.map(|slab| slab.tiles.0[number].lock());
    let is_last = continued.is_none_or(|slab| slab.is_last);
    input.bins.load(view, number, macro_tile);
    // Nothing changes. In the last slab its tiles are resolved nevertheless: they show the
    // background, or what earlier slabs have drawn.
    if !is_last && macro_tile.is_empty() {
        return Work::default();
    }
    let sorted = Instant::now();
    macro_tile.copy_splats(input.projected);

    // Once per macro tile and not per tile, since it is allocated for a sky network.
    let mut sky_scratch = background.and_then(Background::scratch);
    let mut halved_by = NOT_HALVED;
    let mut means = TileSums::default();
    let mut evaluations = 0;
    // Tiles of earlier slabs.
    let has_sums = unfinished.as_ref().is_some_and(|tiles| !tiles.is_empty());
    if let (false, false, Some(tiles)) = (is_last, has_sums, &mut unfinished) {
        // A vector that grows by doubling would exceed the reserved bytes.
        tiles.reserve_exact(drawing.grid.macro_tile_tiles(number).count());
    }
    for (index, (within, [column, row])) in drawing.grid.macro_tile_tiles(number).enumerate() {
        let at_px = [column * TILE_PX, row * TILE_PX];
        let mut sums = TileSums::default();
        let mut live = u16::MAX;
        let mut owners = None;
        if let (true, Some(tiles)) = (has_sums, &mut unfinished) {
            sums = tiles[index].sums;
            live = tiles[index].live;
            owners = tiles[index].owners.take();
        }
        let mut output =
            TileOutput { sums: &mut sums, live: &mut live, halved_by: &mut halved_by, wants };
        evaluations += rasterize_tile(simd, input, macro_tile, within, at_px, batch, &mut output);
        let pixels = TilePixels::new([column, row], drawing.is_sampled);
        // In every slab: places of splats are those of this slab's projection.
        if wants.owners && drawing.is_sampled {
            let owners = owners.get_or_insert_with(Box::<SampleOwners>::default);
            owners.note(&halved_by, input.projected);
            halved_by = NOT_HALVED;
        } else if wants.owners {
            let mut band = drawing.bands[pixels.band].lock();
            band.write_owners(&halved_by, at_px[0], input.projected, has_sums);
            halved_by = NOT_HALVED;
        }
        if let (false, Some(tiles)) = (is_last, &mut unfinished) {
            let tile = UnfinishedTile { sums, live, owners };
            if has_sums {
                tiles[index] = tile
            } else {
                tiles.push(tile)
            }
            continue;
        }
        // From here on the tile's sums are final.
        let sums = if drawing.is_sampled {
            sums.write_means(&pixels, wants.depth, &mut means);
            &mut means
        } else {
            &mut sums
        };
        if let Some(background) = background {
            background.add(simd, &pixels, &mut sky_scratch, sums);
        }
        if let Some(appearance) = drawing.appearance {
            appearance::apply(simd, appearance, &pixels, sums);
        }
        let mut band = drawing.bands[pixels.band].lock();
        if let Some(owners) = owners {
            band.write_sampled_owners(&owners, &pixels);
        }
        resolve::resolve(simd, sums, &pixels, &mut band);
    }
    Work {
        evaluations,
        sort_ns: (sorted - start).as_nanos() as u64,
        rasterize_ns: sorted.elapsed().as_nanos() as u64,
    }
}

/// Blends the splats of one tile, batch by batch, until all of its blocks are opaque.
#[inline(always)]
pub(super) fn rasterize_tile<S: Simd>(
    simd: S,
    input: Input<'_>,
    macro_tile: &MacroTile,
    within: usize,
    at_px: [u32; 2],
    batch: &mut Batch,
    output: &mut TileOutput<'_>,
) -> u64 {
    // Invariant: `live` has a bit for each block in which some pixel can still change.
    let mut live = *output.live;
    let mut evaluations = 0;
    for indices in macro_tile.tile(within).chunks(BATCH) {
        if live == 0 {
            break;
        }
        batch.read(macro_tile, input.projected, indices);
        batch.match_blocks(simd, input.cutoffs, indices.len(), at_px);
        batch.transpose(simd);
        if output.wants.owners {
            for (place, &index) in batch.places.iter_mut().zip(indices) {
                *place = macro_tile.place(index);
            }
        }
        for block in 0..BLOCKS {
            if batch.touching[block] == 0 || live >> block & 1 == 0 {
                continue;
            }
            // Four compiled forms of the loop, without a branch on what is wanted in it.
            let TileOutput { sums, halved_by, wants, .. } = &mut *output;
            let cutoffs = input.cutoffs;
            let (stopped, count) = match *wants {
                Wants { depth: false, owners: false } => {
                    blend::<S, false, false>(simd, batch, block, cutoffs, sums, halved_by)
                }
                Wants { depth: true, owners: false } => {
                    blend::<S, true, false>(simd, batch, block, cutoffs, sums, halved_by)
                }
                Wants { depth: false, owners: true } => {
                    blend::<S, false, true>(simd, batch, block, cutoffs, sums, halved_by)
                }
                Wants { depth: true, owners: true } => {
                    blend::<S, true, true>(simd, batch, block, cutoffs, sums, halved_by)
                }
            };
            // `stopped` as 0 or 1: a block's bit is cleared without a branch.
            live &= !(u16::from(stopped) << block);
            evaluations += count as u64 * LANES as u64;
        }
    }
    *output.live = live;
    evaluations
}
