//! The outputs of the stages project, sort and bin, in one plain form that every tiled backend can
//! give and take.
//!
//! The cpu backend gives them after any stage, and the gpu backend continues from them
//! ([`hybrid`](crate::hybrid)), so that a wrong image is traced to its stage (`wildcity dev
//! bisect`). Tests compare single stages on the same buffers: each mutation of the shaders in
//! `tests/gpu/mutations.rs` must fail the stages that share the mutated shader, and no other. (The
//! idea is Vello's "CPU up to a stage".)

use super::layout::Splat;
use wildcity_scene::SemanticClass;

/// A stage with an output for the next one. The last stage, rasterize, produces pixels instead.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    Project,
    /// Splats are put in order of (view, depth).
    Sort,
    /// Every tile gets its list of splats.
    Bin,
}

impl Stage {
    /// All stages, in order.
    pub const ALL: [Self; 3] = [Self::Project, Self::Sort, Self::Bin];

    /// The stage's name, as in [`FrameStats::stages_ms`](crate::FrameStats::stages_ms).
    pub fn name(self) -> &'static str {
        match self {
            Self::Project => "project",
            Self::Sort => "sort",
            Self::Bin => "bin",
        }
    }
}

/// The outputs of a frame's stages up to one of them. The output of sort requires that of project,
/// and that of bin requires both.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StageOutputs {
    /// Output of project: all views' splats, in order of (view, global id).
    pub splats: Vec<Splat>,
    /// The sort key of each splat: [`Cutoffs::sort_key`](super::layout::Cutoffs::sort_key).
    pub keys: Vec<u32>,
    /// Output of sort: indices of splats in order of their keys, equal keys in order of indices.
    pub order: Option<Vec<u32>>,
    pub tiles: Option<TileLists>,
    /// Output of project: the owners of the splats, for instance ids and classes, in order of
    /// `first_splat`.
    /// Empty on the gpu backend.
    pub owners: Vec<SplatOwner>,
}

/// The owner of the splats from a place of [`StageOutputs::splats`] on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplatOwner {
    /// Index of the first splat.
    pub first_splat: u32,
    /// The instance that [`Target::instances`](crate::Target::instances) shows of these splats.
    pub instance: u16,
    /// The class that [`Target::semantics`](crate::Target::semantics) shows of these splats.
    pub class: SemanticClass,
}

/// The lists of splats of all tiles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TileLists {
    /// First and end of each tile's list in `instances`: view after view, each row by row.
    pub ranges: Vec<[u32; 2]>,
    /// Indices of splats, in each list in the order of sort.
    pub instances: Vec<u32>,
}

impl StageOutputs {
    /// The last stage with an output here.
    pub fn last_stage(&self) -> Stage {
        // Tiles make it bin, with or without an order.
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
        // A faulty stage on another backend may give any range.
        self.instances.get(first as usize..end as usize).unwrap_or_default()
    }
}
