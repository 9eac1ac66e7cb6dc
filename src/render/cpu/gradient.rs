//! Gradients of the cpu backend: the stages once more, backwards.
//!
//! | step | what it does |
//! |---|---|
//! | project, bin | as for an image |
//! | rasterize | as for an image, and keeps the sums of every tile (24 B a pixel) and the sorted lists of its splats (4 B a tile of a splat) |
//! | loss | the caller's, on the images |
//! | blend backwards | macro tile by macro tile: sums for each of its splats ([`super::blend_gradient`]) |
//! | gather | the sums of a splat's macro tiles ([`super::bin::Bins::gather`]) |
//! | project backwards | from splats to Gaussians ([`super::project::gradient`]) |
//!
//! Between the steps there are 40 B for each pair of a splat and a macro tile (1.3 per splat on a
//! street), and while they are gathered 40 B for each splat of a segment: about 110 B a splat with
//! the lists. The images and their derivatives take 32 B a pixel. The limit of a frame's buffers
//! holds for splats and pairs only.
//!
//! **The bytes do not depend on threads.** A macro tile is walked by one thread, tile after tile;
//! its sums have places of their own; a segment of splats adds its macro tiles in order; and a
//! Gaussian adds its views in order. No sum is added to atomically.

use std::iter::zip;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};

use fearless_simd::{Simd, dispatch};
use parking_lot::Mutex;
use prefetch_index::prefetch_index;
use rayon::prelude::*;

use super::batch::{BATCH, Batch};
use super::bin::{Grid, MacroTile, MacroTileLists};
use super::blend_gradient::{TileDerivatives, TileWalk};
use super::drawing::Stages;
use super::overflow::PartError;
use super::project::gradient::{UnitGradients, back_project};
use super::project::{self, Job, UNIT_CLUSTERS};
use super::rasterize::{Input, TileOutput, Wants, rasterize_tile};
use super::resolve::{BLOCKS, NOT_HALVED, TileSums, block_corner};
use super::{BusyLane, Cpu, Scratch, StageTimer};
use crate::constants::{BLOCK_PX, TILE_PX};
use crate::gradient::{
    ChunkGradients, Differentiate, GaussianImages, GradientError, Gradients, LossGradient, Partial,
    Twist, check_finite, check_frame, check_sizes, mask, partial,
};
use crate::layout::Cutoffs;
use crate::stage::Stage;
use crate::{Backend, Frame, FrameStats, View};
use wildcity_scene::chunk::{CLUSTER, LANES, columns};
use wildcity_scene::geometry::Camera;

/// What the forward pass keeps of each macro tile of a view, by its number.
#[derive(Debug, Default)]
struct KeptView(Vec<Mutex<KeptMacroTile>>);

#[derive(Debug, Default)]
struct KeptMacroTile {
    /// In the order of [`Grid::macro_tile_tiles`].
    tiles: Vec<TileSums>,
    lists: MacroTileLists,
}

/// The memory of gradients, which one frame leaves to the next; empty in a backend that computes
/// none.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    views: Vec<KeptView>,
    images: Vec<GaussianImages>,
    walkers: Mutex<Vec<Box<Walker>>>,
}

/// Scratch memory of one thread.
#[derive(Debug, Default)]
struct Walker {
    macro_tile: MacroTile,
    batch: Batch,
    by: TileDerivatives,
}

/// A frame between its images and its gradients.
#[derive(Clone, Copy)]
struct Kept<'a> {
    input: Input<'a>,
    depth: bool,
    views: &'a [KeptView],
    walkers: &'a Mutex<Vec<Box<Walker>>>,
}

