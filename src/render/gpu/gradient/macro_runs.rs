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

/// A small frame is one run.
const LEAST_BYTES: u64 = 1 << 20;

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
        let most = most_bytes.min(limits.binding_bytes) / SUMS_BYTES;
        let mut runs = Self { runs: Vec::new(), pages: Vec::new() };
        // A run that would begin at the next macro tile.
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
