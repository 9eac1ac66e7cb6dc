//! Stages bin and sort: for every tile, the list of splats that can touch it, from the nearest.
//!
//! **Two levels.** Bin finds the macro tiles (up to 8 x 4 tiles) that each splat touches, and its tiles within each as a mask.
//! It walks over the splats once, in the order in which they lie in memory. Sort then takes one macro tile at a time: its
//! splats are put in order of depth and distributed to its tiles while they stay in the cache of a core. Sorting each view as
//! a whole instead, and reading its splats in that order, took twice the time on dense captures: nearly every
//! read missed the caches.
//!
//! **The lists do not depend on the schedule.** The splats of a view are cut into segments that run in parallel. A macro tile
//! takes its pairs from all segments in order, so that they are in order of global ids; and the order by (depth, index) is
//! unique. Each macro tile writes to its own part of the instances.
mod grid;
mod macro_tile;
mod rows;
mod segment;

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use fearless_simd::{Level, dispatch};
use parking_lot::Mutex;
use rayon::prelude::*;

use super::project::{Projected, Unit};
use crate::constants::MAX_INSTANCES;
use crate::layout::Cutoffs;
use crate::{RenderError, View};

pub(super) use grid::Grid;
use macro_tile::MacroTile;
use segment::{Pair, Segment};

/// Splats of a segment, at least, unless its view has fewer: enough to outweigh its counters of a view's macro tiles.
const SEGMENT: usize = 1 << 14;

/// The splats of a frame by tile.
#[derive(Debug, Default)]
pub(super) struct Bins {
    /// Places of splats in the projection: macro tile after macro tile, and within one tile after tile.
    instances: Vec<u32>,
    /// Number of `instances` that belong to this frame; the rest is spare room.
    used: usize,
    /// View after view, row by row.
    macro_tiles: Vec<MacroTile>,
    /// Index of the first macro tile of each view.
    first_macro_tile: Vec<usize>,
    grids: Vec<Grid>,
    segments: Vec<Segment>,
    /// Number of `segments` that belong to this frame.
    used_segments: usize,
    /// Not in use.
    scratches: Mutex<Vec<Scratch>>,
}
/// What a thread needs for a segment or a macro tile.
#[derive(Debug, Default)]
struct Scratch {
    /// Of a segment, each with the number of its macro tile.
    found: Vec<(u32, Pair)>,
    /// Of a macro tile.
    pairs: Vec<Pair>,
    /// Depth (32 bits), then the index of the pair.
    keys: Vec<u64>,
    other: Vec<u64>,
}
impl Bins {
    /// Stage bin: finds the macro tiles that each splat touches.
    ///
    /// # Errors
    /// More than [`MAX_INSTANCES`] (splat, tile) pairs.
    pub(super) fn bin(
        &mut self,
        level: Level,
        projected: &Projected,
        views: &[View],
        cutoffs: &Cutoffs,
    ) -> Result<(), RenderError> {
        self.grids.clear();
        self.grids.extend(views.iter().map(Grid::new));
        self.cut(projected.units());
        let total = AtomicU64::new(0);
        let grids = &self.grids;
        let scratches = &self.scratches;
        let segments = self.segments[..self.used_segments].par_iter_mut().with_max_len(1);
        segments.for_each(|segment| {
            // Beyond the limit the frame fails whatever the rest holds, so the rest is skipped.
            if total.load(Relaxed) > MAX_INSTANCES {
                return;
            }
            let mut scratch = take(scratches);
            let found = &mut scratch.found;
            let grid = &grids[segment.view];
            dispatch!(level, _ => segment.find(projected, grid, cutoffs, found));
            let counts = segment.counts.iter();
            let instances: u64 = counts.map(|counts| u64::from(counts.instances)).sum();
            total.fetch_add(instances, Relaxed);
            segment.group(found);
            scratches.lock().push(scratch);
        });
        if total.into_inner() > MAX_INSTANCES {
            let what = "(Gaussian, tile) pairs";
            return Err(RenderError::TooMany { what, limit: MAX_INSTANCES });
        }
        self.allocate();
        Ok(())
    }

