// A sky that is evaluated: `Folded` in `src/scene/sky/folded.rs`. The threads of a tile evaluate it together,
// four pixels after four, an output of a layer each: what one thread alone would need, 9 KiB for every
// four pixels, is in no register.

#import angle

// Layer by layer, output by output: the bias, and then its weights, four a vector.
@group(0) @binding(9) var<storage, read> weights: array<vec4f>;

// Four directions whose colours are asked for, if they are.
var<workgroup> asked: array<vec4f, 3>;
var<workgroup> is_asked: u32;
// The second layer's outputs, the first one's, and behind them the encoded directions.
var<workgroup> values: array<vec4f, 576>;

// The colours behind four pixels, if they are wanted. All threads of a tile call it.
fn sky(view: u32, at_px: vec2f, wanted: bool, thread: u32) -> array<vec4f, 3> {
    let width = behind.width;
    let encoded = (behind.encoded + 3u) / 4u * 4u;
    let joined = width + select(0u, encoded, behind.skip != 0u);
    let second = width * (1u + encoded / 4u);
    let third = second + width * (1u + joined / 4u);
    var rgb: array<vec4f, 3>;
    for (var turn = 0u; turn < THREADS; turn++) {
        if thread == turn {
            is_asked = u32(wanted);
            if wanted {
                let away = look(view, at_px);
                let scale = inverseSqrt(away.x * away.x + away.y * away.y + away.z * away.z);
                asked = array<vec4f, 3>(away.x * scale, away.y * scale, away.z * scale);
            }
        }
        if workgroupUniformLoad(&is_asked) == 0u {
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

// One value of the encoded directions; 0 behind the last.
fn encode(place: u32) -> vec4f {
    let first = select(0u, 3u, behind.identity != 0u);
    if place < first {
        return asked[place];
    }
    if place >= behind.encoded {
        return vec4f(0.0);
    }
    let wave = (place - first) / 3u;
    let scale = f32(1u << (wave % behind.octaves));
    return sine(asked[(place - first) % 3u] * scale, select(0.0, 0.5, wave >= behind.octaves));
}

// One hidden layer, whose weights begin `at`: reads `inputs` values after `source`, writes as many as
// there are `outputs` after `dest`.
fn dense(at: u32, source: u32, inputs: u32, thread: u32, outputs: u32, dest: u32) {
    for (var own = thread; own < outputs; own += THREADS) {
        values[dest + own] = max(output(at, source, inputs, own), vec4f(0.0));
    }
}

// One output of a layer, before anything cuts it off.
fn output(at: u32, source: u32, inputs: u32, own: u32) -> vec4f {
    let row = at + own * (1u + inputs / 4u);
    var sum = vec4f(weights[row].x);
    for (var input = 0u; input < inputs; input += 4u) {
        let weight = weights[row + 1u + input / 4u];
        let place = source + input;
        sum += weight.x * values[place] + weight.y * values[place + 1u];
        sum += weight.z * values[place + 2u] + weight.w * values[place + 3u];
    }
    return sum;
}
