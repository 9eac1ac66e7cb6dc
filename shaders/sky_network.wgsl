// A sky that is evaluated: `Folded` in `src/scene/sky/folded.rs`, four directions at once. Up to 575
// vectors lie in private memory, which is slow, and exact.

#import angle

// Layer by layer: for each group of eight outputs their biases, and then eight weights per input.
@group(0) @binding(9) var<storage, read> weights: array<vec4f>;

// The second layer's outputs, the first one's, and behind them the encoded directions.
var<private> values: array<vec4f, 575>;

fn sky(away: Away) -> array<vec4f, 3> {
    let scale = inverseSqrt(away.x * away.x + away.y * away.y + away.z * away.z);
    let directions = array<vec4f, 3>(away.x * scale, away.y * scale, away.z * scale);
    let width = behind.width;
    var next = 2u * width;
    if behind.identity != 0u {
        for (var axis = 0u; axis < 3u; axis++) {
            values[next] = directions[axis];
            next++;
        }
    }
    for (var cosine = 0u; cosine < 2u; cosine++) {
        for (var octave = 0u; octave < behind.octaves; octave++) {
            for (var axis = 0u; axis < 3u; axis++) {
                values[next] = sine(directions[axis] * f32(1u << octave), 0.5 * f32(cosine));
                next++;
            }
        }
    }
    let joined = width + select(0u, behind.encoded, behind.skip != 0u);
    let second = dense(0u, 2u * width, behind.encoded, width);
    let third = dense(second, width, joined, 0u);
    let logits = group(third, 0u, width);
    var rgb: array<vec4f, 3>;
    rgb[0] = 1.0 / (1.0 + exp(-logits.low[0]));
    rgb[1] = 1.0 / (1.0 + exp(-logits.low[1]));
    rgb[2] = 1.0 / (1.0 + exp(-logits.low[2]));
    return rgb;
}

// One hidden layer, whose weights begin `at`: reads `inputs` values after `source`, writes as many as
// it is wide after `dest`. Returns where the next layer's weights begin.
fn dense(at: u32, source: u32, inputs: u32, dest: u32) -> u32 {
    var first = at;
    for (var output = 0u; output < behind.width; output += 8u) {
        var sums = group(first, source, inputs);
        for (var k = 0u; k < 4u; k++) {
            values[dest + output + k] = max(sums.low[k], vec4f(0.0));
            values[dest + output + 4u + k] = max(sums.high[k], vec4f(0.0));
        }
        first += 2u * (inputs + 1u);
    }
    return first;
}

// Eight outputs of a layer: four directions each.
struct Outputs {
    low: mat4x4f,
    high: mat4x4f,
}

// One group of outputs, whose biases and weights begin `at`: two vectors for the biases, two per input.
fn group(at: u32, source: u32, inputs: u32) -> Outputs {
    let one = vec4f(1.0);
    var low = outer(weights[at], one);
    var high = outer(weights[at + 1u], one);
    for (var input = 0u; input < inputs; input++) {
        let value = values[source + input];
        low += outer(weights[at + 2u * input + 2u], value);
        high += outer(weights[at + 2u * input + 3u], value);
    }
    return Outputs(low, high);
}

fn outer(weight: vec4f, value: vec4f) -> mat4x4f {
    return mat4x4f(weight.x * value, weight.y * value, weight.z * value, weight.w * value);
}
