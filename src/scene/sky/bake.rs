//! A network as a cube map whose error is known.
//!
//! A grid is compared with one of twice its resolution: at the middle of every edge of a cell and at
//! its centre. Where a function bends smoothly, that is where a bilinear patch is farthest off. Where it
//! has one kink (ReLU) between two nodes, at `a` of the way, a line is off by `a (1 - a)` of the kink
//! there and by `a / 2` in the middle (a below a half): at most twice what is seen. So twice the largest
//! difference is the error that is stated, and rounding to 16 bits on top.
//!
//! The first grid has 129 values along an edge, 0.9° or less apart, and is compared with one of 0.45°: the
//! finest sine of seven octaves has a period of 5.6°, so that nothing that it draws lies unseen between.

use fearless_simd::{Level, dispatch, f32x16, prelude::*};
use rayon::prelude::*;

use super::{CubeMap, FACES, Folded, SkyError};
use crate::scene::chunk::LANES;

/// Values along an edge of the first grid.
const FIRST_EDGE: usize = 129;

/// The coarsest map whose error is at most `wanted`.
///
/// # Errors
/// [`SkyError::Coarse`] if the finest one is worse.
pub(super) fn bake(network: &Folded, wanted: f64) -> Result<CubeMap, SkyError> {
    let level = Level::new();
    let mut grid = Grid::new(level, network, FIRST_EDGE);
    loop {
        let finer = Grid::new(level, network, 2 * grid.edge - 1);
        let error = 2.0 * grid.difference(&finer) + CubeMap::STEP;
        if error <= wanted {
            return Ok(CubeMap::from_nodes(grid.edge, &grid.rgb, error));
        }
        if finer.edge > CubeMap::MAX_EDGE {
            return Err(SkyError::Coarse { edge: grid.edge, reached: error, wanted });
        }
        grid = finer;
    }
}

/// The network at `i / (edge - 1)` along both sides of six faces.
struct Grid {
    edge: usize,
    rgb: Vec<[f32; 3]>,
}

impl Grid {
    fn new(level: Level, network: &Folded, edge: usize) -> Self {
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