impl Differentiate for Cpu {
    fn differentiate(
        &self,
        frame: &Frame<'_>,
        depth: bool,
        loss: LossGradient<'_>,
        gradients: &mut Gradients,
    ) -> Result<FrameStats, GradientError> {
        check_frame(frame, self.name())?;
        // Always the main lane: whether a frame fits must not depend on other frames.
        let most_bytes = self.lane_bytes.load(Relaxed);
        let BusyLane { pool, mut scratch, .. } = self.main.take(most_bytes);
        let scratch = &mut *scratch;
        let cutoffs = Cutoffs::new(frame.profile);
        let level = self.level;
        pool.install(|| {
            let mut stats = FrameStats::default();
            let stages = Stages { level, frame, cutoffs: &cutoffs, most_bytes, classes: false };
            project::with_jobs(frame, 0, |jobs| {
                match stages.run(scratch, jobs, None, Stage::Bin, &mut stats) {
                    Err(PartError::Overflow) => {
                        return Err(GradientError::Memory { limit_bytes: most_bytes });
                    }
                    Err(PartError::Render(error)) => return Err(error.into()),
                    Ok(()) => {}
                }
                let Scratch { projected, bins, gradient, .. } = &mut *scratch;
                let projected = &*projected;
                let bins = &*bins;
                let Buffers { views: kept, images, walkers } = gradient;
                let views = frame.views;
                kept.resize_with(views.len(), KeptView::default);
                for (kept, view) in zip(&mut *kept, views) {
                    kept.0.resize_with(Grid::new(view).macro_tiles(), Mutex::default);
                }
                let cutoffs = &cutoffs;
                let backgrounds = &[];
                let input = Input { projected, bins, views, shown: views, backgrounds, cutoffs };
                let kept = Kept { input, depth, views: &*kept, walkers: &*walkers };
                let mut timer = StageTimer::start();
                stats.evaluations = dispatch!(level, simd => kept.rasterize(simd));
                images.resize_with(views.len(), GaussianImages::default);
                for ((images, kept), view) in zip(zip(&mut *images, kept.views), views) {
                    kept.write_images(view, depth, images);
                    mask(view, images);
                }
                timer.finish("rasterize", &mut stats);
                let mut by_images = loss(images);
                timer.finish("loss", &mut stats);
                check_sizes(frame, depth, &mut by_images)?;
                gradients.reset(frame.scene, views.len());
                timer.finish("check", &mut stats);
                for (view, by_images) in by_images.iter().enumerate() {
                    let by_macro_tile =
                        dispatch!(level, simd => kept.blend_backwards(simd, view, by_images))?;
                    timer.finish("blend backwards", &mut stats);
                    let units = units(&mut gradients.chunks);
                    let twists = bins.gather(view, projected, &by_macro_tile, |jobs_of, sums| {
                        let mut twist = Twist::default();
                        for (unit, job) in zip(&projected.units()[jobs_of.clone()], &jobs[jobs_of])
                        {
                            let by_splats = sums.splats(projected.first_place(unit), unit.len);
                            let mut unit = unit_of_job(&units, job).lock();
                            twist += back_project(level, job, cutoffs, by_splats, &mut unit);
                        }
                        twist
                    });
                    // In the order of the segments.
                    for twist in twists {
                        gradients.twists[view] += twist;
                    }
                    timer.finish("project backwards", &mut stats);
                }
                Ok(())
            })?;
            Ok(stats)
        })
    }
}

/// The derivatives by the Gaussians of each unit of each chunk.
fn units(chunks: &mut [ChunkGradients]) -> Vec<Vec<Mutex<UnitGradients<'_>>>> {
    chunks.iter_mut().map(units_of_chunk).collect()
}

fn units_of_chunk(chunk: &mut ChunkGradients) -> Vec<Mutex<UnitGradients<'_>>> {
    let groups = UNIT_CLUSTERS * CLUSTER / LANES;
    let width = columns(chunk.sh_degree());
    let lanes = chunk.lanes.chunks_mut(groups * width);
    let unit = |(lanes, visible)| Mutex::new(UnitGradients { lanes, visible });
    lanes.zip(chunk.visible.chunks_mut(groups)).map(unit).collect()
}

/// Each job of a view has a unit of its own, so that this lock never waits.
fn unit_of_job<'a, 'b>(
    units: &'a [Vec<Mutex<UnitGradients<'b>>>],
    job: &Job<'_>,
) -> &'a Mutex<UnitGradients<'b>> {
    &units[job.number][job.clusters.start / UNIT_CLUSTERS]
}

