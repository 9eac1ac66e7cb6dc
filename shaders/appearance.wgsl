// Stage resolve, first part: exposure and overlay of one camera. Twin of
// `src/render/cpu/appearance.rs`.

@group(0) @binding(10) var<uniform> appearances: array<CameraAppearance, MAX_VIEWS>;
// Overlay pixels: 8-bit RGBA with red in the lowest byte, row by row, view after view.
@group(0) @binding(11) var<storage, read> overlays: array<u32>;

// Applies a camera's exposure and overlay to four pixels of a row; the first pixel's centre is `at_px`.
fn apply_appearance(gathered: Sums, view: u32, at_px: vec2f) -> Sums {
    var sums = gathered;
    let appearance = appearances[view];
    if appearance.has_exposure != 0u {
        let rows = appearance.exposure;
        sums.red = expose(rows[0], gathered);
        sums.green = expose(rows[1], gathered);
        sums.blue = expose(rows[2], gathered);
    }
    let at = vec2u(at_px);
    if at.x < appearance.overlay_px.x && at.y < appearance.overlay_px.y {
        for (var k = 0u; k < 4u && at.x + k < appearance.overlay_px.x; k++) {
            let index = appearance.first_overlay + at.y * appearance.overlay_px.x + at.x + k;
            let over = unpack4x8unorm(overlays[index]);
            sums.red[k] = covered(sums.red[k], over.r, over.a);
            sums.green[k] = covered(sums.green[k], over.g, over.a);
            sums.blue[k] = covered(sums.blue[k], over.b, over.a);
        }
    }
    return sums;
}

// A value behind an overlay. It is exact if the overlay is opaque.
fn covered(behind: f32, over: f32, alpha: f32) -> f32 {
    return fma(alpha, over, fma(-alpha, behind, behind));
}

// One row of the exposure's matrix, applied to four pixels.
fn expose(row: vec4f, sums: Sums) -> vec4f {
    let blue = fma(vec4f(row.z), sums.blue, vec4f(row.w));
    return fma(vec4f(row.x), sums.red, fma(vec4f(row.y), sums.green, blue));
}
