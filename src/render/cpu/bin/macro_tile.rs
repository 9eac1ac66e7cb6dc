//! Stage sort: the splats of one macro tile in order of depth, and the lists of its tiles.
//!
//! A thread has one macro tile at a time, with copies of its splats: they stay in the caches while
//! its tiles are sorted and drawn. Read tile by tile from where they were projected, they came from
//! memory about twice each, and `rasterize` waited for them during 40 % of its time on dense
//! captures.

use crate::cpu::project::Projected;
use crate::cpu::sort::sort_by_depth;
use crate::layout::Splat;

use super::segment::{Pair, Segment};

/// Most tiles of a macro tile: bits of a mask.
const MACRO_TILE_TILES: usize = 32;

/// Most splats that are copied: 6 MB. With more, copies would not stay in the caches.
const MAX_COPIES: usize = 1 << 17;

/// Most bytes of copies.
pub(in crate::cpu) const COPIES_BYTES: u64 = (MAX_COPIES * size_of::<Splat>()) as u64;

/// Most pairs and instances whose memory a thread keeps for the next macro tile: 12 MB.
const MAX_KEPT: usize = 1 << 18;

/// The splats of one macro tile, and the lists of its tiles.
#[derive(Debug, Default)]
pub(in crate::cpu) struct MacroTile {
    /// The pairs, in order of global ids.
    pairs: Vec<Pair>,
    /// The splat of each pair; empty if there are too many.
    copies: Vec<Splat>,
    /// Indices of pairs, tile after tile, from the nearest splat. Values after the last list are
    /// meaningless.
    instances: Vec<u32>,
    /// End of each tile's list in `instances`.
    ends: [u32; MACRO_TILE_TILES],
    /// Depth (32 bits), then the index of the pair.
    keys: Vec<u64>,
    other: Vec<u64>,
}

/// The sorted lists of the tiles of a macro tile.
#[derive(Debug, Default)]
pub(in crate::cpu) struct MacroTileLists {
    instances: Vec<u32>,
    ends: [u32; MACRO_TILE_TILES],
}

impl MacroTile {
    /// Takes the splats of the macro tile `number` of a view, puts them in order of depth, and
    /// lists them by tile.
    #[inline(always)]
    pub(super) fn load(&mut self, number: usize, segments: &[Segment]) {
        self.load_pairs(number, segments);
        let Self { pairs, instances, ends, keys, other, .. } = self;
        keys.clear();
        keys.extend((0..).zip(&*pairs).map(|(index, pair)| u64::from(pair.depth) << 32 | index));
        sort_by_depth(keys, other);

        // Count the splats of each tile, and turn the counts into places. Without branches on the
        // bits, which are hard to predict: the compiler makes vector instructions of the inner
        // loop.
        let mut counts = [0; MACRO_TILE_TILES];
        for pair in &*pairs {
            for (tile, count) in counts.iter_mut().enumerate() {
                *count += pair.tiles >> tile & 1;
            }
        }
        // Number 32, "no tile", writes to one place after the end again and again.
        let mut next = [0; 2 * MACRO_TILE_TILES];
        let mut end = 0;
        for (next, count) in next.iter_mut().zip(counts) {
            *next = end;
            end += count;
        }
        next[MACRO_TILE_TILES] = end;
        if instances.len() <= end as usize {
            // One place more than instances, for the writes of "no tile".
            instances.resize(end as usize + 1, 0);
        }
        let instances = instances.as_mut_slice();

        // Most pairs have one or two tiles, which are written without a branch.
        for &key in &*keys {
            let index = key as u32;
            let first = pairs[index as usize].tiles;
            // x & (x - 1) clears the lowest bit; 0 remains 0.
            let second = first & first.wrapping_sub(1);
            for tiles in [first, second] {
                // The remainder changes nothing, since a u32 has at most 32 trailing zeros, and
                // saves the test of the bound.
                let next = &mut next[tiles.trailing_zeros() as usize % (2 * MACRO_TILE_TILES)];
                instances[*next as usize] = index;
                *next += u32::from(tiles != 0);
            }
            let mut tiles = second & second.wrapping_sub(1);
            while tiles != 0 {
                let next = &mut next[tiles.trailing_zeros() as usize % MACRO_TILE_TILES];
                instances[*next as usize] = index;
                *next += 1;
                tiles &= tiles - 1;
            }
        }
        // Every place has been written once, so that each counter stands at the end of its list.
        ends.copy_from_slice(&next[..MACRO_TILE_TILES]);
    }