    /// Stage sort: puts the splats of each macro tile in order of depth, and lists them by tile.
    pub(super) fn sort(&mut self) {
        // Each macro tile with its part of the instances.
        let mut rest = &mut self.instances[..self.used];
        let mut jobs = Vec::with_capacity(self.macro_tiles.len());
        let mut macro_tiles = self.macro_tiles.iter_mut();
        let segments = self.segments[..self.used_segments].chunk_by(|a, b| a.view == b.view);
        let mut segments = segments.peekable();
        for (view, grid) in self.grids.iter().enumerate() {
            let of_view = segments.next_if(|segments| segments[0].view == view);
            for (number, tile) in macro_tiles.by_ref().take(grid.macro_tiles()).enumerate() {
                let (own, after) = rest.split_at_mut(tile.len as usize);
                rest = after;
                jobs.push((tile, number, of_view.unwrap_or_default(), own));
            }
        }
        let scratches = &self.scratches;
        jobs.into_par_iter().with_max_len(1).for_each(|(tile, number, segments, own)| {
            let mut scratch = take(scratches);
            tile.list(number, segments, &mut scratch, own);
            scratches.lock().push(scratch);
        });
    }

    /// Number of (Gaussian, tile) pairs of the frame.
    pub(super) fn instances(&self) -> usize {
        self.used
    }

    /// The grids of all views.
    pub(super) fn grids(&self) -> &[Grid] {
        &self.grids
    }

    /// Places in the projection of the splats of one tile of one view, from the nearest.
    pub(super) fn tile(&self, view: usize, column: u32, row: u32) -> &[u32] {
        let (number, within) = self.grids[view].place(column, row);
        let tile = &self.macro_tiles[self.first_macro_tile[view] + number];
        let start = within.checked_sub(1).map_or(0, |before| tile.ends[before]);
        &self.instances[tile.first as usize..][start as usize..tile.ends[within] as usize]
    }

    /// Cuts the units of a projection into segments.
    fn cut(&mut self, units: &[Unit]) {
        let mut segments = 0;
        let mut splats = 0;
        for (index, unit) in units.iter().enumerate() {
            let is_next =
                segments == 0 || splats >= SEGMENT || self.segments[segments - 1].view != unit.view;
            if is_next {
                if self.segments.len() == segments {
                    self.segments.push(Segment::default());
                }
                self.segments[segments].view = unit.view;
                self.segments[segments].units = index..index;
                segments += 1;
                splats = 0;
            }
            self.segments[segments - 1].units.end = index + 1;
            splats += unit.len;
        }
        self.used_segments = segments;
    }

    /// Gives each macro tile its part of the instances.
    fn allocate(&mut self) {
        self.macro_tiles.clear();
        self.first_macro_tile.clear();
        let segments = &self.segments[..self.used_segments];
        let mut total = 0;
        for (view, grid) in self.grids.iter().enumerate() {
            let first = self.macro_tiles.len();
            self.first_macro_tile.push(first);
            self.macro_tiles.resize_with(first + grid.macro_tiles(), MacroTile::default);
            let of_view = &mut self.macro_tiles[first..];
            for segment in segments.iter().filter(|segment| segment.view == view) {
                for (tile, counts) in of_view.iter_mut().zip(&segment.counts) {
                    tile.len += counts.instances;
                }
            }
            for tile in of_view {
                tile.first = total;
                total += tile.len;
            }
        }
        self.used = total as usize;
        if self.instances.len() < self.used {
            // An eighth of spare room: consecutive frames of a drive differ by little.
            let wanted = self.used + self.used / 8;
            self.instances.reserve_exact(wanted - self.instances.len());
            self.instances.resize(wanted, 0);
        }
    }
}
fn take(scratches: &Mutex<Vec<Scratch>>) -> Scratch {
    scratches.lock().pop().unwrap_or_default()
}
