//! Stage bin: for every tile, the splats that can touch it, from the nearest.
//!
//! Blocks of sorted splats are walked twice. The first walk finds each splat's spans of tiles, keeps
//! them, and counts; the second only unpacks them, so the two cannot disagree. A prefix sum over
//! (tile, block) gives every block its own places, so the lists do not depend on the schedule.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::project::Projected;
use super::sort::Sorted;
use crate::constants::{EXTENT_SLACK_PX, MAX_INSTANCES, TILE_PX};
use crate::layout::{Cutoffs, Splat};
use crate::{RenderError, View};

/// Splats of a parallel block: enough to outweigh its histogram of a view's tiles.
const BLOCK: usize = 1 << 14;

/// Splats read at a time.
const GATHER: usize = 64;

/// The splats of a frame by tile.
#[derive(Debug, Default)]
pub(super) struct Bins {
    /// Places of splats in the projection, tile after tile. Atomic so that blocks can fill their
    /// places side by side without unsafe code; a relaxed store is an ordinary store.
    instances: Vec<AtomicU32>,
    /// How many of `instances` are of this frame.
    used: usize,
    /// Where each tile's list starts, and the end of the last.
    starts: Vec<u32>,
    /// First tile of each view.
    first_tile: Vec<usize>,
    blocks: Vec<Block>,
}

/// What a block of sorted splats keeps from the first walk for the second.
#[derive(Debug, Default)]
struct Block {
    spans: Vec<Span>,
    /// Per tile of the block's view: how many instances, then where the next one goes.
    cursors: Vec<u32>,
}

/// A row of tiles that a splat touches: first tile (20 bits), tiles (11 bits), last of its splat.
///
/// An image of 16,384 x 16,384 px has 2^20 tiles, 1,024 in a row.
#[derive(Clone, Copy, Debug)]
struct Span(u32);

impl Span {
    const LAST: u32 = 1 << 31;

    #[inline(always)]
    fn new(first_tile: u32, tiles: u32) -> Self {
        Self(first_tile | tiles << 20)
    }

    #[inline(always)]
    fn tiles(self) -> std::ops::Range<usize> {
        let first = (self.0 & 0xF_FFFF) as usize;
        first..first + (self.0 >> 20 & 0x7FF) as usize
    }

    #[inline(always)]
    fn is_last(self) -> bool {
        self.0 & Self::LAST != 0
    }
}

/// A view's grid of tiles.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    /// Image size, in pixels.
    size_px: [u32; 2],
    /// Tiles per row.
    pub(super) columns: u32,
    /// Rows of tiles.
    pub(super) rows: u32,
}

impl Grid {
    /// The tiles of a view; the last ones of a row and of a column may be cut.
    pub(super) fn new(view: &View) -> Self {
        let size_px = [view.camera.width_px, view.camera.height_px];
        let [columns, rows] = size_px.map(|size| size.div_ceil(TILE_PX));
        Self { size_px, columns, rows }
    }

    fn tiles(&self) -> usize {
        self.columns as usize * self.rows as usize
    }
}

