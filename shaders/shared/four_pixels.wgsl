// A thread's four pixels of a row, and the exponents of a splat of the batch there: what decides whether a pixel blends
// the splat is computed in one way, so that gradients take the decisions of the image.

// A place relative to a splat's centre, times the factor of its inverse covariance: log2(alpha) is log2(opacity) - u² - v².
struct Offsets {
    u: vec4f,
    v: f32,
}

// The first pixel of the tile that a thread has: one of four in a row.
fn thread_pixel(thread: u32) -> vec2u {
    let block = thread / 4u;
    return vec2u(block % 4u, block / 4u) * BLOCK_PX + vec2u(0u, thread % 4u);
}

// (u, v) = (l0 dx + l1 dy, l2 dy) of splat `k` of the batch at four pixels.
fn splat_offsets(k: u32, at_px: vec2f) -> Offsets {
    let mean_factor = mean_factors[k];
    let d = at_px - mean_factor.xy;
    let v = opacities[k].x * d.y;
    let first_u = fma(mean_factor.z, d.x, mean_factor.w * d.y);
    return Offsets(fma(vec4f(mean_factor.z), vec4f(0.0, 1.0, 2.0, 3.0), vec4f(first_u)), v);
}

// log2(alpha) of splat `k` at four pixels.
fn exponents(k: u32, at: Offsets) -> vec4f {
    return fma(-at.u, at.u, vec4f(fma(-at.v, at.v, opacities[k].y)));
}
