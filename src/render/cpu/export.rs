//! The outputs of the stages in their plain form, for another backend to continue from or compare
//! with.

use rayon::prelude::*;

use super::bin::MacroTile;
use super::{Scratch, StageTimer};
use crate::FrameStats;
use crate::layout::Cutoffs;
use crate::stage::{SplatOwner, Stage, StageOutputs, TileLists};

/// Copies the outputs of the stages up to and including `last`. Splats are numbered without the
/// gaps at the ends of pages.
pub(super) fn stage_outputs(
    scratch: &Scratch,
    last: Stage,
    cutoffs: &Cutoffs,
    stats: &mut FrameStats,
) -> StageOutputs {
    let Scratch { projected, bins, .. } = scratch;
    let mut timer = StageTimer::start();
    let mut outputs = StageOutputs::default();
    // The number of the splat at each place.
    // Pages are filled in part, so that places have gaps; numbers have none.
    let mut index_of_place = vec![0; projected.places()];
    for unit in projected.units() {
        let instance = unit.instance;
        for (place, splat) in projected.unit(unit) {
            let first_splat = outputs.splats.len() as u32;
            index_of_place[place as usize] = first_splat;
            // One entry per run of splats of the same owner, and not per splat.
            let class = projected.class_in(unit, place);
            let is_same = |last: &SplatOwner| (last.instance, last.class) == (instance, class);
            if !outputs.owners.last().is_some_and(is_same) {
                outputs.owners.push(SplatOwner { first_splat, instance, class });
            }
            outputs.splats.push(*splat);
            outputs.keys.push(cutoffs.sort_key(unit.view, splat.depth_m));
        }
    }
    let index = |place: u32| index_of_place[place as usize];
    timer.finish("hand over", stats);
    if last >= Stage::Sort {
        // The cpu backend itself needs no order of whole views. The sort is stable: equal keys keep
        // the order of global ids.
        let mut order: Vec<u32> = (0..outputs.splats.len() as u32).collect();
        order.par_sort_by_key(|&splat| outputs.keys[splat as usize]);
        outputs.order = Some(order);
        timer.finish("sort", stats);
    }
    if last >= Stage::Bin {
        // Bin comes before sort in this backend, so that a macro tile is loaded, and its tiles
        // sorted, here only for the sake of the plain form.
        let mut lists = TileLists::default();
        let mut loaded = MacroTile::default();
        for (view, grid) in bins.grids().iter().enumerate() {
            let first_tile = lists.ranges.len();
            lists.ranges.resize(first_tile + grid.tiles(), [0; 2]);
            for number in 0..grid.macro_tiles() {
                bins.load(view, number, &mut loaded);
                for (within, [column, row]) in grid.macro_tile_tiles(number) {
                    let start = lists.instances.len() as u32;
                    let places = loaded.tile(within).iter().map(|&splat| loaded.place(splat));
                    lists.instances.extend(places.map(index));
                    // Tiles of a macro tile are not consecutive in the view: ranges are put at each
                    // tile's number, and lists lie in the order of macro tiles.
                    let tile = (row * grid.columns + column) as usize;
                    lists.ranges[first_tile + tile] = [start, lists.instances.len() as u32];
                }
            }
        }
        outputs.tiles = Some(lists);
        timer.finish("hand over", stats);
    }
    outputs
}
