// Stage rasterize: one workgroup per tile blends the tile's splats front to back. Each thread has four
// pixels of a row, so that loading a splat and computing the terms that depend on the row are shared by
// four pixels. Splats are loaded batch by batch into workgroup memory, with a list of those whose box
// reaches each block of 4 x 4 px: most splats are smaller than a tile, and the four threads of a block
// blend only those in its list.
//
// A tile where a road meets the horizon has hundreds of times the splats of others, and the device waits for
// it. So a thread evaluates two splats at a time: the instructions of one do not depend on the other.
//
// Products and sums are written as `fma` where a compiler could contract them, here and in the imported files but for
// those of lenses: it may do so in one variant of this shader and not in another, and a pixel's bytes must not
// depend on what else is requested.
//
// Tiles with long lists are blended by `rasterize_long.wgsl`: `main` leaves them out, and `finish` writes their pixels.
//
// `BACKGROUND` stands for `background.wgsl` or `no_background.wgsl`, and `INSTANCES` for `instances.wgsl`,
// `owners.wgsl` or `no_instances.wgsl`. Twin of `src/render/cpu/rasterize.rs`.

#import constants
#import layout
#import math
#import splat_batch
#import tile_blocks
#import four_pixels
#import INSTANCES
#import has_samples
#import resolve
#import BACKGROUND
#import samples

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> span: Span;
@group(0) @binding(2) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read> instance_splats: array<u32>;
@group(0) @binding(4) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(5) var<storage, read> colors: array<SplatColor>;
@group(0) @binding(6) var<storage, read_write> counters: TileCounters;
// For each tile, its place among the tiles with long lists, plus 1; 0 for the others.
@group(0) @binding(15) var<storage, read> long_places: array<u32>;
// The sums of tiles with long lists; `rasterize_long.wgsl` has the layout.
@group(0) @binding(16) var<storage, read> long_sums: array<vec4u>;

// Whether another kernel blends the tiles with long lists.
override LONG_TILES: bool;

// 64 threads of 4 pixels. A batch takes 44 B per splat, 6 KiB of workgroup memory, so that this memory
// does not limit how many workgroups a multiprocessor can hold.
const THREADS: u32 = TILE_PX * TILE_PX / 4;
const BATCH: u32 = RASTER_BATCH;
const BATCH_WORDS: u32 = BATCH / 32;

// For each two splats of the batch: in the low half one bit per block that the box of the first reaches, in
// the high half those of the second.
var<workgroup> blocks_of_two: array<u32, BATCH / 2>;
// For each block, one bit per splat of the batch. Block after block.
var<workgroup> block_splats: array<u32, BLOCKS * BATCH_WORDS>;

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
    if LONG_TILES && long_places[tile] != 0u {
        return;
    }
    let view_index = tile_view(tile);
    let view = frame.view[view_index];
    let corner = tile_corner(tile, view);
    let block = thread / 4u;
    let first_pixel = thread_pixel(thread);
    let at_px = vec2f(corner + first_pixel) + 0.5;

    if thread == 0u {
        begin_batches();
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
    var pairs = 0u;
    let range = ranges[tile];
    for (var first = range.x; first < range.y; first += BATCH) {
        // End when all threads are done.
        workgroupBarrier();
        if thread == 0u {
            done_threads = atomicLoad(&done_count);
        }
        if workgroupUniformLoad(&done_threads) == THREADS {
            break;
        }
        // More than a software device can blend: the host refuses the frame.
        batches++;
        if batches > frame.batch_limit {
            break;
        }
        // Load a batch, two splats by each thread. Places after the last splat reach no block.
        let count = min(range.y - first, BATCH);
        var blocks = 0u;
        for (var i = 0u; i < 2u; i++) {
            let k = 2u * thread + i;
            if k < count {
                let splat = instance_splats[first + k];
                let shape = shapes[splat];
                store_splat(k, shape, colors[splat]);
                blocks |= reached_blocks(shape, corner) << (i * BLOCKS);
            }
        }
        blocks_of_two[thread] = blocks;
        workgroupBarrier();
        // Transpose: from bits of blocks per splat to words of splats per block, one by each thread.
        let word = thread / BLOCKS;
        var bits = 0u;
        for (var i = 0u; i < 16u; i++) {
            let two = blocks_of_two[16u * word + i] >> (thread % BLOCKS);
            bits |= ((two & 1u) | ((two >> (BLOCKS - 1u)) & 2u)) << (2u * i);
        }
        block_splats[thread % BLOCKS * BATCH_WORDS + word] = bits;
        pairs += countOneBits(bits);
        workgroupBarrier();
        // Each word has 32 splats, in order of depth.
        let was_done = done;
        for (var k = 0u; k < BATCH_WORDS && !done; k++) {
            var rest = block_splats[block * BATCH_WORDS + k];
            while rest != 0u && !done {
                let a = k * 32u + firstTrailingBit(rest);
                rest &= rest - 1u;
                let b = select(NO_SPLAT, k * 32u + firstTrailingBit(rest), rest != 0u);
                rest &= rest - 1u;
                let exponent_a = exponents(a, splat_offsets(a, at_px));
                let exponent_b = exponents(b, splat_offsets(b, at_px));
                let touched_a = exponent_a >= vec4f(frame.log2_alpha_cut);
                let touched_b = exponent_b >= vec4f(frame.log2_alpha_cut);
                if any(touched_a | touched_b) {
                    let alpha_a = select(vec4f(0.0), alphas(exponent_a), touched_a);
                    let alpha_b = select(vec4f(0.0), alphas(exponent_b), touched_b);
                    // In order of depth. A stopped pixel stays stopped, so the result of the second call covers both.
                    blend(&sums, &running, alpha_a, color_depths[a], first + a);
                    done = blend(&sums, &running, alpha_b, color_depths[b], first + b);
                }
            }
        }
        if done && !was_done {
            atomicAdd(&done_count, 1u);
        }
    }
    atomicAdd(&block_pairs, pairs);
    workgroupBarrier();
    if thread == 0u {
        atomicAdd(&counters.block_pairs, atomicLoad(&block_pairs));
        atomicMax(&counters.most_batches, batches);
    }
    finish_tile(index, view_index, corner, thread, sums);
}

