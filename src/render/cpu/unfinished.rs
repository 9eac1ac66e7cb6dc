//! Tiles of a view that is drawn in slabs: their sums from one slab to the next.

use parking_lot::Mutex;

use super::bin::Grid;
use super::resolve::{SampleOwners, TileSums};
use crate::View;

/// A slab of a view: its tiles continue from the previous slab.
#[derive(Clone, Copy)]
pub(super) struct Continued<'a> {
    pub(super) tiles: &'a UnfinishedTiles,
    pub(super) is_last: bool,
}

/// The sums of a view's tiles after the previous slabs, by macro tile; none before its first splat.
#[derive(Debug)]
pub(super) struct UnfinishedTiles(pub(super) Vec<Mutex<Vec<UnfinishedTile>>>);

#[derive(Debug)]
pub(super) struct UnfinishedTile {
    pub(super) sums: TileSums,
    /// A bit for each block in which some pixel has not stopped.
    pub(super) live: u16,
    /// If the tile has samples whose owners are wanted.
    pub(super) owners: Option<Box<SampleOwners>>,
}

impl UnfinishedTiles {
    /// Most bytes of the sums of a view, which may be the samples of another one.
    pub(super) fn bytes(view: &View, is_sampled: bool) -> u64 {
        let owners = if is_sampled { size_of::<SampleOwners>() } else { 0 };
        (Grid::new(view).tiles() * (size_of::<UnfinishedTile>() + owners)) as u64
    }

    /// Bytes of the present sums.
    pub(super) fn held_bytes(&self) -> u64 {
        let of_macro_tile = |tiles: &Mutex<Vec<UnfinishedTile>>| {
            let tiles = tiles.lock();
            let owners = tiles.iter().filter(|tile| tile.owners.is_some()).count();
            tiles.capacity() * size_of::<UnfinishedTile>() + owners * size_of::<SampleOwners>()
        };
        self.0.iter().map(of_macro_tile).sum::<usize>() as u64
    }

    /// The sums of a view before the first slab.
    pub(super) fn new(view: &View) -> Self {
        Self((0..Grid::new(view).macro_tiles()).map(|_| Mutex::default()).collect())
    }
}
