// A sky that is evaluated: `Folded` in `src/scene/sky/folded.rs`, four directions at once. Four numbers
// of each of up to 319 values lie in private memory, which is slow, and exact.

#import behind

// Layer by layer: for each group of eight outputs their biases, and then eight weights per input.
@group(0) @binding(9) var<storage, read> weights: array<vec4f>;

// The first layer's outputs, and behind them the encoded directions.
var<private> joined: array<vec4f, 319>;
var<private> hidden: array<vec4f, 256>;

fn sky(away: Away) -> array<vec4f, 3> {
    let scale = inverseSqrt(away.x * away.x + away.y * away.y + away.z * away.z);
    let directions = array<vec4f, 3>(away.x * scale, away.y * scale, away.z * scale);
    var next = behind.width;
    if behind.identity != 0u {
        for (var axis = 0u; axis < 3u; axis++) {
            joined[next] = directions[axis];
            next++;
        }
    }
    for (var cosine = 0u; cosine < 2u; cosine++) {
        for (var octave = 0u; octave < behind.octaves; octave++) {
            for (var axis = 0u; axis < 3u; axis++) {
                joined[next] = sine(directions[axis] * f32(1u << octave), cosine);
                next++;
            }
        }
    }

    // In vectors of four, two for each bias or input of a group.
    var at = 0u;
    for (var output = 0u; output < behind.width; output += 8u) {
        var sums = biases(at);
        for (var input = 0u; input < behind.encoded; input++) {
            at += 2u;
            sums = add_input(sums, at, joined[behind.width + input]);
        }
        at += 2u;
        for (var k = 0u; k < 8u; k++) {
            joined[output + k] = max(sums[k], vec4f(0.0));
        }
    }
    let inputs = behind.width + select(0u, behind.encoded, behind.skip != 0u);
    for (var output = 0u; output < behind.width; output += 8u) {
        var sums = biases(at);
        for (var input = 0u; input < inputs; input++) {
            at += 2u;
            sums = add_input(sums, at, joined[input]);
        }
        at += 2u;
        for (var k = 0u; k < 8u; k++) {
            hidden[output + k] = max(sums[k], vec4f(0.0));
        }
    }
    var sums = biases(at);
    for (var input = 0u; input < behind.width; input++) {
        at += 2u;
        sums = add_input(sums, at, hidden[input]);
    }
    var rgb: array<vec4f, 3>;
    for (var channel = 0u; channel < 3u; channel++) {
        rgb[channel] = 1.0 / (1.0 + exp(-sums[channel]));
    }
    return rgb;
}

fn biases(at: u32) -> array<vec4f, 8> {
    let low = weights[at];
    let high = weights[at + 1u];
    return array<vec4f, 8>(
        vec4f(low.x), vec4f(low.y), vec4f(low.z), vec4f(low.w),
        vec4f(high.x), vec4f(high.y), vec4f(high.z), vec4f(high.w),
    );
}

fn add_input(before: array<vec4f, 8>, at: u32, value: vec4f) -> array<vec4f, 8> {
    let low = weights[at];
    let high = weights[at + 1u];
    return array<vec4f, 8>(
        before[0] + low.x * value, before[1] + low.y * value,
        before[2] + low.z * value, before[3] + low.w * value,
        before[4] + high.x * value, before[5] + high.y * value,
        before[6] + high.z * value, before[7] + high.w * value,
    );
}

// As in `src/scene/sky/folded.rs`: WGSL's own sine may be 2^-11 off. Products with the first two parts
// of pi are exact, so that it does not matter whether sums are fused with them.
fn sine(x: vec4f, cosine: u32) -> vec4f {
    let quarter = 0.5 * f32(cosine);
    let whole = floor(x * 0.31830988618 + (0.5 - quarter));
    let turns = whole + quarter;
    let r = ((x - turns * 3.140625) - turns * 9.6774101257e-4) + turns * 8.742278e-8;
    let square = r * r;
    let fit = ((2.6000546e-6 * square - 1.9806615e-4) * square + 8.333017e-3) * square
        - 1.6666657e-1;
    let value = r + fit * square * r;
    let odd = (vec4i(whole) + i32(cosine)) & vec4i(1);
    return select(value, -value, odd != vec4i(0));
}
