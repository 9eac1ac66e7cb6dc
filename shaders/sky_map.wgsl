// Sky from a baked cube map with bilinear interpolation. Twin of `CubeMap` in `src/scene/sky/cube.rs`.

// 16-bit colours: red in the low and green in the high half of the first word, blue in the second.
@group(0) @binding(9) var<storage, read> texels: array<vec2u>;

// Red, green, and blue of the sky at four pixels; zero if not `wanted`.
fn sky(view: u32, at_px: vec2f, wanted: bool, thread: u32) -> array<vec4f, 3> {
    if !wanted {
        return array<vec4f, 3>();
    }
    let rays = sky_rays(view, at_px);
    let ax = abs(rays.x);
    let ay = abs(rays.y);
    let az = abs(rays.z);
    // The face is that of the largest component: +x, -x, +y, -y, +z, -z.
    let is_x = (ax >= ay) & (ax >= az);
    let is_y = ay >= az;
    let zero = vec4f(0.0);
    let east = rays.x >= zero;
    let north = rays.y >= zero;
    let up = rays.z >= zero;
    let face = select(
        select(select(vec4u(5u), vec4u(4u), up), select(vec4u(3u), vec4u(2u), north), is_y),
        select(vec4u(1u), vec4u(0u), east),
        is_x,
    );
    let right = select(
        select(select(-rays.x, rays.x, up), rays.x, is_y),
        select(rays.z, -rays.z, east),
        is_x,
    );
    let down = select(select(-rays.y, select(-rays.z, rays.z, north), is_y), -rays.y, is_x);
    let ahead = select(select(az, ay, is_y), ax, is_x);
    let half = 0.5 * background.scale;
    let middle = vec4f(half + background.offset);
    let u = fma(right / ahead, vec4f(half), middle);
    let v = fma(down / ahead, vec4f(half), middle);
    let last = vec4f(f32(background.edge - 2u));
    let column = clamp(floor(u), zero, last);
    let row = clamp(floor(v), zero, last);
    let index = (face * background.edge + vec4u(row)) * background.edge + vec4u(column);
    var rgb = array<vec4f, 3>(zero, zero, zero);
    for (var k = 0u; k < 4u; k++) {
        let upper = between(texel(index[k]), texel(index[k] + 1u), u[k] - column[k]);
        let below = index[k] + background.edge;
        let lower = between(texel(below), texel(below + 1u), u[k] - column[k]);
        let colour = between(upper, lower, v[k] - row[k]);
        rgb[0][k] = colour.r;
        rgb[1][k] = colour.g;
        rgb[2][k] = colour.b;
    }
    return rgb;
}

// Linear interpolation.
fn between(a: vec3f, b: vec3f, part: f32) -> vec3f {
    return fma(vec3f(part), b - a, a);
}

fn texel(index: u32) -> vec3f {
    let bits = texels[index];
    return vec3f(f32(bits.x & 0xFFFFu), f32(bits.x >> 16u), f32(bits.y)) / 65535.0;
}
