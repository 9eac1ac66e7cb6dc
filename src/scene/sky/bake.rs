//! Baking a sky network into cube maps with a known error bound.
//!
//! There are four levels, each of twice the resolution of the previous one. A request gets the
//! coarsest map whose error is small enough. So a sky has at most four maps, of 0.8, 3, 13 and 50
//! MB, for any combination of requests, and none is baked twice.
//!
//! The error of a grid is measured against a grid of twice the resolution, at the middle of every
//! edge of a cell and at its centre. For a smooth function these are the points where the error of
//! a bilinear patch is largest. Now let a ReLU change the slope by k between two nodes, at a
//! fraction `a` below a half. The error of linear interpolation is then `a (1 - a) k` at that point
//! and `a k / 2` in the middle: at most twice the measured error. So the bound is twice the largest
//! difference, plus rounding to 16 bits. The largest change of slope determines it: at the default
//! `sky_error` of 0.025, the error of 99 of 100 directions of the demo's sky is less than a step of
//! 8 bits.
//!
//! The first grid has 129 values along an edge, at most 0.9° apart, and is compared with one of
//! 0.45°. The finest sine of seven octaves has a period of 5.6°, so no feature of it falls between
//! the samples.

use std::sync::Arc;

use fearless_simd::{Level as Simd, dispatch, f32x16, prelude::*};
use parking_lot::{Mutex, MutexGuard};
use rayon::prelude::*;

use super::{CubeMap, FACES, InferenceNetwork, SkyError};
use crate::chunk::LANES;

/// Number of values along an edge of the first grid.
const FIRST_EDGE: usize = 129;

/// The maps of a network that have been baked, and the error bounds of its levels.
#[derive(Debug, Default)]
pub(super) struct Maps {
    /// The coarsest first. Locked only briefly, so that frames whose map exists never wait for a
    /// bake.
    levels: Mutex<Vec<Level>>,
    /// Locked while baking, so that concurrent requests for the same map wait for it instead of
    /// baking it again.
    baking: Mutex<()>,
}

#[derive(Debug)]
struct Level {
    /// Error bound of a map of this resolution.
    error: f64,
    /// The map, if it was requested.
    map: Option<Arc<CubeMap>>,
}

impl Maps {
    /// The coarsest map whose error is at most `wanted`.
    ///
    /// # Errors
    /// [`SkyError::Coarse`] if the error of the finest map is larger.
    pub(super) fn get(
        &self,
        network: &InferenceNetwork,
        wanted: f64,
    ) -> Result<Arc<CubeMap>, SkyError> {
        if let Ok(answer) = self.known(wanted) {
            return answer;
        }
        let _baking = self.baking.lock();
        // From here on this thread is the only one that bakes. Another may have finished while it
        // waited.
        let simd = Simd::new();
        // The finer grid of a round is the grid of the next one, so that no network value is
        // computed twice.
        let mut next: Option<Grid> = None;
        loop {
            let level = match self.known(wanted) {
                Ok(answer) => return answer,
                Err(level) => level,
            };
            let fits = |grid: &Grid| grid.edge == edge(level);
            let kept = next.take().filter(fits);
            let grid = kept.unwrap_or_else(|| Grid::new(simd, network, edge(level)));
            let known = self.levels().get(level).map(|level| level.error);
            let error = known.unwrap_or_else(|| {
                let finer = next.insert(Grid::new(simd, network, edge(level + 1)));
                2.0 * grid.difference(finer) + CubeMap::STEP
            });
            // A level that is too coarse is recorded with its error and without a map.
            let map = (error <= wanted).then(|| Arc::new(grid.map(error)));
            let mut levels = self.levels();
            match levels.get_mut(level) {
                Some(known) => known.map = map,
                None => levels.push(Level { error, map }),
            }
        }
    }