impl Kept<'_> {
    /// Draws all views, and keeps what the way back needs. Returns the number of evaluations.
    #[inline(always)]
    fn rasterize<S: Simd>(&self, simd: S) -> u64 {
        // A sum only, which no other data depends on: relaxed order is enough.
        let evaluations = AtomicU64::new(0);
        for view in 0..self.views.len() {
            self.input.bins.by_work(view).into_par_iter().with_max_len(1).for_each(|number| {
                let mut walker = self.walkers.lock().pop().unwrap_or_default();
                let own = simd.vectorize(
                    #[inline(always)]
                    || self.rasterize_macro_tile(simd, view, number, &mut walker),
                );
                evaluations.fetch_add(own, Relaxed);
                self.walkers.lock().push(walker);
            });
        }
        evaluations.into_inner()
    }

    #[inline(always)]
    fn rasterize_macro_tile<S: Simd>(
        &self,
        simd: S,
        view: usize,
        number: usize,
        walker: &mut Walker,
    ) -> u64 {
        let Walker { macro_tile, batch, .. } = walker;
        let Input { bins, projected, views, .. } = self.input;
        bins.load(view, number, macro_tile);
        macro_tile.copy_splats(projected);
        let mut kept = self.views[view].0[number].lock();
        kept.tiles.clear();
        let wants = Wants { depth: self.depth, owners: false };
        let mut evaluations = 0;
        for (within, [column, row]) in Grid::new(&views[view]).macro_tile_tiles(number) {
            let mut sums = TileSums::default();
            let mut live = u16::MAX;
            let mut halved_by = NOT_HALVED;
            let mut output =
                TileOutput { sums: &mut sums, live: &mut live, halved_by: &mut halved_by, wants };
            let at_px = [column * TILE_PX, row * TILE_PX];
            evaluations +=
                rasterize_tile(simd, self.input, macro_tile, within, at_px, batch, &mut output);
            kept.tiles.push(sums);
        }
        macro_tile.copy_lists(&mut kept.lists);
        evaluations
    }

    /// The sums of every pair of every macro tile of a view.
    ///
    /// # Errors
    /// A derivative that is not finite.
    #[inline(always)]
    fn blend_backwards<S: Simd>(
        &self,
        simd: S,
        view: usize,
        by_images: &GaussianImages,
    ) -> Result<Vec<Vec<Partial>>, GradientError> {
        let macro_tiles = &self.views[view].0;
        let sums: Vec<Mutex<Vec<Partial>>> = macro_tiles.iter().map(|_| Mutex::default()).collect();
        let is_finite = AtomicBool::new(true);
        self.input.bins.by_work(view).into_par_iter().with_max_len(1).for_each(|number| {
            let mut walker = self.walkers.lock().pop().unwrap_or_default();
            let partials = simd.vectorize(
                #[inline(always)]
                || self.walk_macro_tile(simd, view, number, by_images, &mut walker),
            );
            match partials {
                Some(partials) => *sums[number].lock() = partials,
                None => is_finite.store(false, Relaxed),
            }
            self.walkers.lock().push(walker);
        });
        if !is_finite.into_inner() {
            // The walk has found that a value is not finite; this finds which one.
            check_finite(view, by_images)?;
        }
        Ok(sums.into_iter().map(Mutex::into_inner).collect())
    }

    /// `None` if a derivative by its pixels is not finite: they are read here, and nowhere else.
    #[inline(always)]
    fn walk_macro_tile<S: Simd>(
        &self,
        simd: S,
        view: usize,
        number: usize,
        by_images: &GaussianImages,
        walker: &mut Walker,
    ) -> Option<Vec<Partial>> {
        let Walker { macro_tile, batch, by } = walker;
        let Input { bins, projected, views, cutoffs, .. } = self.input;
        let kept = self.views[view].0[number].lock();
        bins.load_with_lists(view, number, &kept.lists, macro_tile);
        macro_tile.copy_splats(projected);
        let mut partials = vec![[0.0; partial::COUNT]; macro_tile.len()];
        let grid = Grid::new(&views[view]);
        let has_depth = !by_images.depth_sum_m.is_empty();
        let mut tiles = grid.macro_tile_tiles(number).zip(&kept.tiles).peekable();
        while let Some(((within, [column, row]), sums)) = tiles.next() {
            let at_px = [column * TILE_PX, row * TILE_PX];
            by.read(by_images, &views[view], at_px);
            // Those of the next tile arrive while this one is walked.
            if let Some(((_, next), sums)) = tiles.peek() {
                prefetch(by_images, &views[view], next.map(|tile| tile * TILE_PX), sums);
            }
            let mut walk = if has_depth {
                TileWalk::new::<S, true>(simd, sums, by)
            } else {
                TileWalk::new::<S, false>(simd, sums, by)
            };
            if !walk.is_finite {
                return None;
            }
            for indices in macro_tile.tile(within).chunks(BATCH) {
                // All pixels have stopped, as they had when the tile was drawn.
                if walk.live == 0 {
                    break;
                }
                batch.read(macro_tile, projected, indices);
                batch.match_blocks(simd, cutoffs, indices.len(), at_px);
                for (k, &index) in indices.iter().enumerate() {
                    // `k` is below BATCH; the remainder shows this to the compiler, which then
                    // tests no index.
                    let touching = batch.blocks[k % BATCH] & walk.live;
                    if touching == 0 {
                        continue;
                    }
                    let matched = &batch.matched[k % BATCH];
                    let sums = if has_depth {
                        walk.pass::<S, true>(simd, matched, touching, cutoffs, by)
                    } else {
                        walk.pass::<S, false>(simd, matched, touching, cutoffs, by)
                    };
                    for (to, value) in partials[index as usize].iter_mut().zip(sums) {
                        *to += value;
                    }
                }
            }
        }
        Some(partials)
    }
}

