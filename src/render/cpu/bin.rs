//! Stage bin: for every tile, the list of splats that can touch it, from the nearest.
//!
//! **Two passes over the sorted splats, but one test.** The first pass finds each splat's spans of tiles (4
//! bytes a span), keeps them, and counts the splats of each tile. The second pass only unpacks the spans into
//! lists, so that the passes cannot disagree about a splat that ends on a tile's edge.
//!
//! **The lists do not depend on the schedule.** Sorted splats are cut into segments that run in parallel. A
//! prefix sum over (tile, segment) gives each segment its own places in every list. Segments write their
//! places through relaxed atomics, which compile to plain stores, so that no `unsafe` is needed.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::project::Projected;
use super::sort::Sorted;
use crate::constants::{EXTENT_SLACK_PX, MAX_INSTANCES, TILE_PX};
use crate::layout::{Cutoffs, Splat};
use crate::{RenderError, View};

/// Splats of a segment: enough to outweigh its histogram of a view's tiles.
const SEGMENT: usize = 1 << 14;

/// Splats read at a time, so that their cache misses overlap.
const READ_BATCH: usize = 64;

/// The splats of a frame by tile.
#[derive(Debug, Default)]
pub(super) struct Bins {
    /// Places of splats in the projection, tile after tile. Atomic so that segments can write to disjoint
    /// elements in parallel without `unsafe`; a relaxed store is an ordinary store.
    instances: Vec<AtomicU32>,
    /// Number of `instances` that belong to this frame; the rest is spare room.
    used: usize,
    /// Start of each tile's list in `instances`, view after view, and the end of the last list.
    starts: Vec<u32>,
    /// First tile of each view.
    first_tile: Vec<usize>,
    segments: Vec<Segment>,
}

/// What the first pass over a segment of sorted splats keeps for the second.
#[derive(Debug, Default)]
struct Segment {
    spans: Vec<Span>,
    /// For each tile of the view: first the number of instances, then the place of the next one.
    cursors: Vec<u32>,
}

/// Consecutive tiles of one row that a splat touches: first tile (bits 0 to 19), number of tiles (bits 20 to
/// 30), whether it is the last span of its splat (bit 31).
///
/// The largest image, 16,384 x 16,384 px, has 2^20 tiles, 1,024 in a row.
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

