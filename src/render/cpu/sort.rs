//! Stage sort: all views' splats in order of (view, depth, global id).

use rayon::prelude::*;

use super::project::Projected;

/// The order of a frame's splats.
#[derive(Debug, Default)]
pub(super) struct Sorted {
    /// `view (4 bits) | depth (28 bits) | place in the projection (32 bits)`.
    keys: Vec<u64>,
}

impl Sorted {
    /// Sorts what the projection left. Keys differ by their place, so any sort gives one order,
    /// and the place counts through (view, global id): equal depths keep the order of ids.
    pub(super) fn sort(&mut self, projected: &Projected) {
        self.keys.clear();
        self.keys.reserve_exact(projected.units().iter().map(|unit| unit.keys.len()).sum());
        self.keys.extend(projected.units().iter().flat_map(|unit| &unit.keys));
        self.keys.par_sort_unstable();
    }

    /// How many splats.
    pub(super) fn len(&self) -> usize {
        self.keys.len()
    }

    /// Places of one view's splats in the projection, from the nearest.
    pub(super) fn view(&self, view: usize) -> &[u64] {
        let first = |view: u64| self.keys.partition_point(|&key| key >> 60 < view);
        &self.keys[first(view as u64)..first(view as u64 + 1)]
    }
}
