// Stage rasterize: each tile blends its splats from the nearest, one workgroup per tile, four pixels
// of a row per thread: what is read of a splat serves four, and so does what depends on the row.
// Batches of splats travel through workgroup memory.
//
// Twin of `src/render/cpu/rasterize.rs`.

#import constants
#import layout
#import math
#import resolve
#import BEHIND

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> span: Span;
@group(0) @binding(2) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read> instance_places: array<u32>;
@group(0) @binding(4) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(5) var<storage, read> colors: array<SplatColor>;
@group(0) @binding(6) var<storage, read_write> counters: Counters;

// 64 threads of 4 pixels, and 40 B for each splat of a batch: 5 KiB, so that a multiprocessor holds
// as many workgroups as it can.
const THREADS: u32 = TILE_PX * TILE_PX / 4;

var<workgroup> means: array<vec2f, RASTER_BATCH>;
// The factor, and the base-2 logarithm of the peak opacity.
var<workgroup> factors: array<vec4f, RASTER_BATCH>;
// Colour and depth.
var<workgroup> paints: array<vec4f, RASTER_BATCH>;
var<workgroup> done_count: atomic<u32>;
var<workgroup> done_threads: u32;

@compute @workgroup_size(THREADS)
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
    let view_index = view_of(tile);
    let view = frame.view[view_index];
    let tile_of_view = tile - view.first_tile;
    let corner = vec2u(tile_of_view % view.columns, tile_of_view / view.columns) * TILE_PX;
    let first_pixel = vec2u(thread % 4u * 4u, thread / 4u);
    let at_px = vec2f(corner + first_pixel) + 0.5;

    if thread == 0u {
        atomicStore(&done_count, 0u);
    }
    workgroupBarrier();
    // Images need not be multiples of 16 px.
    var sums = Sums(vec4f(0.0), vec4f(0.0), vec4f(0.0), vec4f(0.0), vec4f(1.0));
    // Runs on after a pixel has stopped: it only falls, so that a pixel stays stopped.
    var running = vec4f(1.0);
    var done = any(corner + first_pixel >= view.size_px);
    if done {
        atomicAdd(&done_count, 1u);
    }
    var batches = 0u;
    let range = ranges[tile];
    for (var first = range.x; first < range.y; first += RASTER_BATCH) {
        workgroupBarrier();
        if thread == 0u {
            done_threads = atomicLoad(&done_count);
        }
        if workgroupUniformLoad(&done_threads) == THREADS {
            break;
        }
        batches++;
        let count = min(range.y - first, RASTER_BATCH);
        for (var k = thread; k < count; k += THREADS) {
            let place = instance_places[first + k];
            let shape = shapes[place];
            let color = colors[place];
            means[k] = shape.mean_px;
            factors[k] = vec4f(shape.factor, shape.log2_opacity);
            paints[k] = vec4f(color.rgb, color.depth_m);
        }
        workgroupBarrier();
        let was_done = done;
        for (var k = 0u; k < count && !done; k++) {
            let factor = factors[k];
            let d = at_px - means[k];
            let v = factor.z * d.y;
            let u = factor.x * d.x + factor.y * d.y + factor.x * vec4f(0.0, 1.0, 2.0, 3.0);
            let exponent = factor.w - v * v - u * u;
            let touched = exponent >= vec4f(frame.log2_alpha_cut);
            if any(touched) {
                let alpha =
                    select(vec4f(0.0), min(exp2(exponent), vec4f(frame.alpha_cap)), touched);
                let after = running - alpha * running;
                // The Gaussian that would bring the transmittance to the stop is left out.
                let counts = after > vec4f(frame.stop);
                let weight = select(vec4f(0.0), alpha * running, counts);
                let paint = paints[k];
                sums.red += weight * paint.r;
                sums.green += weight * paint.g;
                sums.blue += weight * paint.b;
                if DEPTH {
                    sums.depth += weight * paint.w;
                }
                sums.transmittance = select(sums.transmittance, after, counts);
                running = after;
                done = !any(counts);
            }
        }
        if done && !was_done {
            atomicAdd(&done_count, 1u);
        }
    }
    if thread == 0u {
        atomicAdd(&counters.batches, batches);
        atomicMax(&counters.most_batches, batches);
    }
    sums = complete(sums, view_index, at_px, thread);
    resolve(index, first_pixel.y * TILE_PX + first_pixel.x, sums);
}

fn view_of(tile: u32) -> u32 {
    var view = 0u;
    while view + 1u < frame.views && frame.view[view + 1u].first_tile <= tile {
        view++;
    }
    return view;
}
