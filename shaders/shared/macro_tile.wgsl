// The tiles of a macro tile. The importing shader declares `frame`.

const TILES: u32 = MACRO_COLUMNS * MACRO_ROWS;

// Index of the tile of bit `k` of a macro tile; `frame.tiles` if there is no such tile.
fn tile_at(index: u32, k: u32) -> u32 {
    var number = 0u;
    while number + 1u < frame.views && frame.view[number + 1u].first_macro_tile <= index {
        number++;
    }
    let view = frame.view[number];
    let index_in_view = index - view.first_macro_tile;
    let column = index_in_view % view.macro_columns * MACRO_COLUMNS + k % MACRO_COLUMNS;
    let row = index_in_view / view.macro_columns * MACRO_ROWS + k / MACRO_COLUMNS;
    let is_tile = column < view.columns && row * TILE_PX < view.size_px.y;
    return select(frame.tiles, view.first_tile + row * view.columns + column, is_tile);
}
