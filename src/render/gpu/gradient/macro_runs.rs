//! Runs of macro tiles. The way back blends and gathers one run after the other, so that the sums
//! of instances and touches exist for one run at a time: those of a whole frame take several times
//! as much as everything else. A macro tile that has too many, such as one where a road meets the
//! horizon, has several runs of some of its tiles each.
//!
//! The sums of a splat are added in the order of macro tiles and tiles, in one run or in many: the
//! bytes are the same.

use std::ops::Range;

use crate::gpu::layout::{EXPAND_BATCH, FrameView, MACRO_COLUMNS, MACRO_ROWS, MacroRun};
use crate::gradient::Partial;

/// Bytes of the sums of a splat, a touch or an instance.
pub(super) const SUMS_BYTES: u64 = size_of::<Partial>() as u64;

/// Most bytes of the sums of a run for each splat of the frame, unless the touches of one macro
/// tile and the instances of one tile take more: 80 B if all splats are there. With 44 B of each
/// splat's own, a rank of each touch, and the quarter that buffers grow beyond their need, these
/// are at most 116 B a splat.
const BYTES_PER_SPLAT: u64 = 44;

/// A small frame is one run: with a few splats that cover many tiles, runs would be too short to
/// keep a device busy.
const LEAST_BYTES: u64 = 8 << 20;

/// Tiles of a macro tile.
const TILES: usize = (MACRO_COLUMNS * MACRO_ROWS) as usize;

/// The runs of a frame.
#[derive(Debug)]
pub(in crate::gpu) struct MacroRuns {
    pub(super) runs: Vec<Run>,
    /// The tiles of each page of the derivatives by pixels. No row of macro tiles is on two pages.
    pub(super) pages: Vec<Range<u32>>,
}

/// A run, and what the host must know of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Run {
    pub(super) layout: MacroRun,
    /// The page of its tiles.
    pub(super) page: usize,
    /// Whether the sums of its touches are complete: no other run of the macro tile follows.
    pub(super) is_last: bool,
    instances: u32,
}

/// What bounds the size of runs and pages.
#[derive(Clone, Copy, Debug)]
pub(in crate::gpu) struct RunLimits {
    /// Splats of the frame.
    pub(in crate::gpu) splats: u32,
    /// Bytes that a shader can see of a buffer.
    pub(in crate::gpu) binding_bytes: u64,
    pub(in crate::gpu) tiles_per_page: u32,
}

/// A row of macro tiles of a view.
#[derive(Clone, Debug)]
struct MacroRow {
    tiles: Range<u32>,
    /// Tiles in a row of the view.
    columns: u32,
    macro_tiles: Range<u32>,
}

/// What is summed in a macro tile.
#[derive(Clone, Copy, Debug)]
struct MacroTile {
    touches: u32,
    /// The instances of each tile.
    instances: [u32; TILES],
}

impl MacroRuns {
    /// The runs of whole views. `touches` has the range of touches of each macro tile, and
    /// `instances` the range of instances of each tile.
    pub(in crate::gpu) fn new(
        views: &[FrameView],
        touches: &[[u32; 2]],
        instances: &[[u32; 2]],
        limits: RunLimits,
    ) -> Self {
        let most_bytes = (BYTES_PER_SPLAT * u64::from(limits.splats)).max(LEAST_BYTES);
        // The shader sees the sums of a run as one binding.
        let most = most_bytes.min(limits.binding_bytes) / SUMS_BYTES;
        let mut runs = Self { runs: Vec::new(), pages: Vec::new() };
        // A run that would begin at the next macro tile.
        // The tile mask of a whole macro tile has all its bits, which tells it from a part.
        let mut next = MacroRun { macro_tiles: 1, tiles: u32::MAX, ..MacroRun::default() };
        for row in views.iter().flat_map(macro_rows) {
            next.first_tile = runs.add_to_page(&row.tiles, limits.tiles_per_page);
            for (number, macro_tile) in row.macro_tiles.clone().zip(row.counts(touches, instances))
            {
                next.first_macro_tile = number;
                next.touches = macro_tile.touches;
                next.batches = macro_tile.touches.div_ceil(EXPAND_BATCH);
                runs.add(next, &macro_tile, most);
                next.first_touch += macro_tile.touches;
                next.first_batch += next.batches;
                next.first_instance += macro_tile.instances.iter().sum::<u32>();
            }
        }
        runs
    }

    /// Adds a row of macro tiles to the last page, or to a new one. Returns the page's first tile.
    fn add_to_page(&mut self, tiles: &Range<u32>, tiles_per_page: u32) -> u32 {
        match self.pages.last_mut() {
            Some(page) if tiles.end - page.start <= tiles_per_page => {
                page.end = tiles.end;
                page.start
            }
            _ => {
                self.pages.push(tiles.clone());
                tiles.start
            }
        }
    }

