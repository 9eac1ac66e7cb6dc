// Exposure and overlay of one camera. Twin of `src/render/cpu/appearance.rs`.

@group(0) @binding(10) var<uniform> seen: array<Seen, MAX_VIEWS>;
// RGBA, from the lowest byte, row by row, view after view.
@group(0) @binding(11) var<storage, read> overlays: array<u32>;

fn appear(gathered: Sums, view: u32, at_px: vec2f) -> Sums {
    var sums = gathered;
    let by = seen[view];
    if by.exposed != 0u {
        let rows = by.exposure;
        sums.red = exposed(rows[0], gathered);
        sums.green = exposed(rows[1], gathered);
        sums.blue = exposed(rows[2], gathered);
    }
    let at = vec2u(at_px);
    if at.x < by.overlay_px.x && at.y < by.overlay_px.y {
        for (var k = 0u; k < 4u && at.x + k < by.overlay_px.x; k++) {
            let over = unpack4x8unorm(overlays[by.first_overlay + at.y * by.overlay_px.x + at.x + k]);
            sums.red[k] = mix(sums.red[k], over.r, over.a);
            sums.green[k] = mix(sums.green[k], over.g, over.a);
            sums.blue[k] = mix(sums.blue[k], over.b, over.a);
        }
    }
    return sums;
}

fn exposed(row: vec4f, sums: Sums) -> vec4f {
    return row.x * sums.red + (row.y * sums.green + (row.z * sums.blue + row.w));
}
