// Stage resolve: computes the requested values from a pixel's sums. It runs in the threads of
// `rasterize`, so that the sums stay in registers.
//
// The output is tile after tile, and within a tile one plane of 256 values (64 of QUARTER_TILES) after another, in this order
// and only if requested: red, green and blue of 8 bits, then red, green, blue, opacity, depth, owner. Twin of
// `src/render/cpu/resolve.rs`.

override RGB8: bool;
override RGB: bool;
override OPACITY: bool;
override DEPTH: bool;
// Whether a tile has the pixels of 2 x 2 samples each, a quarter of the others: in frames of such views alone.
override QUARTER_TILES: bool;

@group(0) @binding(7) var<storage, read_write> pixels: array<vec4u>;


// Accumulated values of four pixels of a row.
struct Sums {
    // Linear and premultiplied.
    red: vec4f,
    green: vec4f,
    blue: vec4f,
    // Sum of depth times weight, in metres; zero unless depth is requested.
    depth: vec4f,
    // Fraction of the background that is visible.
    transmittance: vec4f,
}

// Writes four pixels of a tile, with their owners; `first_pixel` is the index of the first one in the tile.
fn resolve(tile: u32, first_pixel: u32, sums: Sums, owners: vec4u) {
    // Words of a plane, and of that of 8-bit colours: four pixels take three words.
    let plane = select(TILE_PX * TILE_PX, TILE_PX * TILE_PX / 4u, QUARTER_TILES);
    let rgb8_plane = plane / 4u * 3u;
    let planes = 3u * u32(RGB) + u32(OPACITY) + u32(DEPTH) + INSTANCE_PLANES;
    // A binding may begin at any tile, and so at a multiple of 64 words.
    var at = tile * ((planes * plane + u32(RGB8) * rgb8_plane + 63u) / 64u * 64u);
    let opacity = 1.0 - sums.transmittance;
    if RGB8 {
        let red = to_8_bit(sums.red);
        let green = to_8_bit(sums.green);
        let blue = to_8_bit(sums.blue);
        let first = at + first_pixel / 4u * 3u;
        write_word(first, red.x | (green.x << 8u) | (blue.x << 16u) | (red.y << 24u));
        write_word(first + 1u, green.y | (blue.y << 8u) | (red.z << 16u) | (green.z << 24u));
        write_word(first + 2u, blue.z | (red.w << 8u) | (green.w << 16u) | (blue.w << 24u));
        at += rgb8_plane;
    }
    at += first_pixel;
    if RGB {
        write(at, bitcast<vec4u>(sums.red));
        write(at + plane, bitcast<vec4u>(sums.green));
        write(at + 2u * plane, bitcast<vec4u>(sums.blue));
        at += 3u * plane;
    }
    if OPACITY {
        write(at, bitcast<vec4u>(opacity));
        at += plane;
    }
    if DEPTH {
        let covered = opacity > vec4f(0.0);
        let depth_m = sums.depth / select(vec4f(1.0), opacity, covered);
        write(at, bitcast<vec4u>(select(vec4f(0.0), depth_m, covered)));
        at += plane;
    }
    if INSTANCE_PLANES == 1u {
        write(at, owners);
    }
}

// Writes four values of a plane. Planes and rows are multiples of four values, so `at` is one too.
fn write(at: u32, four: vec4u) {
    pixels[at / 4u] = four;
}

// A word lies in one of the four components that are stored together.
fn write_word(at: u32, word: u32) {
    pixels[at / 4u][at % 4u] = word;
}

// Clamps to [0, 1], scales to 255, and rounds to the nearest integer.
fn to_8_bit(linear: vec4f) -> vec4u {
    return vec4u(fma(saturate(linear), vec4f(255.0), vec4f(0.5)));
}
