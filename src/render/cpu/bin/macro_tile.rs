//! Stage sort: the splats of one macro tile in order of depth, and the lists of its tiles.

use crate::cpu::sort::sort_by_depth;

use super::Scratch;
use super::segment::{Pair, Segment};

/// Most tiles of a macro tile: bits of a mask.
const MACRO_TILE_TILES: usize = 32;

/// Where the lists of one macro tile are.
#[derive(Clone, Debug, Default)]
pub(super) struct MacroTile {
    /// Its part of the instances.
    pub(super) first: u32,
    pub(super) len: u32,
    /// End of each tile's list, from `first`.
    pub(super) ends: [u32; MACRO_TILE_TILES],
}
impl MacroTile {
    /// Puts the splats of the macro tile `number` of a view in order of depth, and lists them by tile.
    pub(super) fn list(
        &mut self,
        number: usize,
        segments: &[Segment],
        scratch: &mut Scratch,
        instances: &mut [u32],
    ) {
        let Scratch { pairs, keys, other, .. } = scratch;
        pairs.clear();
        keys.clear();
        for segment in segments {
            pairs.extend_from_slice(segment.of(number));
        }
        keys.extend((0..).zip(&*pairs).map(|(index, pair)| u64::from(pair.depth) << 32 | index));
        sort_by_depth(keys, other);

        // Count the splats of each tile, and turn the counts into places.
        let mut next = [0; MACRO_TILE_TILES];
        for pair in &*pairs {
            let mut tiles = pair.tiles;
            while tiles != 0 {
                next[tiles.trailing_zeros() as usize % MACRO_TILE_TILES] += 1;
                tiles &= tiles - 1;
            }
        }
        let mut end = 0;
        for next in &mut next {
            let start = end;
            end += *next;
            *next = start;
        }

        for &key in &*keys {
            let Pair { place, mut tiles, .. } = pairs[key as u32 as usize];
            while tiles != 0 {
                let next = &mut next[tiles.trailing_zeros() as usize % MACRO_TILE_TILES];
                instances[*next as usize] = place;
                *next += 1;
                tiles &= tiles - 1;
            }
        }
        self.ends = next;
    }
}
