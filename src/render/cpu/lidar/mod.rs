//! LiDAR sweeps in f32 with SIMD.
//!
//! A sweep is divided into *sectors*, runs of columns that look the same way: at most 64 columns
//! and one radian. A sector finds its *candidates*, Gaussians whose bounding box in the sector's
//! axes a beam may meet, 16 at a time; bins them to *tiles* of 16 x 16 beams; and compares a row of
//! 16 beams at a time with each. Beams keep their hits up to the return in order of range
//! ([`beam`]), so that the order of candidates changes no return, but the time: the nearest come
//! first, and what lies behind the returns of a tile is not compared with it.
//!
//! Positions are relative to the LiDAR in the middle of the sector, and a response is computed from
//! the distance of a line from a point in standard deviations, so that f32 loses 1e-5 m at 100 m
//! and nothing to a Gaussian that is flat.

mod beam;
mod candidates;
mod cast;
mod rows;
mod sector;
mod tile;

use fearless_simd::Level;
use parking_lot::Mutex;
use rayon::prelude::*;

use self::beam::BeamRow;
pub(crate) use self::candidates::{Candidate, Candidates, Reach};
use self::candidates::{MOST_CLUSTERS, SeenCluster};
use self::cast::Scratch;
pub(crate) use self::cast::search;
pub(crate) use self::sector::{BodySector, MOST_COLUMNS, Sector};
use crate::lidar::{MOST_HITS, Sweep, Task};
use wildcity_scene::chunk::{CLUSTER, LANES};
use wildcity_scene::geometry::Lidar;

/// As [`sweep`], with the best instruction set of the machine.
pub(crate) fn best_sweep(task: &Task<'_>) -> Sweep {
    sweep(best_level(), task)
}

/// The best instruction set of the machine.
pub(crate) fn best_level() -> Level {
    Level::new()
}

/// The sweep of a LiDAR. Runs on the current rayon pool; the result does not depend on it.
pub(crate) fn sweep(level: Level, task: &Task<'_>) -> Sweep {
    let view = task.view;
    let sectors = Sector::split(view);
    // As many as there are threads; rayon's own states are made anew for each piece of work.
    let free: Mutex<Vec<Scratch>> = Mutex::default();
    let part = |sector: &Sector| {
        let mut scratch = free.lock().pop().unwrap_or_default();
        let part = cast::sweep(sector, level, &mut scratch, task);
        free.lock().push(scratch);
        part
    };
    // In the order of the sectors, whatever thread has made them.
    let parts: Vec<Sweep> = sectors.par_iter().map(part).collect();
    let columns = view.lidar.columns();
    let mut sweep = Sweep::empty(view.lidar.beams());
    for (sector, part) in sectors.iter().zip(parts) {
        let width = sector.columns.len();
        for row in 0..view.lidar.rows() {
            let to = row * columns + sector.columns.start;
            let from = row * width..(row + 1) * width;
            sweep.range_m[to..to + width].copy_from_slice(&part.range_m[from.clone()]);
            sweep.intensity[to..to + width].copy_from_slice(&part.intensity[from.clone()]);
            sweep.instance[to..to + width].copy_from_slice(&part.instance[from.clone()]);
            sweep.gaussian[to..to + width].copy_from_slice(&part.gaussian[from]);
        }
    }
    sweep
}

/// An upper bound of the memory of a sweep on some threads, in bytes: its returns; and for each
/// thread its candidates, and beams full of the faintest hits.
pub(crate) fn most_bytes(lidar: &Lidar, threads: usize) -> u64 {
    let beams = most_beams(lidar);
    // Vectors grow to twice what they hold.
    let hits = 2 * beams * (MOST_HITS + BeamRow::SPARE_HITS) * BeamRow::HIT_BYTES;
    let returns = 2 * lidar.beams() * Sweep::BEAM_BYTES;
    // A sector has a column at least.
    let threads = threads.min(lidar.columns());
    (returns + threads * (hits + most_candidate_bytes(lidar, cast::BATCH))) as u64
}

/// An upper bound of the memory of the candidates of a sector, with their places in the lists of
/// tiles, in bytes.
pub(crate) fn most_candidate_bytes(lidar: &Lidar, batch: usize) -> usize {
    let tiles = most_beams(lidar) / (LANES * LANES);
    let place = size_of::<u32>();
    let candidate = size_of::<Candidate>() + size_of::<Reach>() + place + place * tiles;
    // A batch is compared after the cluster that fills it; vectors grow to twice what they hold.
    2 * (batch + CLUSTER) * candidate + MOST_CLUSTERS * size_of::<SeenCluster>()
}

/// Most beams of a sector, in whole tiles.
fn most_beams(lidar: &Lidar) -> usize {
    let columns = lidar.columns().min(MOST_COLUMNS).next_multiple_of(LANES);
    lidar.rows().next_multiple_of(LANES) * columns
}
