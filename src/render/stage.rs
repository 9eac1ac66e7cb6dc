//! What lies between the stages, in the one form that every tiled backend can give and take: so that
//! one can go on where another stopped, and that the same buffers can be given to both.

use super::layout::Splat;

/// A stage that leaves something to the next one. The last one, rasterize, leaves pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// Gaussians become splats.
    Project,
    /// Splats are put in order of (view, depth).
    Sort,
    /// Every tile gets its list of splats.
    Bin,
}

impl Stage {
    /// All of them, in order.
    pub const ALL: [Self; 3] = [Self::Project, Self::Sort, Self::Bin];

    /// The name of the field.
    pub fn name(self) -> &'static str {
        match self {
            Self::Project => "project",
            Self::Sort => "sort",
            Self::Bin => "bin",
        }
    }
}

/// What the stages up to one of them leave of a frame: that of sort needs that of project, and so on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StageOutputs {
    /// From project: all views' splats, in order of (view, global id).
    pub splats: Vec<Splat>,
    /// What each splat is sorted by: [`Cutoffs::sort_key`](super::layout::Cutoffs::sort_key).
    pub keys: Vec<u32>,
    /// From sort: indices of splats, by their keys, those with equal keys in order.
    pub order: Option<Vec<u32>>,
    /// From bin.
    pub tiles: Option<TileLists>,
}

/// The lists of splats of all tiles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TileLists {
    /// First and end of each tile's list in `instances`: all views, one after the other, row by row.
    pub ranges: Vec<[u32; 2]>,
    /// Indices of splats, in each list in the order that sort left.
    pub instances: Vec<u32>,
}

impl StageOutputs {
    /// The last stage that is done.
    pub fn last_stage(&self) -> Stage {
        match (&self.order, &self.tiles) {
            (_, Some(_)) => Stage::Bin,
            (Some(_), None) => Stage::Sort,
            (None, None) => Stage::Project,
        }
    }
}

impl TileLists {
    /// The list of one tile; empty if its range lies outside of the instances.
    pub fn list(&self, tile: usize) -> &[u32] {
        let [first, end] = self.ranges[tile];
        self.instances.get(first as usize..end as usize).unwrap_or_default()
    }
}