// Writes the pixels of a tile with a long list.
@compute @workgroup_size(THREADS)
fn finish(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= span.count {
        return;
    }
    let tile = span.first + index;
    let place = long_places[tile];
    if place == 0u {
        return;
    }
    let view_index = tile_view(tile);
    let first_pixel = thread_pixel(thread);
    let corner = tile_corner(tile, frame.view[view_index]);
    let at = ((place - 1u) * LONG_TILE_WORDS + first_pixel.y * TILE_PX + first_pixel.x) / 4u;
    let plane = TILE_PX * TILE_PX / 4u;
    let sums = Sums(
        bitcast<vec4f>(long_sums[at]),
        bitcast<vec4f>(long_sums[at + plane]),
        bitcast<vec4f>(long_sums[at + 2u * plane]),
        bitcast<vec4f>(long_sums[at + 3u * plane]),
        bitcast<vec4f>(long_sums[at + 4u * plane]),
    );
    set_owners(long_sums[at + 5u * plane]);
    if thread == 0u {
        let counts = long_sums[((place - 1u) * LONG_TILE_WORDS) / 4u + 6u * plane];
        atomicAdd(&counters.block_pairs, counts.x);
        atomicMax(&counters.most_batches, counts.y);
    }
    finish_tile(index, view_index, corner, thread, sums);
}

// Opacities from their base-2 logarithms.
fn alphas(exponents: vec4f) -> vec4f {
    return min(exp2(exponents), vec4f(frame.alpha_cap));
}

// Blends a splat into four pixels. Returns whether all of them have stopped.
fn blend(
    sums: ptr<function, Sums>,
    running: ptr<function, vec4f>,
    alpha: vec4f,
    color_depth: vec4f,
    list_index: u32,
) -> bool {
    let after = fma(-alpha, *running, *running);
    // The Gaussian that would bring the transmittance to the stop or below is not blended.
    let counts = after > vec4f(frame.stop);
    let weight = select(vec4f(0.0), alpha * *running, counts);
    (*sums).red = fma(weight, vec4f(color_depth.r), (*sums).red);
    (*sums).green = fma(weight, vec4f(color_depth.g), (*sums).green);
    (*sums).blue = fma(weight, vec4f(color_depth.b), (*sums).blue);
    if DEPTH {
        (*sums).depth = fma(weight, vec4f(color_depth.w), (*sums).depth);
    }
    note_owner(list_index, (*sums).transmittance, after, counts);
    (*sums).transmittance = select((*sums).transmittance, after, counts);
    *running = after;
    return !any(counts);
}
