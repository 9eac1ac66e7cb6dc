//! The returns of one sector.

use fearless_simd::{Level, dispatch};

use super::beam::Met;
use super::candidates::Candidates;
use super::sector::Sector;
use super::tile::Tile;
use crate::lidar::{Body, LidarView, Sweep, chunks};
use wildcity_scene::chunk::LANES;
use wildcity_scene::{Chunk, RenderProfile, Scene};

/// Gaussians that beams may have met, beside twice those that they were left with, before those are
/// dropped that no beam has kept.
pub(super) const MET_SLACK: usize = 1 << 16;

/// Memory that sectors fill one after the other.
#[derive(Default)]
pub(super) struct Scratch {
    candidates: Candidates,
    tiles: Vec<Tile>,
    /// The Gaussians that beams have met.
    met: Vec<Met>,
}

/// The returns of its columns, `[rows, columns of the sector]`.
pub(super) fn sweep(
    sector: &Sector,
    level: Level,
    scratch: &mut Scratch,
    bodies: &[ChunksOfBody<'_>],
    profile: &RenderProfile,
    view: &LidarView,
) -> Sweep {
    let rows = view.lidar.rows();
    let tiles = sector.tiles.len();
    let Scratch { candidates, tiles: beams, met } = scratch;
    met.clear();
    let count = tiles * rows.div_ceil(LANES);
    beams.resize_with(count.max(beams.len()), Tile::default);
    let beams = &mut beams[..count];
    for (at, tile) in beams.iter_mut().enumerate() {
        let first_column = sector.columns.start + at % tiles * LANES;
        tile.begin(sector, view, at / tiles * LANES, first_column);
    }
    let mut most_met = MET_SLACK;
    for chunks in bodies {
        let seen = sector.seen_from(chunks[0].1, view);
        let mut compare = |candidates: &mut Candidates| {
            candidates.sort_to_tiles(level, sector, rows);
            let Candidates { list, lists, .. } = candidates;
            for (tile, of_tile) in beams.iter_mut().zip(&*lists) {
                dispatch!(level, simd => tile.cast(simd, list, met, &seen, of_tile, profile));
            }
            list.clear();
            if met.len() > most_met {
                drop_unkept(beams, met);
                most_met = 2 * met.len() + MET_SLACK;
            }
        };
        let mut chunks: Vec<_> = chunks
            .iter()
            .map(|(number, _, chunk)| (seen.distance_m(chunk), *number, *chunk))
            .collect();
        // From the nearest, so that what hides others is met first.
        chunks.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, number, chunk) in chunks {
            candidates.find(level, &seen, (number, chunk), profile, &mut compare);
        }
        compare(candidates);
        beams.iter_mut().for_each(Tile::leave_body);
    }
    let width = sector.columns.len();
    let mut part = Sweep::empty(rows * width);
    for tile in beams {
        tile.write(sector, met, &mut part, width);
    }
    part
}

/// Drops the Gaussians that no beam has kept a hit of.
fn drop_unkept(tiles: &mut [Tile], met: &mut Vec<Met>) {
    let mut kept = vec![false; met.len()];
    tiles.iter_mut().for_each(|tile| tile.visit_hits(&mut |at| kept[*at as usize] = true));
    // The new place of each, which is that of the number of those kept before it.
    let mut places = Vec::with_capacity(met.len());
    let mut count = 0;
    for is_kept in &kept {
        places.push(count);
        count += u32::from(*is_kept);
    }
    let mut is_kept = kept.iter();
    met.retain(|_| is_kept.next() == Some(&true));
    tiles.iter_mut().for_each(|tile| tile.visit_hits(&mut |at| *at = places[*at as usize]));
}

/// The chunks of a body, one at least, with their numbers in the scene.
pub(super) type ChunksOfBody<'a> = Vec<(usize, Body<'a>, &'a Chunk)>;

/// The chunks of each body.
pub(super) fn by_body(scene: &Scene) -> Vec<ChunksOfBody<'_>> {
    let mut bodies: Vec<ChunksOfBody<'_>> = Vec::new();
    for (number, (body, chunk)) in chunks(scene).enumerate() {
        match bodies.last_mut() {
            Some(last) if last[0].1.is_same(&body) => last.push((number, body, chunk)),
            _ => bodies.push(vec![(number, body, chunk)]),
        }
    }
    bodies
}
