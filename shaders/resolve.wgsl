// Stage resolve: a pixel's sums become the values that were asked for. It runs in the threads of
// `rasterize`, so that the sums never travel through memory.
//
// Output is tile after tile, and within a tile one plane of 256 pixels after another, of those asked
// for: packed RGBA8, red, green, blue, opacity, depth. Twin of `src/render/cpu/resolve.rs`.

override RGB8: bool;
override RGB: bool;
override OPACITY: bool;
override DEPTH: bool;

@group(0) @binding(7) var<storage, read_write> pixels: array<u32>;

const PLANE: u32 = TILE_PX * TILE_PX;

fn resolve(tile: u32, pixel: u32, rgb: vec3f, transmittance: f32, depth_sum: f32) {
    let planes = u32(RGB8) + 3u * u32(RGB) + u32(OPACITY) + u32(DEPTH);
    var at = tile * planes * PLANE + pixel;
    let opacity = 1.0 - transmittance;
    if RGB8 {
        pixels[at] = to_8_bit(rgb, opacity);
        at += PLANE;
    }
    if RGB {
        pixels[at] = bitcast<u32>(rgb.r);
        pixels[at + PLANE] = bitcast<u32>(rgb.g);
        pixels[at + 2u * PLANE] = bitcast<u32>(rgb.b);
        at += 3u * PLANE;
    }
    if OPACITY {
        pixels[at] = bitcast<u32>(opacity);
        at += PLANE;
    }
    if DEPTH {
        var depth_m = 0.0;
        if opacity > 0.0 {
            depth_m = depth_sum / opacity;
        }
        pixels[at] = bitcast<u32>(depth_m);
    }
}

// Clamps to [0, 1], rounds to the nearest of 0 to 255, and packs from the lowest byte.
fn to_8_bit(rgb: vec3f, opacity: f32) -> u32 {
    let bytes = vec4u(saturate(vec4f(rgb, opacity)) * 255.0 + 0.5);
    return bytes.r | (bytes.g << 8u) | (bytes.b << 16u) | (bytes.a << 24u);
}
