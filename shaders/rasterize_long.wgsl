// Stage rasterize, tiles with long lists: those where a road meets the horizon have hundreds of times the splats of
// others, and the device would wait for them. A workgroup has four times as many threads as that of `rasterize.wgsl`, one
// for each pixel, evaluates four splats at a time, and loads the next batch while it blends one.
//
// 32 consecutive threads have a region of 8 x 4 px, two blocks, and walk over the splats that reach either; a thread
// blends those that reach its own block. So a pixel gets the same splats in the same order, and the same arithmetic, as
// in `rasterize.wgsl`, to the same bits. It writes sums, which `finish` there makes pixels of: so only one kernel has
// variants for each background.

#import constants
#import layout
#import math
#import splat_batch
#import tile_blocks

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> long_tiles: array<u32>;
@group(0) @binding(2) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read> instance_splats: array<u32>;
@group(0) @binding(4) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(5) var<storage, read> colors: array<SplatColor>;
@group(0) @binding(6) var<storage, read_write> long_sums: array<u32>;
// `main` of `rasterize.wgsl` reads it. It is bound here, too, so that the device need not wait between the two.
@group(0) @binding(7) var<storage, read> long_places: array<u32>;

override DEPTH: bool;
override OWNERS: bool;

const THREADS: u32 = TILE_PX * TILE_PX;
// Splats of a batch: one for each thread to load.
const BATCH: u32 = THREADS;
// Parts of a batch whose bits one thread transposes, 16 splats each.
const PARTS: u32 = BATCH / 16;

// For each splat of the batch, one bit per block that its box reaches.
var<workgroup> splat_blocks: array<u32, BATCH>;
// For each block and part of the batch, one bit per splat. Block after block.
var<workgroup> block_splats: array<u32, BLOCKS * PARTS>;

// What a pixel has gathered.
var<private> rgb: vec3f;
var<private> depth: f32;
var<private> transmittance: f32;
// Transmittance that is also updated after the pixel has stopped.
var<private> running: f32;
// Index in the tile's list, plus 1, of the splat that halves the transmittance; 0 if none has.
var<private> halved_by: u32;

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
    let tile = long_tiles[group.x];
    // A tile is listed only if it has a place.
    if long_places[tile] == 0u {
        return;
    }
    let view = frame.view[tile_view(tile)];
    let corner = tile_corner(tile, view);
    let region = thread / 32u;
    let own = vec2u(region % 2u * 8u + thread % 8u, region / 2u * 4u + thread % 32u / 8u);
    let block = own.y / BLOCK_PX * 4u + own.x / BLOCK_PX;
    // As in `rasterize.wgsl`, whose threads have four pixels from this one on.
    let first_px = vec2f(corner + vec2u(own.x / 4u * 4u, own.y)) + 0.5;
    let offset_px = f32(own.x % 4u);
    if thread == 0u {
        begin_batches();
    }
    workgroupBarrier();
    rgb = vec3f(0.0);
    depth = 0.0;
    transmittance = 1.0;
    running = 1.0;
    halved_by = 0u;
    var done = any(corner + own >= view.size_px);
    if done {
        atomicAdd(&done_count, 1u);
    }
    var batches = 0u;
    var pairs = 0u;
    let range = ranges[tile];
    var next = load(range, range.x + thread);
    for (var first = range.x; first < range.y; first += BATCH) {
        // End when all threads are done.
        workgroupBarrier();
        if thread == 0u {
            done_threads = atomicLoad(&done_count);
        }
        if workgroupUniformLoad(&done_threads) == THREADS {
            break;
        }
        let count = min(range.y - first, BATCH);
        batches += div_ceil(count, RASTER_BATCH);
        // More than a software device can blend: the host refuses the frame.
        if batches > frame.batch_limit {
            break;
        }
        store_splat(thread, next.shape, next.color);
        splat_blocks[thread] = select(0u, reached_blocks(next.shape, corner), thread < count);
        workgroupBarrier();
        next = load(range, first + BATCH + thread);
        // Transpose: from bits of blocks per splat to bits of splats per block.
        let part = thread / BLOCKS;
        var bits = 0u;
        for (var i = 0u; i < 16u; i++) {
            bits |= ((splat_blocks[16u * part + i] >> (thread % BLOCKS)) & 1u) << i;
        }
        block_splats[thread % BLOCKS * PARTS + part] = bits;
        pairs += countOneBits(bits);
        workgroupBarrier();
        // Each word has 32 splats, in order of depth.
        let was_done = done;
        for (var k = 0u; k < BATCH / 32u && !done; k++) {
            let mine = word(block, k);
            // The blocks of a region differ in the last bit.
            var rest = mine | word(block ^ 1u, k);
            while rest != 0u && !done {
                let a = take(&rest, k);
                let b = take(&rest, k);
                let c = take(&rest, k);
                let d = take(&rest, k);
                let exponents = vec4f(
                    exponent(a, first_px, offset_px),
                    exponent(b, first_px, offset_px),
                    exponent(c, first_px, offset_px),
                    exponent(d, first_px, offset_px),
                );
                let reached = ((vec4u(mine) >> (vec4u(a, b, c, d) % 32u)) & vec4u(1u)) == vec4u(1u);
                let touched = (exponents >= vec4f(frame.log2_alpha_cut)) & reached;
                if any(touched) {
                    let alphas = select(
                        vec4f(0.0),
                        min(exp2(exponents), vec4f(frame.alpha_cap)),
                        touched,
                    );
                    // In order of depth. A stopped pixel stays stopped.
                    blend(alphas.x, color_depths[a], first + a);
                    blend(alphas.y, color_depths[b], first + b);
                    blend(alphas.z, color_depths[c], first + c);
                    blend(alphas.w, color_depths[d], first + d);
                    done = !(running > frame.stop);
                }
            }
        }
        if done && !was_done {
            atomicAdd(&done_count, 1u);
        }
    }
    atomicAdd(&block_pairs, pairs);
    workgroupBarrier();
    let at = group.x * LONG_TILE_WORDS;
    let pixel = at + own.y * TILE_PX + own.x;
    long_sums[pixel] = bitcast<u32>(rgb.r);
    long_sums[pixel + THREADS] = bitcast<u32>(rgb.g);
    long_sums[pixel + 2u * THREADS] = bitcast<u32>(rgb.b);
    long_sums[pixel + 3u * THREADS] = bitcast<u32>(depth);
    long_sums[pixel + 4u * THREADS] = bitcast<u32>(transmittance);
    long_sums[pixel + 5u * THREADS] = halved_by;
    if thread == 0u {
        long_sums[at + 6u * THREADS] = atomicLoad(&block_pairs);
        long_sums[at + 6u * THREADS + 1u] = batches;
    }
}

