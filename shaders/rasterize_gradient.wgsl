// Gradients, stage rasterize, for a run of macro tiles: one workgroup per tile walks the tile's splats from front to
// back once more, as `rasterize.wgsl` drew them, and sums for each of them over the tile's pixels what its gradients
// need. The formulas are in `src/render/gradient/mod.rs`. Twin of `src/render/cpu/blend_gradient.rs`.
//
// A thread adds up its own four pixels in registers. The sums of a few splats at a time go to workgroup memory, where
// one thread for each sum adds those of the blocks that the splat reaches, in order: without atomics, and without
// subgroups, whose size would change the order.

#import constants
#import layout
#import math
#import macro_tile
#import splat_batch
#import tile_blocks
#import four_pixels
#import splat_sums

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> run: MacroRun;
@group(0) @binding(2) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read> instance_splats: array<u32>;
@group(0) @binding(4) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(5) var<storage, read> colors: array<SplatColor>;
// For each tile of the page, planes of 256 values: the derivatives by red, green, blue and the sum of depths, and the
// change of the loss with everything: the sum of weights times (rgb · v_rgb + depth v_depth), minus T_end v_opacity.
@group(0) @binding(6) var<storage, read> derivatives: array<vec4f>;
// Ten sums, in the order of `SplatSums`, of each touch of the run and then of each instance.
@group(0) @binding(7) var<storage, read_write> run_sums: array<f32>;

const THREADS: u32 = TILE_PX * TILE_PX / 4;
// Splats of a batch: one for each thread to load.
const BATCH: u32 = THREADS;
// Splats whose sums are in workgroup memory at a time: 10 KiB.
const PART: u32 = 4;
const SUMS: u32 = 10;
const PLANE: u32 = TILE_PX * TILE_PX / 4;

// For each splat of the batch, one bit per block that its box reaches.
var<workgroup> splat_blocks: array<u32, BATCH>;
// For each splat of a part, each sum, and each thread, its sum.
var<workgroup> thread_sums: array<f32, PART * SUMS * THREADS>;

// The derivatives by the images at the thread's pixels.
var<private> by_red: vec4f;
var<private> by_green: vec4f;
var<private> by_blue: vec4f;
var<private> by_depth: vec4f;
// What lies behind the next splat, as it changes the loss.
var<private> behind: vec4f;
// Transmittance in front of the next splat, as in `rasterize.wgsl` also after a pixel has stopped.
var<private> running: vec4f;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= run.macro_tiles * TILES {
        return;
    }
    let tile = tile_at(run.first_macro_tile + index / TILES, index % TILES);
    if tile == frame.tiles || (run.tiles & (1u << (index % TILES))) == 0u {
        return;
    }
    let view = frame.view[tile_view(tile)];
    let corner = tile_corner(tile, view);
    let first_pixel = thread_pixel(thread);
    let at_px = vec2f(corner + first_pixel) + 0.5;
    if thread == 0u {
        begin_batches();
    }
    workgroupBarrier();
    let plane = (tile - run.first_tile) * 5u * PLANE + (first_pixel.y * TILE_PX + first_pixel.x) / 4u;
    by_red = derivatives[plane];
    by_green = derivatives[plane + PLANE];
    by_blue = derivatives[plane + 2u * PLANE];
    by_depth = derivatives[plane + 3u * PLANE];
    behind = derivatives[plane + 4u * PLANE];
    running = vec4f(1.0);
    var done = any(corner + first_pixel >= view.size_px);
    if done {
        atomicAdd(&done_count, 1u);
    }
    let range = ranges[tile] - run.first_instance;
    for (var first = range.x; first < range.y; first += BATCH) {
        // End when all threads are done: the sums of the splats behind are 0.
        workgroupBarrier();
        if thread == 0u {
            done_threads = atomicLoad(&done_count);
        }
        if workgroupUniformLoad(&done_threads) == THREADS {
            for (var i = first * SUMS + thread; i < range.y * SUMS; i += THREADS) {
                run_sums[run.touches * SUMS + i] = 0.0;
            }
            break;
        }
        let count = min(range.y - first, BATCH);
        var blocks = 0u;
        if thread < count {
            let splat = instance_splats[run.first_instance + first + thread];
            let shape = shapes[splat];
            store_splat(thread, shape, colors[splat]);
            blocks = reached_blocks(shape, corner);
        }
        splat_blocks[thread] = blocks;
        workgroupBarrier();
        let was_done = done;
        for (var part = 0u; part < count; part += PART) {
            done = walk(part, 0u, at_px, thread, done);
            done = walk(part, 1u, at_px, thread, done);
            done = walk(part, 2u, at_px, thread, done);
            done = walk(part, 3u, at_px, thread, done);
            workgroupBarrier();
            if thread < PART * SUMS && part + thread / SUMS < count {
                run_sums[(run.touches + first + part) * SUMS + thread] = block_sum(thread * THREADS, splat_blocks[part + thread / SUMS]);
            }
            workgroupBarrier();
        }
        if done && !was_done {
            atomicAdd(&done_count, 1u);
        }
    }
}

