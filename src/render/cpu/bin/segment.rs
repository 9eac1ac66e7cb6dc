//! Stage bin: the macro tiles that the splats of a segment touch.

use std::ops::Range;

use crate::constants::MAX_INSTANCES;
use crate::cpu::project::Projected;
use crate::layout::{Cutoffs, Splat};

use super::grid::Grid;
use super::rows::{TileBox, for_each_row};

/// Consecutive units of one view, and the macro tiles that their splats touch.
#[derive(Debug, Default)]
pub(super) struct Segment {
    pub(super) view: usize,
    pub(super) units: Range<usize>,
    /// Macro tile after macro tile, and within one in order of global ids.
    pairs: Vec<Pair>,
    /// Counts of each macro tile of the view.
    pub(super) counts: Vec<Counts>,
}

/// A splat and a macro tile that it touches.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Pair {
    /// [`Cutoffs::sort_key`] without the view.
    pub(super) depth: u32,
    /// Place of the splat in the projection.
    pub(super) place: u32,
    /// A bit for each tile.
    pub(super) tiles: u32,
}

/// Counts of one segment and one macro tile.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Counts {
    /// First the number of pairs, then the end of them in the segment.
    pairs: u32,
    /// Number of (splat, tile) pairs in the macro tile.
    pub(super) instances: u32,
}
impl Segment {
    /// Finds and counts the pairs of all splats, in order of global ids.
    #[inline(always)]
    pub(super) fn find(
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
            // Beyond the limit the frame fails. A pair has at least one instance, so this bounds
            // the memory, too.
            if instances > MAX_INSTANCES {
                return;
            }
            for (place, splat) in (first_place..).zip(splats) {
                // All pairs of a segment have the same view, so the key is that of view 0.
                let pair = Pair { depth: cutoffs.sort_key(0, splat.depth_m), place, tiles: 0 };
                if let Some(area) = TileBox::new(splat, grid) {
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
        // The mask is a local value here, and no earlier pair has to be searched for.
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
                    // Bit `row << x_bits | column` of the mask, both from the macro tile's corner.
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
            // Otherwise nothing has been counted or pushed yet, and the general case starts afresh.
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
                // One line of tiles, cut at the edges of macro tiles: each part goes to its
                // own mask.
                for column in first >> x_bits..=last >> x_bits {
                    let left = column << x_bits;
                    let low = first.max(left) - left;
                    let high = last.min(left + width - 1) - left;
                    let tiles = tiles_of_line(low, high) << shift;
                    let number = macro_row * macro_columns + column;
                    let counts = &mut self.counts[number as usize];
                    counts.instances += high - low + 1;
                    // A line below another within a macro tile adds to the same pair.
                    match find_macro_tile(&mut pairs[row_start..], number) {
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
    pub(super) fn group(&mut self, found: &[(u32, Pair)]) {
        let mut end = 0;
        // A counting sort: from counts to the first place of each macro tile, and after the second
        // loop to the end of each. It is stable, which keeps the order of global ids.
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

    /// Bytes of all buffers, with the room that they have left.
    pub(super) fn held_bytes(&self) -> usize {
        self.pairs.capacity() * size_of::<Pair>() + self.counts.capacity() * size_of::<Counts>()
    }

    /// The pairs of a macro tile.
    pub(super) fn macro_tile(&self, number: usize) -> &[Pair] {
        let end_before = number.checked_sub(1).map_or(0, |before| self.counts[before].pairs);
        &self.pairs[end_before as usize..self.counts[number].pairs as usize]
    }
}

/// The bits from one to another.
#[inline(always)]
fn tiles_of_line(low: u32, high: u32) -> u32 {
    // Ones up to and including `high`, minus ones below `low`. `high` is below 8.
    (2 << high) - (1 << low)
}
/// The pair of a macro tile among those of one splat and one row of macro tiles.
#[inline(always)]
fn find_macro_tile(pairs: &mut [(u32, Pair)], number: u32) -> Option<&mut Pair> {
    // They are nearly always consecutive, from the left.
    let (first, _) = pairs.first()?;
    let guess = number.wrapping_sub(*first) as usize;
    let found = match pairs.get(guess) {
        Some((there, _)) if *there == number => guess,
        _ => pairs.iter().position(|(there, _)| *there == number)?,
    };
    Some(&mut pairs[found].1)
}