    /// The answer if it is known, or else the level to bake next.
    fn known(&self, wanted: f64) -> Result<Result<Arc<CubeMap>, SkyError>, usize> {
        let levels = self.levels();
        // Coarsest first: the first level that is good enough is the smallest map.
        let found = levels.iter().position(|level| level.error <= wanted);
        let level = found.unwrap_or(levels.len());
        match levels.get(level) {
            Some(Level { map: Some(map), .. }) => Ok(Ok(map.clone())),
            None if edge(level) > CubeMap::MAX_EDGE => {
                let reached = levels.last().map_or(f64::INFINITY, |level| level.error);
                Ok(Err(SkyError::Coarse { edge: CubeMap::MAX_EDGE, reached, wanted }))
            }
            _ => Err(level),
        }
    }

    /// Memory of the maps, in bytes.
    pub(super) fn bytes(&self) -> usize {
        self.levels().iter().filter_map(|level| level.map.as_ref()).map(|map| map.bytes()).sum()
    }

    fn levels(&self) -> MutexGuard<'_, Vec<Level>> {
        self.levels.lock()
    }
}

/// Number of values along an edge of the grids of a level.
fn edge(level: usize) -> usize {
    // Twice as many cells as the level before, and one node more than cells: nodes of a level are
    // also nodes of the next.
    ((FIRST_EDGE - 1) << level) + 1
}

/// Values of the network at `i / (edge - 1)` along both sides of six faces.
struct Grid {
    edge: usize,
    rgb: Vec<[f32; 3]>,
}

impl Grid {
    fn new(level: Simd, network: &InferenceNetwork, edge: usize) -> Self {
        let mut rgb = vec![[0.0; 3]; FACES * edge * edge];
        // A row is a job and owns its slice, so that no lock is needed; each thread has its own
        // scratch memory.
        rgb.par_chunks_mut(edge).enumerate().for_each_init(
            || network.scratch(),
            |scratch, (row, to)| {
                let face = row / edge;
                let t = (row % edge) as f64 / (edge - 1) as f64;
                for (block, to) in to.chunks_mut(LANES).enumerate() {
                    let mut directions = [[0.0; LANES]; 3];
                    for lane in 0..LANES {
                        // Lanes beyond the edge repeat the last column; their results are not
                        // copied.
                        let column = (block * LANES + lane).min(edge - 1);
                        let s = column as f64 / (edge - 1) as f64;
                        let away =
                            CubeMap::direction(face, [s, t]).normalize().as_vec3().to_array();
                        for (axis, value) in directions.iter_mut().zip(away) {
                            axis[lane] = value;
                        }
                    }
                    let [r, g, b] = dispatch!(level, simd => {
                        let load = |axis: usize| f32x16::load_array_ref(simd, &directions[axis]);
                        network.rgb(simd, [load(0), load(1), load(2)], scratch)
                    });
                    for (lane, to) in to.iter_mut().enumerate() {
                        *to = [r[lane], g[lane], b[lane]];
                    }
                }
            },
        );
        Self { edge, rgb }
    }

    fn map(&self, error: f64) -> CubeMap {
        CubeMap::from_nodes(self.edge, &self.rgb, error)
    }

    /// Largest difference of the bilinear patches from the values of a grid of twice the
    /// resolution.
    fn difference(&self, finer: &Self) -> f64 {
        let rows = finer.rgb.par_chunks(finer.edge).enumerate();
        let worst = rows.map(|(row, values)| {
            let face = row / finer.edge;
            let row = row % finer.edge;
            let coarse =
                |row: usize| &self.rgb[(face * self.edge + row) * self.edge..][..self.edge];
            // An even row of the finer grid is a row of the coarser one, and an odd one lies
            // between two: then `above` and `below` differ.
            let above = coarse(row / 2);
            let below = coarse(row.div_ceil(2));
            let mut worst: f32 = 0.0;
            for (column, value) in values.iter().enumerate() {
                let left = column / 2;
                let right = column.div_ceil(2);
                for c in 0..3 {
                    // On a node all four are the same value, on the middle of an edge two and two,
                    // in the centre of a cell four: the mean is the bilinear patch in each case.
                    let patch = above[left][c] + above[right][c] + below[left][c] + below[right][c];
                    worst = worst.max((0.25 * patch - value[c]).abs());
                }
            }
            worst
        });
        f64::from(worst.reduce(|| 0.0, f32::max))
    }
}