impl Bins {
    /// Bins all splats of a frame.
    ///
    /// # Errors
    /// More than [`MAX_INSTANCES`] pairs.
    pub(super) fn bin(
        &mut self,
        level: Level,
        projected: &Projected,
        sorted: &Sorted,
        views: &[View],
        cutoffs: &Cutoffs,
    ) -> Result<(), RenderError> {
        let grids: Vec<Grid> = views.iter().map(Grid::new).collect();
        let jobs: Vec<(usize, &[u64])> = (0..views.len())
            .flat_map(|view| sorted.view(view).chunks(BLOCK).map(move |keys| (view, keys)))
            .collect();
        if self.blocks.len() < jobs.len() {
            self.blocks.resize_with(jobs.len(), Block::default);
        }

        let total = AtomicU64::new(0);
        let blocks = self.blocks.par_iter_mut().zip(&jobs);
        blocks.for_each_init(Vec::new, |spans, (block, (view, keys))| {
            // Beyond the limit the frame fails whatever the rest holds: gather no more of it.
            if total.load(Relaxed) > MAX_INSTANCES {
                return;
            }
            let grid = &grids[*view];
            block.cursors.clear();
            block.cursors.resize(grid.tiles(), 0);
            spans.clear();
            let cut = cutoffs.log2_alpha_cut;
            dispatch!(level, _ => count(projected, keys, grid, cut, spans, &mut block.cursors));
            block.spans.clear();
            block.spans.reserve_exact(spans.len());
            block.spans.extend_from_slice(spans);
            let count: u64 = block.cursors.iter().map(|&count| u64::from(count)).sum();
            total.fetch_add(count, Relaxed);
        });
        if total.into_inner() > MAX_INSTANCES {
            let what = "(Gaussian, tile) pairs";
            return Err(RenderError::TooMany { what, limit: MAX_INSTANCES });
        }

        self.place(&jobs, &grids);

        self.blocks.par_iter_mut().zip(&jobs).for_each(|(block, (_, keys))| {
            emit(keys, &block.spans, &mut block.cursors, &self.instances);
        });
        Ok(())
    }

    /// Turns counts into places, tile by tile and within a tile block by block.
    fn place(&mut self, jobs: &[(usize, &[u64])], grids: &[Grid]) {
        self.starts.clear();
        self.first_tile.clear();
        let mut total = 0;
        let mut rest = &mut self.blocks[..jobs.len()];
        for (view, grid) in grids.iter().enumerate() {
            let count = jobs.iter().filter(|(of, _)| *of == view).count();
            let (blocks, after) = rest.split_at_mut(count);
            rest = after;
            self.first_tile.push(self.starts.len());
            for tile in 0..grid.tiles() {
                self.starts.push(total);
                for block in &mut *blocks {
                    let count = block.cursors[tile];
                    block.cursors[tile] = total;
                    total += count;
                }
            }
        }
        self.starts.push(total);
        self.used = total as usize;
        if self.instances.len() < self.used {
            // An eighth to spare, not as much again: a drive's frames differ by little.
            let wanted = self.used + self.used / 8;
            self.instances.reserve_exact(wanted - self.instances.len());
            self.instances.resize_with(wanted, AtomicU32::default);
        }
    }

    /// (Gaussian, tile) pairs of the frame.
    pub(super) fn instances(&self) -> usize {
        self.used
    }

    /// Where each tile's list starts, all views one after the other, and the end of the last.
    pub(super) fn starts(&self) -> &[u32] {
        &self.starts
    }

    /// The lists of all tiles, one after the other: places in the projection.
    pub(super) fn places(&self) -> impl Iterator<Item = u32> {
        self.instances[..self.used].iter().map(|place| place.load(Relaxed))
    }