    /// Adds a macro tile, which `own` would be a run of, to the last run, or as new runs.
    fn add(&mut self, own: MacroRun, macro_tile: &MacroTile, most: u64) {
        let page = self.pages.len() - 1;
        let instances = macro_tile.instances.iter().sum::<u32>();
        let sums = u64::from(own.touches) + u64::from(instances);
        match self.runs.last_mut() {
            Some(run)
                if run.page == page
                    // A run of some tiles of a macro tile takes no other macro tile.
                    && run.layout.tiles == u32::MAX
                    && run.sums() + sums <= most =>
            {
                run.instances += instances;
                run.layout.macro_tiles += 1;
                run.layout.touches += own.touches;
                run.layout.batches += own.batches;
            }
            _ if sums <= most => {
                self.runs.push(Run { layout: own, page, is_last: true, instances });
            }
            _ => self.split(own, macro_tile, most),
        }
    }

    /// Adds runs of some tiles of a macro tile each.
    fn split(&mut self, own: MacroRun, macro_tile: &MacroTile, most: u64) {
        let page = self.pages.len() - 1;
        let empty = MacroRun { tiles: 0, ..own };
        let mut run = Run { layout: empty, page, is_last: false, instances: 0 };
        for (tile, &instances) in macro_tile.instances.iter().enumerate() {
            // A run has at least one tile with instances, even if these are more than `most`.
            if run.instances > 0 && run.sums() + u64::from(instances) > most {
                self.runs.push(run);
                let first_instance = run.layout.first_instance + run.instances;
                run.layout = MacroRun { continues: 1, first_instance, ..empty };
                run.instances = 0;
            }
            run.layout.tiles |= 1 << tile;
            run.instances += instances;
        }
        self.runs.push(Run { is_last: true, ..run });
    }

    /// Most touches and instances of a run together.
    pub(super) fn sums(&self) -> u64 {
        self.runs.iter().map(Run::sums).max().unwrap_or(0)
    }

    /// Most touches of a run.
    pub(super) fn touches(&self) -> u64 {
        self.runs.iter().map(|run| run.layout.touches.into()).max().unwrap_or(0)
    }

    /// Most tiles of a page.
    pub(super) fn page_tiles(&self) -> u64 {
        self.pages.iter().map(|tiles| tiles.len() as u64).max().unwrap_or(0)
    }
}

impl Run {
    fn sums(&self) -> u64 {
        u64::from(self.layout.touches) + u64::from(self.instances)
    }
}

impl MacroRow {
    fn counts(&self, touches: &[[u32; 2]], instances: &[[u32; 2]]) -> Vec<MacroTile> {
        let length = |[start, end]: [u32; 2]| end - start;
        let touches = &touches[self.macro_tiles.start as usize..self.macro_tiles.end as usize];
        let empty = |&range| MacroTile { touches: length(range), instances: [0; TILES] };
        let mut counts: Vec<MacroTile> = touches.iter().map(empty).collect();
        for tile in self.tiles.clone() {
            let column = (tile - self.tiles.start) % self.columns;
            let row = (tile - self.tiles.start) / self.columns;
            let bit = row * MACRO_COLUMNS + column % MACRO_COLUMNS;
            counts[(column / MACRO_COLUMNS) as usize].instances[bit as usize] =
                length(instances[tile as usize]);
        }
        counts
    }
}

