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

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use fearless_simd::{Level, dispatch};
use parking_lot::Mutex;
use rayon::prelude::*;

use super::project::{Projected, Unit};
use super::sort::sort_by_depth;
use crate::constants::{EXTENT_SLACK_PX, MAX_INSTANCES, TILE_PX};
use crate::layout::{Cutoffs, Splat};
use crate::{RenderError, View};

/// Splats of a segment, at least, unless its view has fewer: enough to outweigh its counters of a view's macro tiles.
const SEGMENT: usize = 1 << 14;

/// Most tiles of a macro tile: bits of a mask.
const MACRO_TILES: usize = 32;

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

/// Where the lists of one macro tile are.
#[derive(Clone, Debug, Default)]
struct MacroTile {
    /// Its part of the instances.
    first: u32,
    len: u32,
    /// End of each tile's list, from `first`.
    ends: [u32; MACRO_TILES],
}

/// Consecutive units of one view, and the macro tiles that their splats touch.
#[derive(Debug, Default)]
struct Segment {
    view: usize,
    units: Range<usize>,
    /// Macro tile after macro tile, and within one in order of global ids.
    pairs: Vec<Pair>,
    /// For each macro tile of the view.
    counts: Vec<Counts>,
}

/// A splat and a macro tile that it touches.
#[derive(Clone, Copy, Debug, Default)]
struct Pair {
    /// [`Cutoffs::sort_key`] without the view.
    depth: u32,
    /// Of the splat in the projection.
    place: u32,
    /// A bit for each tile.
    tiles: u32,
}

/// Of one segment and one macro tile.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    /// First the number of pairs, then the end of them in the segment.
    pairs: u32,
    /// (Splat, tile) pairs.
    instances: u32,
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

/// A view's grid of tiles.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    /// Image size, in pixels.
    size_px: [u32; 2],
    /// Tiles per row.
    pub(super) columns: u32,
    /// Rows of tiles.
    pub(super) rows: u32,
    /// Base-2 logarithm of a macro tile's width and height in tiles.
    macro_bits: [u32; 2],
}

impl Grid {
    /// The tiles of a view; the last tile of a row or column may reach beyond the image.
    pub(super) fn new(view: &View) -> Self {
        let size_px = [view.camera.width_px, view.camera.height_px];
        let [columns, rows] = size_px.map(|size| size.div_ceil(TILE_PX));
        // Smaller ones in small images, so that there are enough for all cores.
        let macro_bits = match columns * rows {
            512.. => [3, 2],
            64.. => [2, 1],
            _ => [1, 1],
        };
        Self { size_px, columns, rows, macro_bits }
    }

    /// Macro tiles per row.
    fn macro_columns(&self) -> u32 {
        self.columns.div_ceil(1 << self.macro_bits[0])
    }

    fn macro_tiles(&self) -> usize {
        self.macro_columns() as usize * self.rows.div_ceil(1 << self.macro_bits[1]) as usize
    }

    /// The macro tile of a tile, and the tile's number within it.
    fn place(&self, column: u32, row: u32) -> (usize, usize) {
        let [x_bits, y_bits] = self.macro_bits;
        let number = (row >> y_bits) * self.macro_columns() + (column >> x_bits);
        let within = |at: u32, bits: u32| at & ((1 << bits) - 1);
        (number as usize, (within(row, y_bits) << x_bits | within(column, x_bits)) as usize)
    }
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

impl Segment {
    /// Finds and counts the pairs of all splats, in order of global ids.
    #[inline(always)]
    fn find(
        &mut self,
        projected: &Projected,
        grid: &Grid,
        cutoffs: &Cutoffs,
        pairs: &mut Vec<(u32, Pair)>,
    ) {
        pairs.clear();
        self.counts.clear();
        self.counts.resize(grid.macro_tiles(), Counts::default());
        let units = &projected.units()[self.units.clone()];
        let mut instances = 0;
        for (first_place, splats) in units.iter().flat_map(|unit| projected.pages(unit)) {
            // Beyond the limit the frame fails. A pair has at least one instance, so that this bounds the memory, too.
            if instances > MAX_INSTANCES {
                return;
            }
            for (place, splat) in (first_place..).zip(splats) {
                let pair = Pair { depth: cutoffs.sort_key(0, splat.depth_m), place, tiles: 0 };
                if let Some(area) = TileBox::of(splat, grid) {
                    let added = self.add(splat, &area, grid, cutoffs.log2_alpha_cut, pair, pairs);
                    instances += u64::from(added);
                }
            }
        }
    }