    /// Places in the projection of the splats of one tile of one view, from the nearest.
    pub(super) fn tile(&self, view: usize, tile: usize) -> &[AtomicU32] {
        let tile = self.first_tile[view] + tile;
        &self.instances[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }
}

/// Finds a block's spans, and counts its instances per tile.
#[inline(always)]
fn count(
    projected: &Projected,
    keys: &[u64],
    grid: &Grid,
    log2_cut: f32,
    spans: &mut Vec<Span>,
    counts: &mut [u32],
) {
    // Read a few, then walk them: side by side, their cache misses cost little more than one.
    let mut splats = [Splat::default(); GATHER];
    for keys in keys.chunks(GATHER) {
        for (splat, &key) in splats.iter_mut().zip(keys) {
            *splat = *projected.splat(key as u32);
        }
        for splat in &splats[..keys.len()] {
            let before = spans.len();
            for_each_span(
                splat,
                grid,
                log2_cut,
                #[inline(always)]
                |span| {
                    spans.push(span);
                    counts[span.tiles()].iter_mut().for_each(|count| *count += 1);
                },
            );
            // Slack may choose a splat that touches no pixel's centre: its one span is empty.
            if spans.len() == before {
                spans.push(Span::new(0, 0));
            }
            if let Some(last) = spans.last_mut() {
                last.0 |= Span::LAST;
            }
        }
    }
}

/// Writes a block's instances where its cursors say.
fn emit(keys: &[u64], spans: &[Span], cursors: &mut [u32], instances: &[AtomicU32]) {
    let mut spans = spans.iter();
    for &key in keys {
        for span in spans.by_ref() {
            for cursor in &mut cursors[span.tiles()] {
                instances[*cursor as usize].store(key as u32, Relaxed);
                *cursor += 1;
            }
            if span.is_last() {
                break;
            }
        }
    }
}

/// Calls `visit` for every row of tiles that the ellipse `u² + v² <= power` touches.
///
/// Within a band of rows the ellipse's right edge `x(dy) = s dy + √(power - (l2 dy)²)/l0`, with
/// `s = -l1/l0`, is concave: its maximum lies at `dy* = s (power/l2²)/extent_x` or at the end of
/// the band nearest to it. The left edge mirrors it. (Speedy-Splat, Hanson et al. 2025, finds the
/// same set by walking the ellipse's bounds.)
#[inline(always)]
fn for_each_span(splat: &Splat, grid: &Grid, log2_cut: f32, mut visit: impl FnMut(Span)) {
    let ([x, y], [extent_x, extent_y]) = (splat.mean_px, splat.extent_px);
    let last = grid.size_px.map(|size| size as i32 - 1);
    let (left, right) = pixels(x, -extent_x, extent_x, last[0]);
    let (top, bottom) = pixels(y, -extent_y, extent_y, last[1]);
    if left > right || top > bottom {
        return;
    }
    let tile = TILE_PX as i32;
    let span = |row: i32, left: i32, right: i32| {
        let (first, last) = ((left / tile) as u32, (right / tile) as u32);
        Span::new(row as u32 * grid.columns + first, last - first + 1)
    };
    let (first_row, last_row) = (top / tile, bottom / tile);
    if left / tile == right / tile || first_row == last_row {
        for row in first_row..=last_row {
            visit(span(row, left, right));
        }
        return;
    }

    let [l0, l1, l2] = splat.factor;
    let power = splat.log2_opacity - log2_cut;
    let inverse_l0 = 1.0 / l0;
    let skew = -l1 * inverse_l0;
    let widest_dy = skew * power / (l2 * l2 * extent_x);
    let half_width = |dy: f32| (power - (l2 * dy) * (l2 * dy)).max(0.0).sqrt() * inverse_l0;
    for row in first_row..=last_row {
        let band_top = ((row * tile) as f32 + 0.5 - y).max(-extent_y);
        let band_bottom = ((row * tile + tile - 1) as f32 + 0.5 - y).min(extent_y).max(band_top);
        let right_dy = widest_dy.clamp(band_top, band_bottom);
        let left_dy = (-widest_dy).clamp(band_top, band_bottom);
        let high = skew * right_dy + half_width(right_dy) + EXTENT_SLACK_PX;
        let low = skew * left_dy - half_width(left_dy) - EXTENT_SLACK_PX;
        let (left, right) = pixels(x, low, high, last[0]);
        if left <= right {
            visit(span(row, left, right));
        }
    }
}

/// First and last pixel with its centre, at +0.5, between `center + low` and `center + high`.
///
/// Float to int saturates, so the largest splat is no exception.
#[inline(always)]
fn pixels(center: f32, low: f32, high: f32, last: i32) -> (i32, i32) {
    let first = ((center + low - 0.5).ceil() as i32).max(0);
    (first, ((center + high - 0.5).floor() as i32).min(last))
}
