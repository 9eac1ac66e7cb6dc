// What the kernels that blend tiles share.

// Blocks of a tile that the box of a splat reaches, a bit each, row by row, by the test with which `bin.wgsl`
// finds its tiles. `corner` is the first pixel of the tile.
fn reached_blocks(shape: SplatShape, corner: vec2u) -> u32 {
    let size = f32(TILE_PX);
    let first_px = ceil(shape.mean_px - shape.extent_px - 0.5) - vec2f(corner);
    let last_px = floor(shape.mean_px + shape.extent_px - 0.5) - vec2f(corner);
    let first = clamp(first_px, vec2f(0.0), vec2f(size));
    let last = clamp(last_px, vec2f(-1.0), vec2f(size - 1.0));
    if any(first > last) {
        return 0u;
    }
    let low = vec2u(first) / BLOCK_PX;
    let high = vec2u(last) / BLOCK_PX;
    // A bit per column in each row, and the first bit of each row that is reached.
    let columns = (2u << high.x) - (1u << low.x);
    let rows = ((16u << (4u * high.y)) - (1u << (4u * low.y))) & 0x1111u;
    return columns * rows;
}

// Index of the view that a tile belongs to.
fn tile_view(tile: u32) -> u32 {
    var view = 0u;
    while view + 1u < frame.views && frame.view[view + 1u].first_tile <= tile {
        view++;
    }
    return view;
}

// First pixel of a tile on its image.
fn tile_corner(tile: u32, view: FrameView) -> vec2u {
    let tile_of_view = tile - view.first_tile;
    return vec2u(tile_of_view % view.columns, tile_of_view / view.columns) * TILE_PX;
}

// Words of a tile with a long list between `rasterize_long.wgsl` and `finish`: planes of 256 values for red, green,
// blue, depth, transmittance, and the index in the list, plus 1, of the splat that halves the transmittance; then the
// counts of (splat, block) pairs and of batches.
const LONG_TILE_WORDS: u32 = 6 * TILE_PX * TILE_PX + 64;
