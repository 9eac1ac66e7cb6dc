//! A route in blocks: a run of its own for each, on any machine and in any order.
//!
//! A block owns cells of 64 m. Its run moves the Gaussians in them and, so that nothing is torn at
//! the border, those within [`HALO_M`] of them; all others of the twin stay as they are, and are
//! drawn behind (cells with a halo, as in hierarchical 3D Gaussian splatting, Kerbl et al. 2024).
//! Only the owned cells are kept. Cells are disjoint, so blocks can be published in any order, and
//! nothing is blended.

use std::collections::BTreeSet;

use glam::{DVec2, DVec3};

use wildcity_render::View;
use wildcity_scene::chunk::CELL_M;

/// Gaussians this near to the cells of a block move with it, in metres.
pub const HALO_M: f64 = 24.0;

/// A block learns from images that see one of its Gaussians this near, in metres.
pub const SEEN_M: f64 = 80.0;

/// The cells of each block.
#[derive(Clone, Debug, PartialEq)]
pub struct Blocks {
    cells: Vec<BTreeSet<[i32; 2]>>,
}

/// More blocks than cells.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{blocks} blocks for {cells} cells of 64 m: give at most {cells} blocks")]
pub struct TooManyBlocks {
    blocks: usize,
    cells: usize,
}

impl Blocks {
    /// Divides cells, with their numbers of Gaussians, in their order along a path (world, in
    /// metres), so that blocks have nearly as many Gaussians each.
    ///
    /// # Errors
    /// There are fewer cells than blocks.
    pub fn new(
        cells: &[([i32; 2], u64)],
        path_m: &[DVec3],
        blocks: usize,
    ) -> Result<Self, TooManyBlocks> {
        if blocks == 0 || blocks > cells.len() {
            return Err(TooManyBlocks { blocks, cells: cells.len() });
        }
        let place = |cell: &[i32; 2]| {
            let distance = |at_m: &DVec3| middle_m(cell).distance_squared(at_m.truncate());
            let all = path_m.iter().map(distance).enumerate();
            all.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(index, _)| index)
        };
        let mut ordered: Vec<([i32; 2], u64)> = cells.to_vec();
        // Cells beside the same point of the path, and all cells without a path, go by their
        // numbers.
        ordered.sort_by_cached_key(|(cell, _)| (place(cell), *cell));
        let all: u64 = ordered.iter().map(|(_, count)| count).sum();
        let mut divided = vec![BTreeSet::new(); blocks];
        let mut block = 0;
        let mut before = 0;
        for (k, (cell, count)) in ordered.iter().enumerate() {
            // The next block begins where the middle of a cell is in its part, and at the latest
            // when there is just one cell left for each block that has none.
            let is_of_next = (2 * before + count) * blocks as u64 > 2 * all * (block as u64 + 1);
            let is_last_chance = ordered.len() - k == blocks - block - 1;
            let has_cell = !divided[block].is_empty();
            if has_cell && block + 1 < blocks && (is_of_next || is_last_chance) {
                block += 1;
            }
            divided[block].insert(*cell);
            before += count;
        }
        Ok(Self { cells: divided })
    }

    /// How many blocks there are.
    pub fn count(&self) -> usize {
        self.cells.len()
    }

    /// The cells that a block owns. Blocks are counted from 0.
    pub fn cells(&self, block: usize) -> &BTreeSet<[i32; 2]> {
        &self.cells[block]
    }

    /// How far a point lies from the cells of a block, in metres; 0 within.
    pub fn distance_m(&self, block: usize, at_m: DVec3) -> f64 {
        let distance = |cell: &[i32; 2]| {
            // A cell reaches half its width to each side of its middle.
            let off = (at_m.truncate() - middle_m(cell)).abs() - DVec2::splat(0.5 * CELL_M);
            off.max(DVec2::ZERO).length()
        };
        self.cells[block].iter().map(distance).fold(f64::INFINITY, f64::min)
    }
}

/// Whether a view shows one of some points that is nearer than [`SEEN_M`].
pub fn sees(view: &View, points_m: &[DVec3]) -> bool {
    let camera_from_world = view.world_from_camera.inverse();
    let size_px = DVec2::new(view.camera.width_px.into(), view.camera.height_px.into());
    points_m.iter().any(|point_m| {
        let at_m = camera_from_world.transform_point(*point_m);
        let is_near = at_m.length() < SEEN_M;
        let is_within = |px: DVec2| px.cmpge(DVec2::ZERO).all() && px.cmplt(size_px).all();
        is_near && view.camera.project(at_m).is_some_and(is_within)
    })
}

fn middle_m(cell: &[i32; 2]) -> DVec2 {
    CELL_M * DVec2::from_array(cell.map(f64::from))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_follow_the_path_and_share_the_gaussians() {
        // The path goes north: cells of x = 0 and 1 alternate.
        let path_m: Vec<DVec3> =
            (0..8).map(|k| DVec3::new(0.0, 32.0 * f64::from(k), 1.0)).collect();
        let cells: Vec<([i32; 2], u64)> =
            (0..4).flat_map(|y| [([1, y], 100), ([0, y], 100)]).collect();
        let blocks = Blocks::new(&cells, &path_m, 4).unwrap();
        for y in 0..4 {
            assert_eq!(*blocks.cells(y as usize), BTreeSet::from([[0, y], [1, y]]));
        }
        assert_eq!(blocks.distance_m(0, DVec3::new(10.0, 31.0, 5.0)), 0.0);
        assert_eq!(blocks.distance_m(0, DVec3::new(10.0, 35.0, 5.0)), 3.0);
    }

    #[test]
    fn each_block_has_a_cell_however_uneven_these_are() {
        for counts in [[1_000, 1, 1, 1], [1, 1, 1, 1_000], [1, 1_000, 1, 1], [0, 0, 0, 0]] {
            let cell = |(k, count)| ([k as i32, 0], count);
            let cells: Vec<([i32; 2], u64)> = counts.into_iter().enumerate().map(cell).collect();
            for blocks in 1..=4 {
                let divided = Blocks::new(&cells, &[], blocks).unwrap();
                let all: Vec<[i32; 2]> =
                    (0..blocks).flat_map(|block| divided.cells(block).clone()).collect();
                assert_eq!(all, cells.iter().map(|(cell, _)| *cell).collect::<Vec<_>>());
                assert!((0..blocks).all(|block| !divided.cells(block).is_empty()));
            }
            let refused = Blocks::new(&cells, &[], 5).unwrap_err();
            assert_eq!(refused.to_string(), "5 blocks for 4 cells of 64 m: give at most 4 blocks");
        }
    }
}
