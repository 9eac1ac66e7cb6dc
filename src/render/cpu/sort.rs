//! Stage sort: all views' splats in order of (view, depth, global id).

use rayon::prelude::*;

use super::project::Projected;
use crate::constants::DEPTH_BITS;
use crate::layout::Cutoffs;

/// The order of a frame's splats.
#[derive(Debug, Default)]
pub(super) struct Sorted {
    /// [`Cutoffs::sort_key`] (32 bits), then the place in the projection (32 bits).
    keys: Vec<u64>,
}

impl Sorted {
    /// Sorts what the projection left. Keys differ by their place, so any sort gives one order,
    /// and the place counts through (view, global id): equal depths keep the order of ids.
    pub(super) fn sort(&mut self, projected: &Projected, cutoffs: &Cutoffs) {
        let len = projected.len();
        self.keys.clear();
        self.keys.reserve_exact(len);
        self.keys.resize(len, 0);
        let mut rest = self.keys.as_mut_slice();
        let units = projected.units().iter().map(|unit| {
            let (keys, after) = std::mem::take(&mut rest).split_at_mut(unit.len);
            rest = after;
            (unit, keys)
        });
        units.collect::<Vec<_>>().into_par_iter().for_each(|(unit, keys)| {
            for (key, (place, splat)) in keys.iter_mut().zip(projected.unit(unit)) {
                let by = cutoffs.sort_key(unit.view, splat.depth_m);
                *key = u64::from(by) << 32 | u64::from(place);
            }
        });
        self.keys.par_sort_unstable();
    }

    /// Places in the projection of all views' splats, in order.
    pub(super) fn places(&self) -> impl Iterator<Item = u32> {
        self.keys.iter().map(|&key| key as u32)
    }

    /// Keys of one view's splats, from the nearest; the low half is the place in the projection.
    pub(super) fn view(&self, view: usize) -> &[u64] {
        let shift = DEPTH_BITS + 32;
        let first = |view: u64| self.keys.partition_point(|&key| key >> shift < view);
        &self.keys[first(view as u64)..first(view as u64 + 1)]
    }
}