/// Sorted splats of one view that one thread bins.
struct Job<'a> {
    view: usize,
    keys: &'a [AtomicU64],
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
    /// The tiles of a view; the last tile of a row or column may reach beyond the image.
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
        // One job per segment, in order of views.
        let grids: Vec<Grid> = views.iter().map(Grid::new).collect();
        let segments_of =
            |view| sorted.view(view).chunks(SEGMENT).map(move |keys| Job { view, keys });
        let jobs: Vec<Job<'_>> = (0..views.len()).flat_map(segments_of).collect();
        if self.segments.len() < jobs.len() {
            self.segments.resize_with(jobs.len(), Segment::default);
        }

        // First pass: find spans and count.
        let total = AtomicU64::new(0);
        let segments = self.segments.par_iter_mut().zip(&jobs);
        segments.for_each_init(Vec::new, |spans, (segment, Job { view, keys })| {
            // Beyond the limit the frame fails whatever the rest holds, so the rest is skipped.
            if total.load(Relaxed) > MAX_INSTANCES {
                return;
            }
            let grid = &grids[*view];
            segment.cursors.clear();
            segment.cursors.resize(grid.tiles(), 0);
            spans.clear();
            let cut = cutoffs.log2_alpha_cut;
            dispatch!(level, _ => count(projected, keys, grid, cut, spans, &mut segment.cursors));
            segment.spans.clear();
            segment.spans.reserve_exact(spans.len());
            segment.spans.extend_from_slice(spans);
            let count: u64 = segment.cursors.iter().map(|&count| u64::from(count)).sum();
            total.fetch_add(count, Relaxed);
        });
        if total.into_inner() > MAX_INSTANCES {
            let what = "(Gaussian, tile) pairs";
            return Err(RenderError::TooMany { what, limit: MAX_INSTANCES });
        }

        self.allocate_lists(&jobs, &grids);

        // Second pass: write the lists.
        self.segments.par_iter_mut().zip(&jobs).for_each(|(segment, Job { keys, .. })| {
            write_lists(keys, &segment.spans, &mut segment.cursors, &self.instances);
        });
        Ok(())
    }

    /// Turns counts into places by an exclusive prefix sum, tile by tile, and within a tile segment by
    /// segment: a tile's list keeps the order of the sort.
    fn allocate_lists(&mut self, jobs: &[Job<'_>], grids: &[Grid]) {
        self.starts.clear();
        self.first_tile.clear();
        let mut total = 0;
        let mut rest = &mut self.segments[..jobs.len()];
        for (view, grid) in grids.iter().enumerate() {
            let count = jobs.iter().filter(|job| job.view == view).count();
            let (segments, after) = rest.split_at_mut(count);
            rest = after;
            self.first_tile.push(self.starts.len());
            for tile in 0..grid.tiles() {
                self.starts.push(total);
                for segment in &mut *segments {
                    let count = segment.cursors[tile];
                    segment.cursors[tile] = total;
                    total += count;
                }
            }
        }
        self.starts.push(total);
        self.used = total as usize;
        if self.instances.len() < self.used {
            // An eighth of spare room: consecutive frames of a drive differ by little.
            let wanted = self.used + self.used / 8;
            self.instances.reserve_exact(wanted - self.instances.len());
            self.instances.resize_with(wanted, AtomicU32::default);
        }
    }

    /// Number of (Gaussian, tile) pairs of the frame.
    pub(super) fn instances(&self) -> usize {
        self.used
    }

    /// Start of each tile's list, view after view, and the end of the last list.
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

/// First pass: finds the spans of a segment, and counts its instances per tile.
#[inline(always)]
fn count(
    projected: &Projected,
    keys: &[AtomicU64],
    grid: &Grid,
    log2_cut: f32,
    spans: &mut Vec<Span>,
    counts: &mut [u32],
) {
    // Splats lie in order of ids and are read in order of depth. A batch is read first, so that its cache
    // misses overlap and cost little more than one.
    let mut splats = [Splat::default(); READ_BATCH];
    for keys in keys.chunks(READ_BATCH) {
        for (splat, key) in splats.iter_mut().zip(keys) {
            *splat = *projected.splat(key.load(Relaxed) as u32);
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
            // A splat kept by EXTENT_SLACK_PX alone may touch no pixel's centre. It gets one empty span, since
            // the second pass expects at least one span per splat.
            if spans.len() == before {
                spans.push(Span::new(0, 0));
            }
            if let Some(last) = spans.last_mut() {
                last.0 |= Span::LAST;
            }
        }
    }
}

/// Second pass: writes the instances of a segment to the places that its cursors give.
fn write_lists(keys: &[AtomicU64], spans: &[Span], cursors: &mut [u32], instances: &[AtomicU32]) {
    let mut spans = spans.iter();
    for key in keys {
        let place = key.load(Relaxed) as u32;
        for span in spans.by_ref() {
            for cursor in &mut cursors[span.tiles()] {
                instances[*cursor as usize].store(place, Relaxed);
                *cursor += 1;
            }
            if span.is_last() {
                break;
            }
        }
    }
}

/// Calls `visit` with the span of every row of tiles that the ellipse `u² + v² <= power` touches, where
/// `u = l0 dx + l1 dy` and `v = l2 dy` (see [`Splat`]) and power is `log2(opacity) - log2(alpha_cut)`.
///
/// At the height dy the ellipse reaches to the right as far as `x(dy) = s dy + √(power - (l2 dy)²)/l0`, with
/// `s = -l1/l0`. This is concave in dy, and its maximum over the whole ellipse lies at
/// `dy* = s (power/l2²)/extent_x`. So its maximum over a band of rows lies at dy*, or at the end of the band
/// that is nearest to dy*. The left edge is the mirror image. (Speedy-Splat, Hanson et al. 2025, finds the same
/// set of tiles by following the ellipse's bounds.)
#[inline(always)]
fn for_each_span(splat: &Splat, grid: &Grid, log2_cut: f32, mut visit: impl FnMut(Span)) {
    // Pixels of the bounding box.
    let [x, y] = splat.mean_px;
    let [extent_x, extent_y] = splat.extent_px;
    let last = grid.size_px.map(|size| size as i32 - 1);
    let (left, right) = pixels(x, -extent_x, extent_x, last[0]);
    let (top, bottom) = pixels(y, -extent_y, extent_y, last[1]);
    if left > right || top > bottom {
        return;
    }
    let tile = TILE_PX as i32;
    let span = |row: i32, left: i32, right: i32| {
        let first = (left / tile) as u32;
        let last = (right / tile) as u32;
        Span::new(row as u32 * grid.columns + first, last - first + 1)
    };
    let first_row = top / tile;
    let last_row = bottom / tile;
    // In one row or one column of tiles the ellipse touches all tiles of its box.
    if left / tile == right / tile || first_row == last_row {
        for row in first_row..=last_row {
            visit(span(row, left, right));
        }
        return;
    }

    // Otherwise row by row, between the extremes of the left and right edge.
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

/// First and last pixel of a row or column with its centre, at +0.5, between `center + low` and
/// `center + high`, within 0 to `last`.
///
/// Conversion of float to int saturates, so a splat of any size is handled.
#[inline(always)]
fn pixels(center: f32, low: f32, high: f32, last: i32) -> (i32, i32) {
    let first = ((center + low - 0.5).ceil() as i32).max(0);
    (first, ((center + high - 0.5).floor() as i32).min(last))
}