/// The rows of macro tiles of a view.
fn macro_rows(view: &FrameView) -> impl Iterator<Item = MacroRow> {
    let FrameView { columns, macro_columns, rows, .. } = *view;
    let tile = view.first_tile;
    let macro_tile = view.first_macro_tile;
    (0..rows[1].div_ceil(MACRO_ROWS)).map(move |row| {
        let [first, end] = [row, row + 1].map(|row| (row * MACRO_ROWS).min(rows[1]) * columns);
        let first_macro_tile = macro_tile + row * macro_columns;
        MacroRow {
            tiles: tile + first..tile + end,
            columns,
            macro_tiles: first_macro_tile..first_macro_tile + macro_columns,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use wildcity_scene::random::Random;

    /// 3 x 2 macro tiles whose last ones are cut off, then one macro tile.
    fn views() -> [FrameView; 2] {
        let view = |columns, rows, first_tile, first_macro_tile| FrameView {
            columns,
            rows: [0, rows],
            first_tile,
            macro_columns: u32::div_ceil(columns, MACRO_COLUMNS),
            first_macro_tile,
            ..FrameView::zeroed()
        };
        [view(19, 6, 0, 0), view(5, 3, 19 * 6, 6)]
    }

    /// Tiles of each macro tile, in the order of their bits.
    fn tiles(macro_tile: u32) -> Vec<(u32, usize)> {
        let [first, second] = views();
        let view = if macro_tile < 6 { first } else { second };
        let own = macro_tile - view.first_macro_tile;
        let corner =
            [own % view.macro_columns * MACRO_COLUMNS, own / view.macro_columns * MACRO_ROWS];
        (0..MACRO_COLUMNS * MACRO_ROWS)
            .map(|bit| (bit, corner[0] + bit % MACRO_COLUMNS, corner[1] + bit / MACRO_COLUMNS))
            .filter(|&(_, column, row)| column < view.columns && row < view.rows[1])
            .map(|(bit, column, row)| {
                (bit, (view.first_tile + row * view.columns + column) as usize)
            })
            .collect()
    }

    /// Ranges of touches and instances as the device has them: those of nothing are 0.
    fn ranges(random: &mut Random) -> (Vec<[u32; 2]>, Vec<[u32; 2]>) {
        let mut touches = vec![[0; 2]; 7];
        let mut instances = vec![[0; 2]; 19 * 6 + 5 * 3];
        let mut next = [0, 0];
        for (macro_tile, range) in touches.iter_mut().enumerate() {
            if random.below(3) == 0 {
                continue;
            }
            let most = [10, 3_000][random.below(2)];
            let count = 1 + random.below(most) as u32;
            *range = [next[0], next[0] + count];
            next[0] += count;
            for (_, tile) in tiles(macro_tile as u32) {
                let count = random.below(count as usize + 1) as u32;
                if count > 0 {
                    instances[tile] = [next[1], next[1] + count];
                    next[1] += count;
                }
            }
        }
        (touches, instances)
    }

    #[test]
    fn runs_have_every_tile_once_and_in_order() {
        let mut random = Random::new(7, "runs", 0);
        let mut divided = 0;
        for _ in 0..200 {
            let (touches, instances) = ranges(&mut random);
            let binding_bytes = SUMS_BYTES * (500 + random.below(40_000) as u64);
            let limits = RunLimits { splats: 1, binding_bytes, tiles_per_page: 80 };
            let runs = MacroRuns::new(&views(), &touches, &instances, limits);
            assert_eq!(runs.pages, [0..76, 76..129]);
            let mut seen: Vec<usize> = Vec::new();
            let [mut first_touch, mut first_instance, mut first_batch] = [0; 3];
            for (index, run) in runs.runs.iter().enumerate() {
                let MacroRun { macro_tiles, tiles: mask, .. } = run.layout;
                let first = run.layout.first_macro_tile;
                let is_divided = mask != u32::MAX;
                divided += u32::from(is_divided);
                assert!(!is_divided || macro_tiles == 1);
                let own = first..first + macro_tiles;
                let most_of_a_tile = instances.iter().map(|[a, b]| b - a).max().unwrap();
                let least = u64::from(run.layout.touches + most_of_a_tile);
                assert!(run.sums() <= (binding_bytes / SUMS_BYTES).max(least));
                assert_eq!(run.layout.first_tile, runs.pages[run.page].start);
                assert_eq!(run.layout.first_touch, first_touch);
                assert_eq!(run.layout.first_batch, first_batch);
                assert_eq!(run.layout.first_instance, first_instance);
                let has_next =
                    runs.runs.get(index + 1).is_some_and(|next| next.layout.continues == 1);
                assert_eq!(run.is_last, !has_next);
                let length = |[start, end]: [u32; 2]| end - start;
                let of_run = own.clone().map(|own| length(touches[own as usize]));
                assert_eq!(of_run.clone().sum::<u32>(), run.layout.touches);
                let batches = of_run.map(|touches| touches.div_ceil(EXPAND_BATCH)).sum::<u32>();
                assert_eq!(batches, run.layout.batches);
                let before = first_instance;
                for (_, tile) in own.flat_map(tiles).filter(|(bit, _)| mask >> bit & 1 == 1) {
                    assert!(runs.pages[run.page].contains(&(tile as u32)));
                    first_instance += length(instances[tile]);
                    seen.push(tile);
                }
                assert_eq!(first_instance - before, run.instances);
                if run.is_last {
                    first_touch += run.layout.touches;
                    first_batch += batches;
                }
            }
            seen.sort_unstable();
            assert_eq!(seen, (0..129).collect::<Vec<_>>());
        }
        assert!(divided > 100, "{divided}");
    }
}