    /// Adds the pairs of one splat whose box covers some tiles. Returns the number of its tiles.
    #[inline(always)]
    fn add(
        &mut self,
        splat: &Splat,
        area: &TileBox,
        grid: &Grid,
        log2_cut: f32,
        pair: Pair,
        pairs: &mut Vec<(u32, Pair)>,
    ) -> u32 {
        let [x_bits, y_bits] = grid.macro_bits;
        let macro_columns = grid.macro_columns();
        let TileBox { left, right, top, bottom } = *area;
        // Most splats lie within one macro tile.
        if left >> x_bits == right >> x_bits && top >> y_bits == bottom >> y_bits {
            let first_column = left >> x_bits << x_bits;
            let first_row = top >> y_bits << y_bits;
            let last_column = first_column + (1 << x_bits) - 1;
            let mut tiles = 0;
            let mut fits = true;
            for_each_row(
                splat,
                area,
                grid,
                log2_cut,
                #[inline(always)]
                |row, first, last| {
                    // A row may be rounded beyond the box.
                    if first < first_column || last > last_column {
                        fits = false;
                        return;
                    }
                    let line = tiles_of_line(first - first_column, last - first_column);
                    tiles |= line << ((row - first_row) << x_bits);
                },
            );
            if fits && tiles != 0 {
                let number = (top >> y_bits) * macro_columns + (left >> x_bits);
                let counts = &mut self.counts[number as usize];
                counts.pairs += 1;
                counts.instances += tiles.count_ones();
                pairs.push((number, Pair { tiles, ..pair }));
            }
            if fits {
                return tiles.count_ones();
            }
        }

        // The first pair of this row of macro tiles.
        let mut row_start = pairs.len();
        let mut macro_row = u32::MAX;
        let width = 1 << x_bits;
        let mut instances = 0;
        for_each_row(
            splat,
            area,
            grid,
            log2_cut,
            #[inline(always)]
            |row, first, last| {
                if row >> y_bits != macro_row {
                    macro_row = row >> y_bits;
                    row_start = pairs.len();
                }
                instances += last - first + 1;
                let shift = (row & ((1 << y_bits) - 1)) << x_bits;
                for column in first >> x_bits..=last >> x_bits {
                    let left = column << x_bits;
                    let low = first.max(left) - left;
                    let high = last.min(left + width - 1) - left;
                    let tiles = tiles_of_line(low, high) << shift;
                    let number = macro_row * macro_columns + column;
                    let counts = &mut self.counts[number as usize];
                    counts.instances += high - low + 1;
                    match of_macro_tile(&mut pairs[row_start..], number) {
                        Some(pair) => pair.tiles |= tiles,
                        None => {
                            pairs.push((number, Pair { tiles, ..pair }));
                            counts.pairs += 1;
                        }
                    }
                }
            },
        );
        instances
    }

    /// Groups pairs by macro tile, and keeps their order within each.
    fn group(&mut self, found: &[(u32, Pair)]) {
        let mut end = 0;
        for counts in &mut self.counts {
            let start = end;
            end += counts.pairs;
            counts.pairs = start;
        }
        self.pairs.resize(found.len(), Pair::default());
        for &(number, pair) in found {
            let next = &mut self.counts[number as usize].pairs;
            self.pairs[*next as usize] = pair;
            *next += 1;
        }
    }

