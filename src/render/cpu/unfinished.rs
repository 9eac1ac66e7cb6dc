//! Tiles of a view that is drawn in slabs: their sums from one slab to the next.

use parking_lot::Mutex;

use super::bin::Grid;
use super::resolve::TileSums;
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
}

impl UnfinishedTiles {
    /// Most bytes of the sums of a view.
    pub(super) fn bytes(view: &View) -> u64 {
        (Grid::new(view).tiles() * size_of::<UnfinishedTile>()) as u64
    }

    /// Bytes of the present sums.
    pub(super) fn held_bytes(&self) -> u64 {
        let tiles: usize = self.0.iter().map(|tiles| tiles.lock().capacity()).sum();
        (tiles * size_of::<UnfinishedTile>()) as u64
    }

    /// The sums of a view before the first slab.
    pub(super) fn new(view: &View) -> Self {
        Self((0..Grid::new(view).macro_tiles()).map(|_| Mutex::default()).collect())
    }
}
