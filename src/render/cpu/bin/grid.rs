//! The tiles of a view, and its macro tiles.

use crate::View;
use crate::constants::TILE_PX;

/// A view's grid of tiles.
#[derive(Clone, Copy, Debug)]
pub(in crate::cpu) struct Grid {
    /// Image size, in pixels.
    pub(super) size_px: [u32; 2],
    /// Tiles in a row, the last of which may reach beyond the image.
    pub(in crate::cpu) columns: u32,
    pub(in crate::cpu) rows: u32,
    /// Base-2 logarithm of a macro tile's width and height in tiles.
    pub(super) macro_bits: [u32; 2],
}

impl Grid {
    /// The tiles of a view; the last tile of a row or column may reach beyond the image.
    pub(in crate::cpu) fn new(view: &View) -> Self {
        let size_px = [view.camera.width_px, view.camera.height_px];
        let [columns, rows] = size_px.map(|size| size.div_ceil(TILE_PX));
        // Use smaller macro tiles in small images, so that there are enough for all cores.
        // 8 x 4, 4 x 2, 2 x 2 and 1 tiles: at the lower end of each range 16, 8 and 4 macro tiles.
        let macro_bits = match columns * rows {
            512.. => [3, 2],
            64.. => [2, 1],
            16.. => [1, 1],
            _ => [0, 0],
        };
        Self { size_px, columns, rows, macro_bits }
    }

    pub(in crate::cpu) fn tiles(&self) -> usize {
        self.columns as usize * self.rows as usize
    }

    /// Macro tiles per row.
    pub(super) fn macro_columns(&self) -> u32 {
        self.columns.div_ceil(1 << self.macro_bits[0])
    }

    pub(in crate::cpu) fn macro_tiles(&self) -> usize {
        self.macro_columns() as usize * self.rows.div_ceil(1 << self.macro_bits[1]) as usize
    }

    /// The tiles of a macro tile: the number of each within it, its column and its row.
    pub(in crate::cpu) fn macro_tile_tiles(
        &self,
        number: usize,
    ) -> impl Iterator<Item = (usize, [u32; 2])> {
        let [x_bits, y_bits] = self.macro_bits;
        let number = number as u32;
        let first_column = (number % self.macro_columns()) << x_bits;
        let first_row = (number / self.macro_columns()) << y_bits;
        // The last macro tile of a row or column may lack tiles beyond the image.
        let columns = first_column..self.columns.min(first_column + (1 << x_bits));
        let rows = first_row..self.rows.min(first_row + (1 << y_bits));
        rows.flat_map(move |row| {
            columns.clone().map(move |column| {
                // The number counts whole rows of the macro tile even where the image cuts it: it
                // is the number of the bit in `Pair::tiles`.
                let within = (row - first_row) << x_bits | (column - first_column);
                (within as usize, [column, row])
            })
        })
    }
}
