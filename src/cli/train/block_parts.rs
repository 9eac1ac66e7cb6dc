//! The Gaussians of a twin as a block sees them: those that move, and those around.

use glam::DVec3;
use wildcity_scene::Gaussians;
use wildcity_scene::geometry::Bounds;
use wildcity_train::blocks::{Blocks, HALO_M};
use wildcity_twin::store::{Catalog, Version};

/// Gaussians of a block, at most, that decide which images see it.
const SAMPLE: usize = 2_000;

/// Gaussians of the twin are drawn behind a block up to this distance from it, in metres.
const BEHIND_M: f64 = 300.0;

/// The Gaussians of a twin as a block sees them.
pub(super) struct Parts {
    /// Those in its cells and near them.
    pub(super) moving: Gaussians,
    /// Those around, which stay.
    pub(super) around: Gaussians,
    /// Means of some in its cells, and of some near them, in metres.
    pub(super) own_m: Vec<DVec3>,
    pub(super) halo_m: Vec<DVec3>,
}

impl Parts {
    pub(super) fn read(
        catalog: &Catalog,
        version: &Version,
        blocks: &Blocks,
        block: usize,
    ) -> anyhow::Result<Self> {
        let sh_degree = version.manifest.sh_degree;
        let empty = || Gaussians { sh_degree, ..Gaussians::default() };
        let mut moving = empty();
        let mut around = empty();
        let mut own_m = Vec::new();
        let mut halo_m = Vec::new();
        let is_near = |bounds: &Bounds| {
            let middle_m = 0.5 * (bounds.min_m + bounds.max_m);
            // Half the diagonal: no point of the box is farther from its middle.
            let half_m = middle_m.distance(bounds.max_m);
            blocks.distance_m(block, middle_m) <= BEHIND_M + half_m
        };
        catalog.visit_full_detail(version, &is_near, &mut |section| {
            let distances: Vec<f64> = section
                .means_m
                .iter()
                .map(|mean_m| blocks.distance_m(block, DVec3::from_array(*mean_m)))
                .collect();
            let at = |is_one: &dyn Fn(f64) -> bool| {
                (0..section.len()).filter(|&k| is_one(distances[k])).collect::<Vec<_>>()
            };
            let moves = at(&|distance_m| distance_m <= HALO_M);
            for &k in &moves {
                let mean_m = DVec3::from_array(section.means_m[k]);
                // The distance is 0 within the cells of the block.
                if distances[k] > 0.0 { halo_m.push(mean_m) } else { own_m.push(mean_m) }
            }
            moving.append(&section.select(moves));
            around.append(&section.select(at(&|distance_m| distance_m > HALO_M)));
        })?;
        Ok(Self { moving, around, own_m: sample(own_m), halo_m: sample(halo_m) })
    }
}

/// Some of all points, at equal distances in their list.
pub(super) fn sample(points_m: Vec<DVec3>) -> Vec<DVec3> {
    // Spread over all: the order of the points is that of the cells.
    let every = points_m.len().div_ceil(SAMPLE).max(1);
    points_m.into_iter().step_by(every).collect()
}
