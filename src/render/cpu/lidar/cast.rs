//! The candidates and the returns of one sector.

use fearless_simd::{Level, dispatch};

use super::candidates::Candidates;
use super::sector::{BodySector, Sector};
use super::tile::Tile;
use crate::lidar::{Sweep, Task};
use wildcity_scene::chunk::LANES;

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
    beams.resize_with(count.max(beams.len()), Tile::default);
    let beams = &mut beams[..count];
    for (at, tile) in beams.iter_mut().enumerate() {
        let first_column = sector.columns.start + at % tiles * LANES;
        tile.begin(sector, view, at / tiles * LANES, first_column);
    }
    search(level, sector, candidates, task, |seen, candidates, is_last| {
        for (tile, list) in beams.iter_mut().zip(&candidates.lists) {
            let all = &candidates.list;
            dispatch!(level, simd => tile.cast(simd, all, seen, list, task.profile));
            if is_last {
                tile.leave_body();
            }
        }
    });
    let width = sector.columns.len();
    let mut part = Sweep::empty(rows * width);
    for tile in beams {
        dispatch!(level, simd => tile.write(simd, sector, &task.keys, &mut part, width));
    }
    part
}

/// Finds the candidates of a sector body by body, and calls `compare` with them whenever there are
/// many, and with the last ones of each body: then its third argument is `true`.
pub(crate) fn search(
    level: Level,
    sector: &Sector,
    candidates: &mut Candidates,
    task: &Task<'_>,
    mut compare: impl FnMut(&BodySector<'_>, &Candidates, bool),
) {
    let rows = task.view.lidar.rows();
    for chunks in &task.bodies {
        let seen = sector.seen_from(chunks[0].1, task.view);
        let mut compare = |candidates: &mut Candidates, is_last| {
            candidates.sort_to_tiles(level, sector, rows);
            compare(&seen, candidates, is_last);
            candidates.list.clear();
        };
        let mut chunks: Vec<_> = chunks
            .iter()
            .map(|(number, _, chunk)| (seen.distance_m(chunk), *number, *chunk))
            .collect();
        // From the nearest, so that what hides others is met first.
        chunks.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, number, chunk) in chunks {
            let chunk = (task.keys.first(number), chunk);
            candidates.find(level, &seen, chunk, task.profile, |many| compare(many, false));
        }
        compare(candidates, true);
    }
}
