// Stage rasterize: one workgroup per tile blends the tile's splats front to back. Each thread has four
// pixels of a row, so that loading a splat and computing the terms that depend on the row are shared by
// four pixels. Splats are loaded batch by batch into workgroup memory, with a list of those whose box
// reaches each block of 8 x 8 px: most splats are smaller than a tile, and 16 threads that have a block
// blend only those in its list.
//
// Products and sums are written as `fma` where a compiler could contract them: it may do so in one variant
// of this shader and not in another, and a pixel's bytes must not depend on what else is requested.
//
// `BACKGROUND` stands for `background.wgsl` or `no_background.wgsl`, and `INSTANCES` for `instances.wgsl` or
// `no_instances.wgsl`. Twin of
// `src/render/cpu/rasterize.rs`.

#import constants
#import layout
#import math
#import INSTANCES
#import resolve
#import BACKGROUND

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> span: Span;
@group(0) @binding(2) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read> instance_splats: array<u32>;
@group(0) @binding(4) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(5) var<storage, read> colors: array<SplatColor>;
@group(0) @binding(6) var<storage, read_write> counters: Counters;

// 64 threads of 4 pixels. A batch takes 40 B per splat, 5 KiB of workgroup memory, so that this memory
// does not limit how many workgroups a multiprocessor can hold.
const THREADS: u32 = TILE_PX * TILE_PX / 4;
// Two by two.
const BLOCKS: u32 = 4;
const BLOCK_THREADS: u32 = THREADS / BLOCKS;
const BATCH_WORDS: u32 = RASTER_BATCH / 32;

