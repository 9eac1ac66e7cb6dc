//! Stage bin: for every tile, the splats that can touch it, from the nearest.
//!
//! Two passes over the sorted splats, count and emit, call one function on the same bytes, so they
//! cannot disagree. Blocks of splats run in parallel; a prefix sum over (tile, block) gives every
//! block its own places, so the lists do not depend on the schedule.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::project::Projected;
use super::sort::Sorted;
use crate::render::constants::{EXTENT_SLACK_PX, MAX_INSTANCES, TILE_PX};
use crate::render::layout::{Cutoffs, Splat};
use crate::render::{RenderError, View};

/// Splats of a parallel block: enough to outweigh its histogram of a view's tiles.
const BLOCK: usize = 1 << 14;

/// Splats copied at a time.
const GATHER: usize = 64;

/// The splats of a frame by tile.
#[derive(Debug, Default)]
pub(super) struct Bins {
    /// All splats of this frame, view after view, each from the nearest; more room behind.
    splats: Vec<Splat>,
    /// Indices into `splats`, tile after tile. Atomic so that blocks can fill their places side by
    /// side without unsafe code; a relaxed store is an ordinary store.
    instances: Vec<AtomicU32>,
    /// How many of `instances` are of this frame.
    used: usize,
    /// Where each tile's list starts, and the end of the last.
    starts: Vec<u32>,
    /// First tile of each view.
    first_tile: Vec<usize>,
    /// Per block, where its next instance of each tile of its view goes.
    cursors: Vec<Vec<u32>>,
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
        if self.splats.len() < sorted.len() {
            let wanted = sorted.len() + sorted.len() / 8;
            self.splats.reserve_exact(wanted - self.splats.len());
            self.splats.resize(wanted, Splat::default());
        }

        // Count: put the splats in order, and count each block's instances per tile.
        let mut blocks = Vec::new();
        let mut rest = self.splats.as_mut_slice();
        for (view, grid) in grids.iter().enumerate() {
            for keys in sorted.view(view).chunks(BLOCK) {
                let (splats, after) = rest.split_at_mut(keys.len());
                blocks.push((view, *grid, keys, splats));
                rest = after;
            }
        }
        if self.cursors.len() < blocks.len() {
            self.cursors.resize_with(blocks.len(), Vec::new);
        }
        let log2_cut = cutoffs.log2_alpha_cut;
        blocks.par_iter_mut().zip(&mut self.cursors).for_each(
            |((_, grid, keys, splats), counts)| {
                counts.clear();
                counts.resize(grid.tiles(), 0);
                dispatch!(level, _ => count(projected, keys, splats, grid, log2_cut, counts));
            },
        );

        // Prefix sum, tile by tile and within a tile block by block.
        let blocks: Vec<(usize, Grid, usize)> =
            blocks.into_iter().map(|(view, grid, keys, _)| (view, grid, keys.len())).collect();
        self.starts.clear();
        self.first_tile.clear();
        let mut total = 0_u64;
        let mut block = 0;
        for (view, grid) in grids.iter().enumerate() {
            let end = block + blocks[block..].iter().take_while(|b| b.0 == view).count();
            self.first_tile.push(self.starts.len());
            for tile in 0..grid.tiles() {
                self.starts.push(total as u32);
                for cursors in &mut self.cursors[block..end] {
                    let count = cursors[tile];
                    cursors[tile] = total as u32;
                    total += u64::from(count);
                }
            }
            if total > MAX_INSTANCES {
                let what = "(Gaussian, tile) pairs";
                return Err(RenderError::TooMany { what, needed: total, limit: MAX_INSTANCES });
            }
            block = end;
        }
        self.starts.push(total as u32);

