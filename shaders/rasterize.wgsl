// Stage rasterize: each tile blends its splats from the nearest, one workgroup per tile, one thread
// per pixel. Batches of splats travel through workgroup memory.
//
// Twin of `src/render/cpu/rasterize.rs`.

#import constants
#import layout
#import math
#import resolve

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> span: Span;
@group(0) @binding(2) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read> instance_places: array<u32>;
@group(0) @binding(4) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(5) var<storage, read> colors: array<SplatColor>;
@group(0) @binding(6) var<storage, read_write> counters: Counters;

var<workgroup> means: array<vec2f, WORKGROUP>;
// The factor, and the base-2 logarithm of the peak opacity.
var<workgroup> factors: array<vec4f, WORKGROUP>;
// Colour and depth.
var<workgroup> paints: array<vec4f, WORKGROUP>;
var<workgroup> done_count: atomic<u32>;
var<workgroup> done_pixels: u32;

@compute @workgroup_size(WORKGROUP)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= span.count {
        return;
    }
    let tile = span.first + index;
    let view = view_of(tile);
    let tile_of_view = tile - view.first_tile;
    let corner = vec2u(tile_of_view % view.columns, tile_of_view / view.columns) * TILE_PX;
    let pixel = pixel_of(thread);
    let at_px = vec2f(corner + pixel) + 0.5;

    if thread == 0u {
        atomicStore(&done_count, 0u);
    }
    workgroupBarrier();
    // Images need not be multiples of 16 px.
    var done = any(corner + pixel >= view.size_px);
    if done {
        atomicAdd(&done_count, 1u);
    }
    var rgb = vec3f(0.0);
    var depth_sum = 0.0;
    var transmittance = 1.0;
    var batches = 0u;
    let range = ranges[tile];
    for (var first = range.x; first < range.y; first += WORKGROUP) {
        workgroupBarrier();
        if thread == 0u {
            done_pixels = atomicLoad(&done_count);
        }
        if workgroupUniformLoad(&done_pixels) == WORKGROUP {
            break;
        }
        batches++;
        let count = min(range.y - first, WORKGROUP);
        if thread < count {
            let place = instance_places[first + thread];
            let shape = shapes[place];
            let color = colors[place];
            means[thread] = shape.mean_px;
            factors[thread] = vec4f(shape.factor, shape.log2_opacity);
            paints[thread] = vec4f(color.rgb, color.depth_m);
        }
        workgroupBarrier();
        let was_done = done;
        for (var k = 0u; k < count && !done; k++) {
            let factor = factors[k];
            let d = at_px - means[k];
            let u = factor.x * d.x + factor.y * d.y;
            let v = factor.z * d.y;
            let exponent = factor.w - u * u - v * v;
            if exponent >= frame.log2_alpha_cut {
                let alpha = min(exp2(exponent), frame.alpha_cap);
                let after = transmittance - alpha * transmittance;
                // The Gaussian that would bring the transmittance to the stop is left out.
                if after <= frame.stop {
                    done = true;
                    break;
                }
                let weight = alpha * transmittance;
                rgb += weight * paints[k].rgb;
                if DEPTH {
                    depth_sum += weight * paints[k].w;
                }
                transmittance = after;
            }
        }
        if done && !was_done {
            atomicAdd(&done_count, 1u);
        }
    }
    if thread == 0u {
        atomicAdd(&counters.batches, batches);
    }
    resolve(index, pixel.y * TILE_PX + pixel.x, rgb, transmittance, depth_sum);
}

fn view_of(tile: u32) -> FrameView {
    var view = 0u;
    while view + 1u < frame.views && frame.view[view + 1u].first_tile <= tile {
        view++;
    }
    return frame.view[view];
}

// 32 threads in a row cover 8 x 4 pixels, so that they tend to need the same splats.
fn pixel_of(thread: u32) -> vec2u {
    let x = (thread & 7u) | ((thread >> 2u) & 8u);
    let y = ((thread >> 3u) & 3u) | ((thread >> 4u) & 12u);
    return vec2u(x, y);
}
