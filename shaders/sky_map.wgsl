// A sky that was baked: `CubeMap` in `src/scene/sky/cube.rs`.

// Red in the lower and green in the upper 16 bits, and blue.
@group(0) @binding(9) var<storage, read> texels: array<vec2u>;

// The colours behind four pixels, if they are wanted.
fn sky(view: u32, at_px: vec2f, wanted: bool, thread: u32) -> array<vec4f, 3> {
    if !wanted {
        return array<vec4f, 3>();
    }
    let away = look(view, at_px);
    let ax = abs(away.x);
    let ay = abs(away.y);
    let az = abs(away.z);
    let is_x = (ax >= ay) & (ax >= az);
    let is_y = ay >= az;
    let zero = vec4f(0.0);
    let east = away.x >= zero;
    let north = away.y >= zero;
    let up = away.z >= zero;
    let face = select(
        select(select(vec4u(5u), vec4u(4u), up), select(vec4u(3u), vec4u(2u), north), is_y),
        select(vec4u(1u), vec4u(0u), east),
        is_x,
    );
    let right = select(
        select(select(-away.x, away.x, up), away.x, is_y),
        select(away.z, -away.z, east),
        is_x,
    );
    let down = select(select(-away.y, select(-away.z, away.z, north), is_y), -away.y, is_x);
    let ahead = select(select(az, ay, is_y), ax, is_x);
    let half = 0.5 * behind.scale;
    let u = right / ahead * half + (half + behind.offset);
    let v = down / ahead * half + (half + behind.offset);
    let last = vec4f(f32(behind.edge - 2u));
    let column = clamp(floor(u), zero, last);
    let row = clamp(floor(v), zero, last);
    let place = (face * behind.edge + vec4u(row)) * behind.edge + vec4u(column);
    var rgb = array<vec4f, 3>(zero, zero, zero);
    for (var k = 0u; k < 4u; k++) {
        let upper = mix(texel(place[k]), texel(place[k] + 1u), u[k] - column[k]);
        let below = place[k] + behind.edge;
        let lower = mix(texel(below), texel(below + 1u), u[k] - column[k]);
        let colour = mix(upper, lower, v[k] - row[k]);
        rgb[0][k] = colour.r;
        rgb[1][k] = colour.g;
        rgb[2][k] = colour.b;
    }
    return rgb;
}

fn texel(place: u32) -> vec3f {
    let bits = texels[place];
    return vec3f(f32(bits.x & 0xFFFFu), f32(bits.x >> 16u), f32(bits.y)) / 65535.0;
}