        // Emit.
        self.used = total as usize;
        if self.instances.len() < self.used {
            // An eighth to spare, not as much again: a drive's frames differ by little.
            let wanted = self.used + self.used / 8;
            self.instances.reserve_exact(wanted - self.instances.len());
            self.instances.resize_with(wanted, AtomicU32::default);
        }
        let mut first = 0;
        let blocks: Vec<_> = blocks
            .into_iter()
            .map(|(_, grid, count)| {
                first += count;
                (grid, first - count..first)
            })
            .collect();
        blocks.par_iter().zip(&mut self.cursors).for_each(|((grid, range), cursors)| {
            let splats = &self.splats[range.clone()];
            let first = range.start as u32;
            dispatch!(level, _ => emit(splats, first, grid, log2_cut, cursors, &self.instances));
        });
        Ok(())
    }

    /// (Gaussian, tile) pairs of the frame.
    pub(super) fn instances(&self) -> usize {
        self.used
    }

    /// Indices of the splats of one tile of one view, from the nearest.
    pub(super) fn tile(&self, view: usize, tile: usize) -> &[AtomicU32] {
        let tile = self.first_tile[view] + tile;
        &self.instances[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }

    /// The splat of an index.
    #[inline(always)]
    pub(super) fn splat(&self, index: &AtomicU32) -> &Splat {
        &self.splats[index.load(Relaxed) as usize]
    }
}

/// Puts a block's splats in order, and counts their instances per tile.
#[inline(always)]
fn count(
    projected: &Projected,
    keys: &[u64],
    splats: &mut [Splat],
    grid: &Grid,
    log2_cut: f32,
    counts: &mut [u32],
) {
    // Copy a few, then walk them: side by side, their cache misses cost little more than one.
    for (splats, keys) in splats.chunks_mut(GATHER).zip(keys.chunks(GATHER)) {
        for (splat, &key) in splats.iter_mut().zip(keys) {
            *splat = *projected.splat(key);
        }
        for splat in splats {
            for_each_tile(
                splat,
                grid,
                log2_cut,
                #[inline(always)]
                |tile| counts[tile] += 1,
            );
        }
    }
}

/// Writes a block's instances where its cursors say.
#[inline(always)]
fn emit(
    splats: &[Splat],
    first: u32,
    grid: &Grid,
    log2_cut: f32,
    cursors: &mut [u32],
    instances: &[AtomicU32],
) {
    for (splat, index) in splats.iter().zip(first..) {
        for_each_tile(
            splat,
            grid,
            log2_cut,
            #[inline(always)]
            |tile| {
                instances[cursors[tile] as usize].store(index, Relaxed);
                cursors[tile] += 1;
            },
        );
    }
}

/// Calls `visit` for every tile that the ellipse `u² + v² <= power` touches, row by row.
///
/// Within a band of rows the ellipse's right edge `x(dy) = s dy + √(power - (l2 dy)²)/l0`, with
/// `s = -l1/l0`, is concave: its maximum lies at `dy* = s (power/l2²)/extent_x` or at the end of
/// the band nearest to it. The left edge mirrors it. (Speedy-Splat, Hanson et al. 2025, finds the
/// same set by walking the ellipse's bounds.)
#[inline(always)]
fn for_each_tile(splat: &Splat, grid: &Grid, log2_cut: f32, mut visit: impl FnMut(usize)) {
    let ([x, y], [extent_x, extent_y]) = (splat.mean_px, splat.extent_px);
    let last = grid.size_px.map(|size| size as i32 - 1);
    let (left, right) = pixels(x, -extent_x, extent_x, last[0]);
    let (top, bottom) = pixels(y, -extent_y, extent_y, last[1]);
    if left > right || top > bottom {
        return;
    }
    let tile = TILE_PX as i32;
    let (first_column, last_column) = (left / tile, right / tile);
    let (first_row, last_row) = (top / tile, bottom / tile);
    let columns = grid.columns as usize;
    if first_column == last_column || first_row == last_row {
        for row in first_row..=last_row {
            for column in first_column..=last_column {
                visit(row as usize * columns + column as usize);
            }
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
        let band_bottom = ((row * tile + tile - 1) as f32 + 0.5 - y).min(extent_y);
        let right_dy = widest_dy.clamp(band_top, band_bottom.max(band_top));
        let left_dy = (-widest_dy).clamp(band_top, band_bottom.max(band_top));
        let high = skew * right_dy + half_width(right_dy) + EXTENT_SLACK_PX;
        let low = skew * left_dy - half_width(left_dy) - EXTENT_SLACK_PX;
        let (left, right) = pixels(x, low, high, last[0]);
        if left <= right {
            for column in left / tile..=right / tile {
                visit(row as usize * columns + column as usize);
            }
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
