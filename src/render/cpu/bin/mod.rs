//! Stages bin and sort: for every tile, the list of splats that can touch it, from the nearest.
//!
//! **Two levels.** Bin finds the macro tiles (up to 8 x 4 tiles) that each splat touches, and its
//! tiles within each as a mask. It walks over the splats once, in the order in which they lie in
//! memory. Sort takes one macro tile at a time, just before it is drawn: its splats are put in
//! order of depth and distributed to its tiles while they stay in the cache of a core. Sorting each
//! view as a whole instead, and reading its splats in that order, took twice the time on dense
//! captures: nearly every read missed the caches.
//!
//! **The lists do not depend on the schedule.** The splats of a view are cut into segments that run
//! in parallel. A macro tile takes its pairs from all segments in order, so that they are in order
//! of global ids; and the order by (depth, index) is unique.

mod gather;
mod grid;
mod macro_tile;
mod rows;
mod segment;

use std::cmp::Reverse;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use fearless_simd::{Level, dispatch};
use parking_lot::Mutex;
use rayon::prelude::*;

use super::overflow::{Overflow, PartError};
use super::project::{Projected, Unit};
use crate::constants::MAX_INSTANCES;
use crate::layout::Cutoffs;
use crate::{RenderError, View};

pub(super) use grid::Grid;
pub(super) use macro_tile::{COPIES_BYTES, MacroTile, MacroTileLists};
use segment::{Pair, Segment};

/// Most bytes of pairs and instances: each pair once in its segment, and while its macro tile is
/// drawn with two keys and again in a list of them.
fn needed_bytes(pairs: u64, instances: u64) -> u64 {
    let of_pair = 2 * size_of::<Pair>() + 2 * size_of::<u64>();
    pairs * of_pair as u64 + instances * size_of::<u32>() as u64
}

/// Checks the number of (splat, tile) pairs.
pub(super) fn check_instances(instances: u64) -> Result<(), RenderError> {
    if instances > MAX_INSTANCES {
        let what = "(Gaussian, tile) pairs";
        Err(RenderError::TooMany { what, limit: MAX_INSTANCES })
    } else {
        Ok(())
    }
}

/// Least number of splats of a segment, unless its view has fewer: enough to outweigh its counters
/// of a view's macro tiles.
const SEGMENT: usize = 1 << 14;

/// The splats of a frame by macro tile.
#[derive(Debug, Default)]
pub(super) struct Bins {
    grids: Vec<Grid>,
    /// In order of views.
    segments: Vec<Segment>,
    /// Number of `segments` that belong to this frame.
    used_segments: usize,
    /// Number of (splat, tile) pairs.
    instances: u64,
    /// Number of (splat, macro tile) pairs.
    pairs: u64,
    /// Unused scratch memory: pairs of a segment, each with the number of its macro tile.
    scratches: Mutex<Vec<Vec<(u32, Pair)>>>,
}

impl Bins {
    /// Stage bin: finds the macro tiles that each splat touches.
    ///
    /// # Errors
    /// More than [`MAX_INSTANCES`] (splat, tile) pairs; or [`Overflow`], if the buffers of this
    /// part of the frame take more than `most_bytes` from now on.
    pub(super) fn bin(
        &mut self,
        level: Level,
        projected: &Projected,
        views: &[View],
        cutoffs: &Cutoffs,
        most_bytes: u64,
    ) -> Result<(), PartError> {
        // The splats are there already, and share the limit with what comes now.
        let most_bytes = most_bytes.saturating_sub(projected.held_bytes());
        self.grids.clear();
        self.grids.extend(views.iter().map(Grid::new));
        self.cut(projected.units());
        // Relaxed is enough: the sums only stop the work early, and are read exactly after all
        // threads have ended.
        let total = AtomicU64::new(0);
        let pairs = AtomicU64::new(0);
        let grids = &self.grids;
        let scratches = &self.scratches;
        // One segment per task: their costs differ by orders of magnitude.
        let segments = self.segments[..self.used_segments].par_iter_mut().with_max_len(1);
        segments.for_each(|segment| {
            // Beyond either limit the rest is skipped: the part is drawn in smaller parts, or the
            // frame fails.
            let is_over = needed_bytes(pairs.load(Relaxed), total.load(Relaxed)) > most_bytes;
            if is_over || total.load(Relaxed) > MAX_INSTANCES {
                return;
            }
            // The lock is held for a pop only; a thread returns its list when its segment is done.
            let mut found = scratches.lock().pop().unwrap_or_default();
            let grid = &grids[segment.view];
            dispatch!(level, _ => segment.find(projected, grid, cutoffs, &mut found));
            let counts = segment.counts.iter();
            let instances: u64 = counts.map(|counts| u64::from(counts.instances)).sum();
            total.fetch_add(instances, Relaxed);
            pairs.fetch_add(found.len() as u64, Relaxed);
            segment.group(&found);
            scratches.lock().push(found);
        });
        self.instances = total.into_inner();
        self.pairs = pairs.into_inner();
        if needed_bytes(self.pairs, self.instances) > most_bytes {
            return Err(Overflow.into());
        }
        check_instances(self.instances)?;
        Ok(())
    }

