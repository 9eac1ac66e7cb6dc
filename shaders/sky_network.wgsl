// Sky from a neural network (MLP), evaluated for each pixel. Twin of `InferenceNetwork` in
// `src/scene/sky/inference.rs`.
//
// The threads of a tile evaluate the network together for four pixels at a time, and each thread
// computes outputs of each layer. Pixels whose background is hidden are skipped. A single thread would
// need 9 KiB of values for its four pixels, which does not fit registers; with these values in private
// memory, lavapipe took 35 s to compile the shader.

#import angle

// Layer by layer and output by output: the bias (first component of a vector), then the weights, four
// per vector.
@group(0) @binding(9) var<storage, read> weights: array<vec4f>;

// The four directions that are evaluated now, and whether their colours are needed.
var<workgroup> directions: array<vec4f, 3>;
var<workgroup> is_wanted: u32;
// Outputs of the second layer, then of the first layer, then the encoded directions: 2 x 256 + 64 values
// of four pixels at most.
var<workgroup> values: array<vec4f, 576>;

// Red, green, and blue of the sky at four pixels; zero if not `wanted`. All threads of a tile must call
// it.
fn sky(view: u32, at_px: vec2f, wanted: bool, thread: u32) -> array<vec4f, 3> {
    let width = background.width;
    let encoded = (background.encoded + 3u) / 4u * 4u;
    let joined = width + select(0u, encoded, background.skip != 0u);
    let second = width * (1u + encoded / 4u);
    let third = second + width * (1u + joined / 4u);
    // Compute the rays before the loop: inside it, a lens would be inverted once per iteration (`THREADS` times)
    // instead of once.
    var own: array<vec4f, 3>;
    if wanted {
        let rays = sky_rays(view, at_px);
        let scale = inverseSqrt(fma(rays.x, rays.x, fma(rays.y, rays.y, rays.z * rays.z)));
        own = array<vec4f, 3>(rays.x * scale, rays.y * scale, rays.z * scale);
    }
    var rgb: array<vec4f, 3>;
    // One iteration for each thread, which evaluates the pixels of that thread.
    for (var turn = 0u; turn < THREADS; turn++) {
        if thread == turn {
            is_wanted = u32(wanted);
            directions = own;
        }
        if workgroupUniformLoad(&is_wanted) == 0u {
            continue;
        }
        if thread < encoded {
            values[2u * width + thread] = encode(thread);
        }
        workgroupBarrier();
        dense(0u, 2u * width, encoded, thread, width, width);
        workgroupBarrier();
        dense(second, width, joined, thread, width, 0u);
        workgroupBarrier();
        if thread < 3u {
            values[width + thread] = output(third, 0u, width, thread);
        }
        workgroupBarrier();
        if thread == turn {
            for (var c = 0u; c < 3u; c++) {
                rgb[c] = 1.0 / (1.0 + exp(-values[width + c]));
            }
        }
    }
    return rgb;
}

// One value of the frequency encoding of the directions; 0 after the last.
fn encode(index: u32) -> vec4f {
    let first = select(0u, 3u, background.identity != 0u);
    if index < first {
        return directions[index];
    }
    if index >= background.encoded {
        return vec4f(0.0);
    }
    let wave = (index - first) / 3u;
    let scale = f32(1u << (wave % background.octaves));
    return sine(directions[(index - first) % 3u] * scale, select(0.0, 0.5, wave >= background.octaves));
}

// One hidden layer with ReLU, whose weights start `at`: reads `inputs` values from `source` on, and
// writes `outputs` values from `dest` on.
fn dense(at: u32, source: u32, inputs: u32, thread: u32, outputs: u32, dest: u32) {
    for (var own = thread; own < outputs; own += THREADS) {
        values[dest + own] = max(output(at, source, inputs, own), vec4f(0.0));
    }
}

// One output of a layer, before the activation.
fn output(at: u32, source: u32, inputs: u32, own: u32) -> vec4f {
    let row = at + own * (1u + inputs / 4u);
    var sum = vec4f(weights[row].x);
    for (var input = 0u; input < inputs; input += 4u) {
        let weight = weights[row + 1u + input / 4u];
        let index = source + input;
        sum = fma(vec4f(weight.x), values[index], sum);
        sum = fma(vec4f(weight.y), values[index + 1u], sum);
        sum = fma(vec4f(weight.z), values[index + 2u], sum);
        sum = fma(vec4f(weight.w), values[index + 3u], sum);
    }
    return sum;
}
