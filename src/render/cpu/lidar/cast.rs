//! The candidates and the returns of one sector.

use fearless_simd::{Level, dispatch};

use super::candidates::{Candidates, Search};
use super::sector::{BodySector, Sector};
use super::tile::Tile;
use crate::lidar::{Sweep, Task};
use wildcity_scene::chunk::LANES;

/// Candidates after which they are compared with beams: so few that beams have returned before what
/// is hidden is searched, and so many that a tile has some.
pub(super) const BATCH: usize = 1 << 12;

/// Memory that sectors fill one after the other.
#[derive(Default)]
pub(super) struct Scratch {
    candidates: Candidates,
    tiles: Vec<Tile>,
}

/// The returns of its columns, `[rows, columns of the sector]`.
pub(super) fn sweep(
    sector: &Sector,
    level: Level,
    scratch: &mut Scratch,
    task: &Task<'_>,
) -> Sweep {
    let view = task.view;
    let rows = view.lidar.rows();
    let tiles = sector.tiles.len();
    let Scratch { candidates, tiles: beams } = scratch;
    let count = tiles * rows.div_ceil(LANES);
    // It never shrinks: a later sector with more tiles finds the memory of an earlier one.
    beams.resize_with(count.max(beams.len()), Tile::default);
    let beams = &mut beams[..count];
    for (at, tile) in beams.iter_mut().enumerate() {
        let first_column = sector.columns.start + at % tiles * LANES;
        // Tiles are numbered row by row: `at % tiles` counts them along the columns.
        tile.begin(sector, view, at / tiles * LANES, first_column);
    }
    let mut last = None;
    search(level, sector, candidates, task, BATCH, |number, seen, candidates| {
        // The first batch of a body: the rays of tiles are still those in the axes of the body
        // before.
        if last.replace(number) != Some(number) {
            beams.iter_mut().for_each(Tile::leave_body);
        }
        for (at, tile) in beams.iter_mut().enumerate() {
            dispatch!(level, simd => tile.cast(simd, candidates, at, seen, task.profile));
            candidates.ends_m[at] = tile.end_m();
        }
    });
    let width = sector.columns.len();
    let mut part = Sweep::empty(rows * width);
    for tile in beams {
        dispatch!(level, simd => tile.write(simd, sector, &task.keys, &mut part, width));
    }
    part
}

/// Finds the candidates of a sector body by body, and calls `compare` with the body's number and
/// its candidates whenever there are as many as a batch, and with the last ones of each body.
pub(crate) fn search(
    level: Level,
    sector: &Sector,
    candidates: &mut Candidates,
    task: &Task<'_>,
    batch: usize,
    mut compare: impl FnMut(usize, &BodySector<'_>, &mut Candidates),
) {
    candidates.begin(sector, task.view.lidar.rows());
    for (number, chunks) in task.bodies.iter().enumerate() {
        let seen = sector.seen_from(chunks[0].1, task.view);
        let search = Search { level, seen: &seen, chunks, task, batch };
        candidates.find(&search, |many| compare(number, &seen, many));
    }
}