var<workgroup> means: array<vec2f, RASTER_BATCH>;
// Cholesky factor (l0, l1, l2), and base-2 logarithm of the peak opacity.
var<workgroup> factors: array<vec4f, RASTER_BATCH>;
// Colour, and depth in metres.
var<workgroup> color_depths: array<vec4f, RASTER_BATCH>;
// For each block, one bit per splat of the batch, set if the splat's box reaches it. Block after block.
var<workgroup> block_splats: array<atomic<u32>, BLOCKS * BATCH_WORDS>;
// For each block, the number of its set bits in all batches.
var<workgroup> block_pairs: array<atomic<u32>, BLOCKS>;
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
    let block = thread / BLOCK_THREADS;
    let in_block = vec2u(thread % 2u * 4u, thread % BLOCK_THREADS / 2u);
    let first_pixel = vec2u(block % 2u, block / 2u) * BLOCK_PX + in_block;
    let at_px = vec2f(corner + first_pixel) + 0.5;

    if thread == 0u {
        atomicStore(&done_count, 0u);
    }
    if thread < BLOCKS {
        atomicStore(&block_pairs[thread], 0u);
    }
    workgroupBarrier();
    var sums = Sums(vec4f(0.0), vec4f(0.0), vec4f(0.0), vec4f(0.0), vec4f(1.0));
    // Transmittance that is also updated after a pixel has stopped. It never rises, so a stopped pixel
    // stays stopped without a flag per pixel.
    var running = vec4f(1.0);
    // Pixels outside of the image are done at once: sizes need not be multiples of 16 px.
    var done = any(corner + first_pixel >= view.size_px);
    if done {
        atomicAdd(&done_count, 1u);
    }
    var batches = 0u;
    let range = ranges[tile];
    for (var first = range.x; first < range.y; first += RASTER_BATCH) {
        // End when all threads are done.
        workgroupBarrier();
        if thread == 0u {
            done_threads = atomicLoad(&done_count);
        }
        if thread < BLOCKS * BATCH_WORDS {
            atomicStore(&block_splats[thread], 0u);
        }
        if workgroupUniformLoad(&done_threads) == THREADS {
            break;
        }
        // Load a batch.
        batches++;
        let count = min(range.y - first, RASTER_BATCH);
        for (var k = thread; k < count; k += THREADS) {
            let splat = instance_splats[first + k];
            let shape = shapes[splat];
            let color = colors[splat];
            means[k] = shape.mean_px;
            factors[k] = vec4f(shape.factor, shape.log2_opacity);
            color_depths[k] = vec4f(color.rgb, color.depth_m);
            list_in_blocks(k, shape, corner);
        }
        workgroupBarrier();
        if thread < BLOCKS * BATCH_WORDS {
            let pairs = countOneBits(atomicLoad(&block_splats[thread]));
            atomicAdd(&block_pairs[thread / BATCH_WORDS], pairs);
        }
        // exponent = log2(alpha) = log2(opacity) - (l0 dx + l1 dy)^2 - (l2 dy)^2 at each of four pixels.
        let was_done = done;
        for (var word = 0u; word < BATCH_WORDS && !done; word++) {
            var rest = atomicLoad(&block_splats[block * BATCH_WORDS + word]);
            for (; rest != 0u && !done; rest &= rest - 1u) {
                let k = word * 32u + firstTrailingBit(rest);
                let factor = factors[k];
                let d = at_px - means[k];
                let v = factor.z * d.y;
                let first_u = fma(factor.x, d.x, factor.y * d.y);
                let u = fma(vec4f(factor.x), vec4f(0.0, 1.0, 2.0, 3.0), vec4f(first_u));
                let exponent = fma(-u, u, vec4f(fma(-v, v, factor.w)));
                let touched = exponent >= vec4f(frame.log2_alpha_cut);
                if any(touched) {
                    let alpha =
                        select(vec4f(0.0), min(exp2(exponent), vec4f(frame.alpha_cap)), touched);
                    let after = fma(-alpha, running, running);
                    // The Gaussian that would bring the transmittance to the stop or below is not blended.
                    let counts = after > vec4f(frame.stop);
                    let weight = select(vec4f(0.0), alpha * running, counts);
                    let color_depth = color_depths[k];
                    sums.red = fma(weight, vec4f(color_depth.r), sums.red);
                    sums.green = fma(weight, vec4f(color_depth.g), sums.green);
                    sums.blue = fma(weight, vec4f(color_depth.b), sums.blue);
                    if DEPTH {
                        sums.depth = fma(weight, vec4f(color_depth.w), sums.depth);
                    }
                    note_owner(first + k, sums.transmittance, after, counts);
                    sums.transmittance = select(sums.transmittance, after, counts);
                    running = after;
                    done = !any(counts);
                }
            }
        }
        if done && !was_done {
            atomicAdd(&done_count, 1u);
        }
    }
    workgroupBarrier();
    if thread == 0u {
        var pairs = 0u;
        var most = 0u;
        for (var k = 0u; k < BLOCKS; k++) {
            let own = atomicLoad(&block_pairs[k]);
            pairs += own;
            most = max(most, own);
        }
        atomicAdd(&counters.block_pairs, pairs);
        atomicMax(&counters.most_iterations, batches * BATCH_ITERATIONS + most);
    }
    sums = composite(sums, view_index, at_px, thread);
    resolve(index, first_pixel.y * TILE_PX + first_pixel.x, sums);
}

// Lists splat `k` of the batch in the blocks that its box reaches, by the test with which `bin.wgsl` finds
// its tiles. `corner` is the first pixel of the tile.
fn list_in_blocks(k: u32, shape: SplatShape, corner: vec2u) {
    let corner_px = vec2f(corner);
    let first = ceil(shape.mean_px - shape.extent_px - 0.5) - corner_px;
    let last = floor(shape.mean_px + shape.extent_px - 0.5) - corner_px;
    let size = f32(BLOCK_PX);
    let left = first.x < size && last.x >= 0.0;
    let right = first.x < 2.0 * size && last.x >= size;
    let upper = first.y < size && last.y >= 0.0;
    let lower = first.y < 2.0 * size && last.y >= size;
    let word = k / 32u;
    let bit = 1u << (k % 32u);
    if upper && left {
        atomicOr(&block_splats[word], bit);
    }
    if upper && right {
        atomicOr(&block_splats[BATCH_WORDS + word], bit);
    }
    if lower && left {
        atomicOr(&block_splats[2u * BATCH_WORDS + word], bit);
    }
    if lower && right {
        atomicOr(&block_splats[3u * BATCH_WORDS + word], bit);
    }
}

// Index of the view that a tile belongs to.
fn view_of(tile: u32) -> u32 {
    var view = 0u;
    while view + 1u < frame.views && frame.view[view + 1u].first_tile <= tile {
        view++;
    }
    return view;
}