// A splat before it is stored in workgroup memory.
struct Loaded {
    shape: SplatShape,
    color: SplatColor,
}

// The splat with this index in the lists; the last of the range beyond it.
fn load(range: vec2u, index: u32) -> Loaded {
    let splat = instance_splats[min(index, max(range.y, 1u) - 1u)];
    return Loaded(shapes[splat], colors[splat]);
}

// Bits of 32 splats of the batch that reach a block.
fn word(block: u32, k: u32) -> u32 {
    return block_splats[block * PARTS + 2u * k] | (block_splats[block * PARTS + 2u * k + 1u] << 16u);
}

// Takes the first splat of a word; `NO_SPLAT` if there is none.
fn take(rest: ptr<function, u32>, k: u32) -> u32 {
    let splat = select(NO_SPLAT, k * 32u + firstTrailingBit(*rest), *rest != 0u);
    *rest &= *rest - 1u;
    return splat;
}

// As `exponents` in `rasterize.wgsl`, for the pixel `offset_px` after the first one.
fn exponent(k: u32, first_px: vec2f, offset_px: f32) -> f32 {
    let mean_factor = mean_factors[k];
    let opacity = opacities[k];
    let d = first_px - mean_factor.xy;
    let v = opacity.x * d.y;
    let first_u = fma(mean_factor.z, d.x, mean_factor.w * d.y);
    let u = fma(mean_factor.z, offset_px, first_u);
    return fma(-u, u, fma(-v, v, opacity.y));
}

// As `blend` in `rasterize.wgsl`, for one pixel.
fn blend(alpha: f32, color_depth: vec4f, list_index: u32) {
    let after = fma(-alpha, running, running);
    let counts = after > frame.stop;
    let weight = select(0.0, alpha * running, counts);
    rgb = fma(vec3f(weight), color_depth.rgb, rgb);
    if DEPTH {
        depth = fma(weight, color_depth.w, depth);
    }
    if OWNERS {
        let halves = counts && transmittance > 0.5 && after <= 0.5;
        halved_by = select(halved_by, list_index + 1u, halves);
    }
    transmittance = select(transmittance, after, counts);
    running = after;
}
