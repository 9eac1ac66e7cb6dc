// Stage resolve, the first part, for frames that have something behind the Gaussians, a colour for
// every direction, or cameras that do not record what is there. `SKY` is what colours come from, `LOOK`
// what directions do. Twin of `src/render/cpu/behind.rs`.

#import appearance
#import LOOK
#import SKY

@group(0) @binding(8) var<uniform> behind: Behind;

// Adds what shows through four pixels of a row, the first one's centre at `at_px`. All threads of a tile
// call it.
fn complete(gathered: Sums, view: u32, at_px: vec2f, thread: u32) -> Sums {
    var sums = gathered;
    let shows = sums.transmittance >= vec4f(SKY_CUT);
    let on_image = all(at_px < vec2f(frame.view[view].size_px));
    let rgb = sky(view, at_px, any(shows) && on_image, thread);
    let weight = select(vec4f(0.0), sums.transmittance, shows);
    sums.red += weight * rgb[0];
    sums.green += weight * rgb[1];
    sums.blue += weight * rgb[2];
    return appear(sums, view, at_px);
}

// Where four pixels of a pinhole at rest look.
fn by_matrix(view: u32, at_px: vec2f) -> Away {
    let x = at_px.x + vec4f(0.0, 1.0, 2.0, 3.0);
    let rows = behind.sky_from_pixel[view];
    return Away(
        rows[0].x * x + (rows[0].y * at_px.y + rows[0].z),
        rows[1].x * x + (rows[1].y * at_px.y + rows[1].z),
        rows[2].x * x + (rows[2].y * at_px.y + rows[2].z),
    );
}

// Four directions of any length.
struct Away {
    x: vec4f,
    y: vec4f,
    z: vec4f,
}
