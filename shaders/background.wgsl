// Stage resolve, first part, for frames with a background (a sky, or one colour) or with cameras that
// have an exposure or an overlay. `SKY` stands for the source of the colours, `RAYS` for the source of
// the directions. Twin of `src/render/cpu/background.rs`.

#import appearance
#import RAYS
#import SKY

@group(0) @binding(8) var<uniform> background: Background;

// Adds the background, weighted by the remaining transmittance, to four pixels of a row, then applies
// the camera's appearance. The first pixel's centre is `at_px`. All threads of a tile must call it.
fn composite(gathered: Sums, view: u32, at_px: vec2f, thread: u32) -> Sums {
    var sums = gathered;
    let shows = sums.transmittance >= vec4f(SKY_CUT);
    let on_image = all(at_px < vec2f(frame.view[view].size_px));
    let rgb = sky(view, at_px, any(shows) && on_image, thread);
    let weight = select(vec4f(0.0), sums.transmittance, shows);
    sums.red = fma(weight, rgb[0], sums.red);
    sums.green = fma(weight, rgb[1], sums.green);
    sums.blue = fma(weight, rgb[2], sums.blue);
    return apply_appearance(sums, view, at_px);
}

// Directions of four pixels of a static pinhole camera, in the sky's axes.
fn pinhole_rays(view: u32, at_px: vec2f) -> Rays {
    let x = at_px.x + vec4f(0.0, 1.0, 2.0, 3.0);
    let rows = background.sky_from_pixel[view];
    return Rays(
        along_row(rows[0], x, at_px.y),
        along_row(rows[1], x, at_px.y),
        along_row(rows[2], x, at_px.y),
    );
}

// One coordinate of the directions at four places of a row of pixels.
fn along_row(row: vec4f, x: vec4f, y: f32) -> vec4f {
    return fma(vec4f(row.x), x, vec4f(fma(row.y, y, row.z)));
}

// Four directions, not normalised.
struct Rays {
    x: vec4f,
    y: vec4f,
    z: vec4f,
}