// Walks past splat `k` of a part if it reaches the thread's block. Returns whether the thread's pixels have all stopped.
fn walk(part: u32, k: u32, at_px: vec2f, thread: u32, done: bool) -> bool {
    if (splat_blocks[part + k] & (1u << (thread / 4u))) == 0u {
        return done;
    }
    return pass_splat(part + k, at_px, k * SUMS * THREADS + thread, done);
}

// The sum of the values from `at` on, one of each thread, over the threads of some blocks. Without a loop: see
// `max_gradient_splats` in `src/render/gpu/device.rs`.
fn block_sum(at: u32, blocks: u32) -> f32 {
    var sum = 0.0;
    sum = plus_block(sum, at, blocks, 0u);
    sum = plus_block(sum, at, blocks, 1u);
    sum = plus_block(sum, at, blocks, 2u);
    sum = plus_block(sum, at, blocks, 3u);
    sum = plus_block(sum, at, blocks, 4u);
    sum = plus_block(sum, at, blocks, 5u);
    sum = plus_block(sum, at, blocks, 6u);
    sum = plus_block(sum, at, blocks, 7u);
    sum = plus_block(sum, at, blocks, 8u);
    sum = plus_block(sum, at, blocks, 9u);
    sum = plus_block(sum, at, blocks, 10u);
    sum = plus_block(sum, at, blocks, 11u);
    sum = plus_block(sum, at, blocks, 12u);
    sum = plus_block(sum, at, blocks, 13u);
    sum = plus_block(sum, at, blocks, 14u);
    sum = plus_block(sum, at, blocks, 15u);
    return sum;
}

fn plus_block(sum: f32, at: u32, blocks: u32, block: u32) -> f32 {
    if (blocks & (1u << block)) == 0u {
        return sum;
    }
    let four = at + 4u * block;
    return sum + ((thread_sums[four] + thread_sums[four + 1u]) + (thread_sums[four + 2u] + thread_sums[four + 3u]));
}

// Walks past splat `k` of the batch, and writes the sums over four pixels, `THREADS` apart from `at` on. Returns whether all
// of them have stopped, as `done` says of them before.
fn pass_splat(k: u32, at_px: vec2f, at: u32, done: bool) -> bool {
    let offsets = splat_offsets(k, at_px);
    let exponent = exponents(k, offsets);
    let touched = exponent >= vec4f(frame.log2_alpha_cut);
    if done || !any(touched) {
        store_sums(at, SplatSums());
        return done;
    }
    let color_depth = color_depths[k];
    let peak = exp2(exponent);
    let alpha = select(vec4f(0.0), min(peak, vec4f(frame.alpha_cap)), touched);
    let after = fma(-alpha, running, running);
    let counts = after > vec4f(frame.stop);
    let weight = select(vec4f(0.0), alpha * running, counts);
    let energy = color_depth.r * by_red + color_depth.g * by_green + color_depth.b * by_blue + color_depth.w * by_depth;
    behind -= weight * energy;
    let by_alpha = running * energy - behind / (1.0 - alpha);
    // Nothing at the cap: alpha does not change there.
    let g = select(vec4f(0.0), by_alpha * alpha, counts & (peak <= vec4f(frame.alpha_cap)));
    // A pixel that has stopped is never read again; it must not underflow.
    running = max(after, vec4f(1e-20));
    let one = vec4f(1.0);
    let gu = g * offsets.u;
    let sum_g = dot(g, one);
    let sum_gu = dot(gu, one);
    store_sums(at, SplatSums(
        sum_g,
        sum_gu,
        sum_g * offsets.v,
        dot(gu, offsets.u),
        sum_gu * offsets.v,
        sum_g * offsets.v * offsets.v,
        dot(weight, by_red),
        dot(weight, by_green),
        dot(weight, by_blue),
        dot(weight, by_depth),
    ));
    return !any(counts);
}

fn store_sums(at: u32, sums: SplatSums) {
    thread_sums[at] = sums.g;
    thread_sums[at + THREADS] = sums.u;
    thread_sums[at + 2u * THREADS] = sums.v;
    thread_sums[at + 3u * THREADS] = sums.uu;
    thread_sums[at + 4u * THREADS] = sums.uv;
    thread_sums[at + 5u * THREADS] = sums.vv;
    thread_sums[at + 6u * THREADS] = sums.red;
    thread_sums[at + 7u * THREADS] = sums.green;
    thread_sums[at + 8u * THREADS] = sums.blue;
    thread_sums[at + 9u * THREADS] = sums.depth;
}
