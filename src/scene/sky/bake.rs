//! A network as cube maps whose error is known.
//!
//! There are four, each of twice the resolution of the one before, and what is asked for gets the coarsest that
//! is close enough. So whoever asks for what, a sky has at most four maps, of 0.8, 3, 13 and 50 MB, and none is
//! baked twice.
//!
//! A grid is compared with one of twice its resolution: at the middle of every edge of a cell and at
//! its centre. Where a function bends smoothly, that is where a bilinear patch is farthest off. Where it
//! has one kink (ReLU) between two nodes, at `a` of the way, a line is off by `a (1 - a)` of the kink
//! there and by `a / 2` in the middle (a below a half): at most twice what is seen. So twice the largest
//! difference is the error that is stated, and rounding to 16 bits on top.
//!
//! The first grid has 129 values along an edge, 0.9° or less apart, and is compared with one of 0.45°: the
//! finest sine of seven octaves has a period of 5.6°, so that nothing that it draws lies unseen between.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use fearless_simd::{Level as Simd, dispatch, f32x16, prelude::*};
use rayon::prelude::*;

use super::{CubeMap, FACES, InferenceNetwork, SkyError};
use crate::chunk::LANES;

/// Values along an edge of the first grid.
const FIRST_EDGE: usize = 129;

/// What is known of the maps of a network.
#[derive(Debug, Default)]
pub(super) struct Maps {
    /// The coarsest first. Held for moments alone: frames that have their map never wait for one that is
    /// baked for somebody else.
    levels: Mutex<Vec<Level>>,
    /// Whoever bakes; who comes meanwhile waits for the map rather than bakes another.
    baking: Mutex<()>,
}

#[derive(Debug)]
struct Level {
    /// How far a map of this resolution is off, at most.
    error: f64,
    /// It, if anybody asked for it.
    map: Option<Arc<CubeMap>>,
}

impl Maps {
    /// The coarsest map whose error is at most `wanted`.
    ///
    /// # Errors
    /// [`SkyError::Coarse`] if the finest one is worse.
    pub(super) fn get(
        &self,
        network: &InferenceNetwork,
        wanted: f64,
    ) -> Result<Arc<CubeMap>, SkyError> {
        if let Ok(answer) = self.known(wanted) {
            return answer;
        }
        let _turn = self.baking.lock().unwrap_or_else(PoisonError::into_inner);
        let simd = Simd::new();
        let mut next: Option<Grid> = None;
        loop {
            let level = match self.known(wanted) {
                Ok(answer) => return answer,
                Err(level) => level,
            };
            let fits = |grid: &Grid| grid.edge == edge(level);
            let grid = next.take().filter(fits);
            let grid = grid.unwrap_or_else(|| Grid::new(simd, network, edge(level)));
            let known = self.levels().get(level).map(|level| level.error);
            let error = known.unwrap_or_else(|| {
                let finer = next.insert(Grid::new(simd, network, edge(level + 1)));
                2.0 * grid.difference(finer) + CubeMap::STEP
            });
            let map = (error <= wanted).then(|| Arc::new(grid.map(error)));
            let mut levels = self.levels();
            match levels.get_mut(level) {
                Some(known) => known.map = map,
                None => levels.push(Level { error, map }),
            }
        }
    }

    /// What is known to be the answer, or else the level that is to be baked.
    fn known(&self, wanted: f64) -> Result<Result<Arc<CubeMap>, SkyError>, usize> {
        let levels = self.levels();
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
        self.levels.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Values along an edge of the grids of a level.
fn edge(level: usize) -> usize {
    ((FIRST_EDGE - 1) << level) + 1
}

/// The network at `i / (edge - 1)` along both sides of six faces.
struct Grid {
    edge: usize,
    rgb: Vec<[f32; 3]>,
}

impl Grid {
    fn new(level: Simd, network: &InferenceNetwork, edge: usize) -> Self {
        let mut rgb = vec![[0.0; 3]; FACES * edge * edge];
        rgb.par_chunks_mut(edge).enumerate().for_each_init(
            || network.scratch(),
            |scratch, (row, to)| {
                let (face, t) = (row / edge, (row % edge) as f64 / (edge - 1) as f64);
                for (block, to) in to.chunks_mut(LANES).enumerate() {
                    let mut directions = [[0.0; LANES]; 3];
                    for lane in 0..LANES {
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

    /// How far its patches are from the values of a grid of twice the resolution, at most.
    fn difference(&self, finer: &Self) -> f64 {
        let rows = finer.rgb.par_chunks(finer.edge).enumerate();
        let worst = rows.map(|(row, values)| {
            let (face, row) = (row / finer.edge, row % finer.edge);
            let coarse =
                |row: usize| &self.rgb[(face * self.edge + row) * self.edge..][..self.edge];
            let (above, below) = (coarse(row / 2), coarse(row.div_ceil(2)));
            let mut worst: f32 = 0.0;
            for (column, value) in values.iter().enumerate() {
                let (left, right) = (column / 2, column.div_ceil(2));
                for c in 0..3 {
                    let patch = above[left][c] + above[right][c] + below[left][c] + below[right][c];
                    worst = worst.max((0.25 * patch - value[c]).abs());
                }
            }
            worst
        });
        f64::from(worst.reduce(|| 0.0, f32::max))
    }
}
