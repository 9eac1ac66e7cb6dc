//! What the stages have left so far, for another backend to go on with.

use super::Scratch;
use crate::layout::Cutoffs;
use crate::stage::{Stage, StageOutputs, TileLists};

/// Copies what the stages up to `last` left, with splats side by side instead of on pages.
pub(super) fn between(scratch: &Scratch, last: Stage, cutoffs: &Cutoffs) -> StageOutputs {
    let Scratch { projected, sorted, bins } = scratch;
    let mut between = StageOutputs::default();
    // The index of the splat at each place.
    let mut indices = vec![0; projected.places()];
    for unit in projected.units() {
        for (place, splat) in projected.unit(unit) {
            indices[place as usize] = between.splats.len() as u32;
            between.splats.push(*splat);
            between.keys.push(cutoffs.sort_key(unit.view, splat.depth_m));
        }
    }
    if last >= Stage::Sort {
        between.order = Some(sorted.places().map(|place| indices[place as usize]).collect());
    }
    if last >= Stage::Bin {
        between.tiles = Some(TileLists {
            ranges: bins.starts().windows(2).map(|tile| [tile[0], tile[1]]).collect(),
            instances: bins.places().map(|place| indices[place as usize]).collect(),
        });
    }
    between
}