    /// The pairs of a macro tile.
    fn of(&self, number: usize) -> &[Pair] {
        let end_before = number.checked_sub(1).map_or(0, |before| self.counts[before].pairs);
        &self.pairs[end_before as usize..self.counts[number].pairs as usize]
    }
}

/// The bits from one to another.
#[inline(always)]
fn tiles_of_line(low: u32, high: u32) -> u32 {
    (2 << high) - (1 << low)
}

fn take(scratches: &Mutex<Vec<Scratch>>) -> Scratch {
    scratches.lock().pop().unwrap_or_default()
}

/// The pair of a macro tile among those of one splat and one row of macro tiles.
#[inline(always)]
fn of_macro_tile(pairs: &mut [(u32, Pair)], number: u32) -> Option<&mut Pair> {
    // They are nearly always consecutive, from the left.
    let (first, _) = pairs.first()?;
    let guess = number.wrapping_sub(*first) as usize;
    let found = match pairs.get(guess) {
        Some((there, _)) if *there == number => guess,
        _ => pairs.iter().position(|(there, _)| *there == number)?,
    };
    Some(&mut pairs[found].1)
}

impl MacroTile {
    /// Puts the splats of the macro tile `number` of a view in order of depth, and lists them by tile.
    fn list(
        &mut self,
        number: usize,
        segments: &[Segment],
        scratch: &mut Scratch,
        instances: &mut [u32],
    ) {
        let Scratch { pairs, keys, other, .. } = scratch;
        pairs.clear();
        keys.clear();
        for segment in segments {
            pairs.extend_from_slice(segment.of(number));
        }
        keys.extend((0..).zip(&*pairs).map(|(index, pair)| u64::from(pair.depth) << 32 | index));
        sort_by_depth(keys, other);

        // Count the splats of each tile, and turn the counts into places.
        let mut next = [0; MACRO_TILES];
        for pair in &*pairs {
            let mut tiles = pair.tiles;
            while tiles != 0 {
                next[tiles.trailing_zeros() as usize % MACRO_TILES] += 1;
                tiles &= tiles - 1;
            }
        }
        let mut end = 0;
        for next in &mut next {
            let start = end;
            end += *next;
            *next = start;
        }

        for &key in &*keys {
            let Pair { place, mut tiles, .. } = pairs[key as u32 as usize];
            while tiles != 0 {
                let next = &mut next[tiles.trailing_zeros() as usize % MACRO_TILES];
                instances[*next as usize] = place;
                *next += 1;
                tiles &= tiles - 1;
            }
        }
        self.ends = next;
    }
}

/// The tiles that a splat's bounding box touches: first and last column, first and last row.
struct TileBox {
    left: u32,
    right: u32,
    top: u32,
    bottom: u32,
}

impl TileBox {
    /// `None` if it touches no pixel's centre.
    #[inline(always)]
    fn of(splat: &Splat, grid: &Grid) -> Option<Self> {
        let [x, y] = splat.mean_px;
        let [extent_x, extent_y] = splat.extent_px;
        let (left, right) = tiles(x, -extent_x, extent_x, grid.size_px[0])?;
        let (top, bottom) = tiles(y, -extent_y, extent_y, grid.size_px[1])?;
        Some(Self { left, right, top, bottom })
    }
}

/// Calls `visit` with the first and last tile of every row of tiles that the ellipse `u² + v² <= power` touches, where
/// `u = l0 dx + l1 dy` and `v = l2 dy` (see [`Splat`]) and power is `log2(opacity) - log2(alpha_cut)`: row, first
/// column, last column.
///
/// At the height dy the ellipse reaches to the right as far as `x(dy) = s dy + √(power - (l2 dy)²)/l0`, with
/// `s = -l1/l0`. This is concave in dy, and its maximum over the whole ellipse lies at
/// `dy* = s (power/l2²)/extent_x`. So its maximum over a band of rows lies at dy*, or at the end of the band
/// that is nearest to dy*. The left edge is the mirror image. (Speedy-Splat, Hanson et al. 2025, finds the same
/// set of tiles by following the ellipse's bounds.)
#[inline(always)]
fn for_each_row(
    splat: &Splat,
    area: &TileBox,
    grid: &Grid,
    log2_cut: f32,
    mut visit: impl FnMut(u32, u32, u32),
) {
    let TileBox { left, right, top, bottom } = *area;
    // In one row or one column of tiles the ellipse touches all tiles of its box.
    if left == right || top == bottom {
        for row in top..=bottom {
            visit(row, left, right);
        }
        return;
    }

    // Otherwise row by row, between the extremes of the left and right edge.
    let [x, y] = splat.mean_px;
    let [extent_x, extent_y] = splat.extent_px;
    let [l0, l1, l2] = splat.factor;
    let power = splat.log2_opacity - log2_cut;
    let inverse_l0 = 1.0 / l0;
    let skew = -l1 * inverse_l0;
    let widest_dy = skew * power / (l2 * l2 * extent_x);
    let half_width = |dy: f32| (power - (l2 * dy) * (l2 * dy)).max(0.0).sqrt() * inverse_l0;
    for row in top..=bottom {
        let band_top = ((row * TILE_PX) as f32 + 0.5 - y).max(-extent_y);
        let last_px = (row * TILE_PX + TILE_PX - 1) as f32;
        let band_bottom = (last_px + 0.5 - y).min(extent_y).max(band_top);
        let right_dy = widest_dy.clamp(band_top, band_bottom);
        let left_dy = (-widest_dy).clamp(band_top, band_bottom);
        let high = skew * right_dy + half_width(right_dy) + EXTENT_SLACK_PX;
        let low = skew * left_dy - half_width(left_dy) - EXTENT_SLACK_PX;
        if let Some((first, last)) = tiles(x, low, high, grid.size_px[0]) {
            visit(row, first, last);
        }
    }
}

/// First and last tile of a row or column of `size_px` pixels with a pixel's centre, at +0.5, between `center + low` and
/// `center + high`; `None` if there is no such pixel.
#[inline(always)]
fn tiles(center: f32, low: f32, high: f32, size_px: u32) -> Option<(u32, u32)> {
    let last_px = (size_px - 1) as f32;
    // Comparisons and not `max` and `min`, which have instructions for a NaN.
    let first = (center + low - 0.5).ceil();
    let first = if first > 0.0 { first } else { 0.0 };
    let last = (center + high - 0.5).floor();
    let last = if last < last_px { last } else { last_px };
    (first <= last).then(|| (whole(first) / TILE_PX, whole(last) / TILE_PX))
}

/// A whole number from 0 to 2^23 - 1 as an integer: 2^23 + n has the bits of n as its mantissa. A conversion takes six
/// instructions, since it considers every other number as well.
#[inline(always)]
fn whole(value: f32) -> u32 {
    (value + 8_388_608.0).to_bits() & 0x7F_FFFF
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_are_those_with_a_centre_in_between() {
        // 100 px have seven tiles.
        assert_eq!(tiles(50.0, -10.0, 10.0, 100), Some((2, 3)));
        assert_eq!(tiles(16.5, 0.0, 0.0, 100), Some((1, 1)), "on a centre");
        assert_eq!(tiles(16.0, -0.4, 0.4, 100), None, "between two centres");
        assert_eq!(tiles(16.0, -0.5, 0.5, 100), Some((0, 1)), "from centre to centre");
        for (far, expected) in [(1e30, Some((0, 6))), (f32::INFINITY, Some((0, 6)))] {
            assert_eq!(tiles(50.0, -far, far, 100), expected);
        }
        assert_eq!(tiles(-8.0, -4.0, 8.4, 100), None);
        assert_eq!(tiles(108.0, -8.4, 4.0, 100), None);
        assert_eq!(tiles(16_384.0, -300.0, 1.0, 16_384), Some((1005, 1023)));
    }
}