    /// Frees the memory that segments and the threads' lists of pairs keep from earlier frames if
    /// it is more than `most_bytes`: each may have been long in another frame.
    pub(super) fn trim(&mut self, most_bytes: u64) {
        let of_segments: usize = self.segments.iter().map(Segment::held_bytes).sum();
        let scratches = self.scratches.get_mut();
        let pairs: usize = scratches.iter().map(Vec::capacity).sum();
        // All or nothing: which segment is long next time is not known.
        if (of_segments + pairs * size_of::<(u32, Pair)>()) as u64 > most_bytes {
            scratches.clear();
            self.segments.clear();
            self.used_segments = 0;
        }
    }

    /// Most bytes that a part of the frame holds until it is drawn.
    pub(super) fn held_bytes(&self, projected: &Projected) -> u64 {
        projected.held_bytes() + needed_bytes(self.pairs, self.instances)
    }

    /// Stage sort of one macro tile: puts its splats in order of depth, and lists them by tile.
    #[inline(always)]
    pub(super) fn load(&self, view: usize, number: usize, tile: &mut MacroTile) {
        tile.load(number, self.view_segments(view));
    }

    /// As [`Bins::load`], with lists that were found then.
    pub(super) fn load_with_lists(
        &self,
        view: usize,
        number: usize,
        lists: &MacroTileLists,
        tile: &mut MacroTile,
    ) {
        tile.load_with_lists(number, self.view_segments(view), lists);
    }

    /// The macro tiles of a view, those with the most instances first: the last ones are small, so
    /// that no thread waits long for another.
    pub(super) fn by_work(&self, view: usize) -> Vec<usize> {
        let mut instances = vec![0_u64; self.grids[view].macro_tiles()];
        for segment in self.view_segments(view) {
            for (instances, counts) in instances.iter_mut().zip(&segment.counts) {
                *instances += u64::from(counts.instances);
            }
        }
        let mut numbers: Vec<usize> = (0..instances.len()).collect();
        numbers.sort_by_key(|&number| Reverse(instances[number]));
        numbers
    }

    /// Number of (Gaussian, tile) pairs of the frame.
    pub(super) fn instances(&self) -> u64 {
        self.instances
    }

    /// The grids of all views.
    pub(super) fn grids(&self) -> &[Grid] {
        &self.grids
    }

    /// The segments of a view.
    fn view_segments(&self, view: usize) -> &[Segment] {
        let segments = &self.segments[..self.used_segments];
        // Segments are in order of views, because the units that they are cut from are.
        let first = segments.partition_point(|segment| segment.view < view);
        let end = segments.partition_point(|segment| segment.view <= view);
        &segments[first..end]
    }

    /// Cuts the units of a projection into segments.
    fn cut(&mut self, units: &[Unit]) {
        let mut segments = 0;
        let mut splats = 0;
        for (index, unit) in units.iter().enumerate() {
            // A segment never spans two views, since its counters are those of one view's
            // macro tiles.
            let is_next =
                segments == 0 || splats >= SEGMENT || self.segments[segments - 1].view != unit.view;
            if is_next {
                // Segments of earlier frames are used again, with the memory of their lists.
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
}