impl KeptView {
    /// Writes the images of a view.
    fn write_images(&self, view: &View, depth: bool, images: &mut GaussianImages) {
        let pixels = view.camera.pixels();
        images.rgb.resize(3 * pixels, 0.0);
        images.opacity.resize(pixels, 0.0);
        images.depth_sum_m.resize(if depth { pixels } else { 0 }, 0.0);
        // The macro tile of each tile, and its place within that.
        let grid = Grid::new(view);
        let mut places = vec![(0, 0); grid.tiles()];
        for number in 0..self.0.len() {
            for (place, (_, [column, row])) in grid.macro_tile_tiles(number).enumerate() {
                places[(row * grid.columns + column) as usize] = (number, place);
            }
        }
        // A row of tiles at a time.
        let band = view.camera.width_px as usize * TILE_PX as usize;
        let depths = images.depth_sum_m.par_chunks_mut(band);
        let bands = images.rgb.par_chunks_mut(3 * band).zip(images.opacity.par_chunks_mut(band));
        let write = |row: usize, rgb: &mut [f32], opacity: &mut [f32], depth_m: &mut [f32]| {
            for column in 0..grid.columns {
                let (number, place) = places[row * grid.columns as usize + column as usize];
                let kept = self.0[number].lock();
                let at_px = [column * TILE_PX, row as u32 * TILE_PX];
                kept.tiles[place].write(view, at_px, rgb, opacity, depth_m);
            }
        };
        if depth {
            let bands = bands.zip(depths).enumerate();
            bands.for_each(|(row, ((rgb, opacity), depth_m))| write(row, rgb, opacity, depth_m));
        } else {
            bands.enumerate().for_each(|(row, (rgb, opacity))| write(row, rgb, opacity, &mut []));
        }
    }
}

impl TileSums {
    /// Writes the tile at `at_px` into its row of tiles.
    fn write(
        &self,
        view: &View,
        at_px: [u32; 2],
        rgb: &mut [f32],
        opacity: &mut [f32],
        depth_m: &mut [f32],
    ) {
        for_each_span(view, at_px, |Span { pixel, block, lane, len }| {
            // The row of tiles begins at its first pixel.
            let pixel = pixel - (at_px[1] * view.camera.width_px) as usize;
            for k in 0..len {
                for channel in 0..3 {
                    rgb[3 * (pixel + k) + channel] = self.rgb[channel][block][lane + k];
                }
                opacity[pixel + k] = 1.0 - self.transmittance[block][lane + k];
            }
            if !depth_m.is_empty() {
                depth_m[pixel..pixel + len].copy_from_slice(&self.depth_m[block][lane..lane + len]);
            }
        });
    }
}