    /// Takes the pairs of the macro tile, and no copies of its splats.
    #[inline(always)]
    fn load_pairs(&mut self, number: usize, segments: &[Segment]) {
        self.pairs.clear();
        self.copies.clear();
        // Segments in order, and each in order of global ids: the index of a pair breaks ties of
        // depth by the order in the scene.
        for segment in segments {
            self.pairs.extend_from_slice(segment.macro_tile(number));
        }
    }

    /// Copies its sorted lists, for [`MacroTile::load_with_lists`].
    pub(in crate::cpu) fn copy_lists(&self, to: &mut MacroTileLists) {
        let end = self.ends.last().map_or(0, |&end| end as usize);
        to.instances.clear();
        to.instances.extend_from_slice(&self.instances[..end]);
        to.ends = self.ends;
    }

    /// As [`MacroTile::load`], with the lists that were found then.
    pub(super) fn load_with_lists(
        &mut self,
        number: usize,
        segments: &[Segment],
        lists: &MacroTileLists,
    ) {
        self.load_pairs(number, segments);
        self.instances.clear();
        self.instances.extend_from_slice(&lists.instances);
        self.ends = lists.ends;
    }

    /// Number of its splats.
    pub(in crate::cpu) fn len(&self) -> usize {
        self.pairs.len()
    }

    /// Whether no splat touches it.
    #[inline(always)]
    pub(in crate::cpu) fn is_empty(&self) -> bool {
        self.pairs.is_empty()
    }

    /// Copies the splats, unless there are too many.
    #[inline(always)]
    pub(in crate::cpu) fn copy_splats(&mut self, projected: &Projected) {
        let Self { pairs, copies, .. } = self;
        copies.clear();
        if pairs.len() <= MAX_COPIES {
            copies.extend(pairs.iter().map(
                #[inline(always)]
                |pair| *projected.splat(pair.place),
            ));
        }
    }

    /// The splats of a tile, from the nearest: their indices in the macro tile.
    #[inline(always)]
    pub(in crate::cpu) fn tile(&self, within: usize) -> &[u32] {
        let start = within.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.instances[start as usize..self.ends[within] as usize]
    }

    /// The place of a splat in the projection.
    #[inline(always)]
    pub(in crate::cpu) fn place(&self, index: u32) -> u32 {
        self.pairs[index as usize].place
    }

    /// The splats by their indices, if they were copied.
    #[inline(always)]
    pub(in crate::cpu) fn copies(&self) -> Option<&[Splat]> {
        (self.copies.len() == self.pairs.len()).then_some(&self.copies)
    }

    /// Bytes of all buffers, with the room that they have left.
    pub(in crate::cpu) fn held_bytes(&self) -> usize {
        let Self { pairs, copies, instances, keys, other, .. } = self;
        pairs.capacity() * size_of::<Pair>()
            + copies.capacity() * size_of::<Splat>()
            + instances.capacity() * size_of::<u32>()
            + (keys.capacity() + other.capacity()) * size_of::<u64>()
    }

    /// Frees the memory of an unusually full macro tile.
    pub(in crate::cpu) fn trim(&mut self) {
        // A splat of a macro tile touches a few of its tiles, hence a quarter.
        if self.pairs.capacity().max(self.instances.capacity() / 4) > MAX_KEPT {
            *self = Self::default();
        }
    }
}