impl TileDerivatives {
    /// Reads the tile at `at_px`; 0 beyond the image.
    #[inline(always)]
    fn read(&mut self, images: &GaussianImages, view: &View, at_px: [u32; 2]) {
        let [right, bottom] = at_px.map(|px| px + TILE_PX);
        if right > view.camera.width_px || bottom > view.camera.height_px {
            // A tile within the image overwrites all values; beyond the edge the 0 remains.
            *self = Self::default();
        }
        let has_depth = !images.depth_sum_m.is_empty();
        for_each_span(
            view,
            at_px,
            #[inline(always)]
            |Span { pixel, block, lane, len }| {
                let rgb = &images.rgb[3 * pixel..3 * (pixel + len)];
                for channel in 0..3 {
                    // A whole row at once: shuffles of vectors, where one value after the other
                    // took a tenth of the walk.
                    let to = &mut self.rgb[channel][block][lane..lane + len];
                    match (rgb.first_chunk::<12>(), to.first_chunk_mut::<4>()) {
                        (Some(rgb), Some(to)) => *to = [0, 3, 6, 9].map(|k| rgb[k + channel]),
                        _ => {
                            to.iter_mut().enumerate().for_each(|(k, to)| *to = rgb[3 * k + channel])
                        }
                    }
                }
                self.opacity[block][lane..lane + len]
                    .copy_from_slice(&images.opacity[pixel..pixel + len]);
                if has_depth {
                    self.depth_m[block][lane..lane + len]
                        .copy_from_slice(&images.depth_sum_m[pixel..pixel + len]);
                }
            },
        );
    }
}

/// Fetches the derivatives of the tile at `at_px`, and its sums, into the cache.
#[inline(always)]
fn prefetch(images: &GaussianImages, view: &View, at_px: [u32; 2], sums: &TileSums) {
    // Values of a cache line.
    const LINE: usize = 16;
    let [left, top] = at_px.map(|px| px as usize);
    for y in top..top + TILE_PX as usize {
        let pixel = y * view.camera.width_px as usize + left;
        for line in 0..3 {
            prefetch_index(&images.rgb, 3 * pixel + line * LINE);
        }
        prefetch_index(&images.opacity, pixel);
        prefetch_index(&images.depth_sum_m, pixel);
    }
    for block in 0..BLOCKS {
        for channel in &sums.rgb {
            prefetch_index(channel, block);
        }
        prefetch_index(sums.transmittance, block);
    }
}

/// Pixels of one row of a block.
struct Span {
    /// Index of its first pixel in the image; the lane is that of this pixel, too.
    pixel: usize,
    block: usize,
    lane: usize,
    len: usize,
}

/// Calls `work` with the rows of the blocks of the tile at `at_px`, as far as they are on the
/// image.
#[inline(always)]
fn for_each_span(view: &View, at_px: [u32; 2], mut work: impl FnMut(Span)) {
    let Camera { width_px: width, height_px: height, .. } = view.camera;
    for block in 0..BLOCKS {
        let corner = block_corner(block);
        let left = at_px[0] + corner[0];
        let top = at_px[1] + corner[1];
        let len = width.saturating_sub(left).min(BLOCK_PX) as usize;
        for y in top..height.min(top + BLOCK_PX) {
            let lane = ((y - top) * BLOCK_PX) as usize;
            let pixel = (y * width + left) as usize;
            // Nearly all rows are whole: a length that is known makes a few vector moves of them.
            if len == BLOCK_PX as usize {
                work(Span { pixel, block, lane, len: BLOCK_PX as usize });
            } else if len > 0 {
                work(Span { pixel, block, lane, len });
            }
        }
    }
}
