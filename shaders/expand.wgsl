// Stage bin, last part: distributes the touches of each macro tile to the lists of its tiles, in order
// of depth. One workgroup per batch of 1,024 touches of a macro tile: a few macro tiles, where a road meets
// the horizon, have most of the touches. With one workgroup per macro tile, the device would wait for these.
//
// `batches` counts the batches of each macro tile. `count` counts the instances of each tile in each batch; a
// prefix sum over these counts, in order of macro tile, tile, and batch, gives the index of the first
// instance of each tile in each batch. `list` fills the lists: the bit matrix of a batch is transposed from "tiles of a
// splat" to "splats of a tile".

#import constants
#import layout
#import math

const TILES: u32 = MACRO_COLUMNS * MACRO_ROWS;
const BATCH_WORDS: u32 = EXPAND_BATCH / 32;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> macro_ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> touch_masks: array<u32>;
@group(0) @binding(3) var<storage, read> touch_splats: array<u32>;
@group(0) @binding(4) var<storage, read_write> first_batches: array<u32>;
@group(0) @binding(5) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(6) var<storage, read> batches_job: Job;
@group(0) @binding(7) var<storage, read> instances_job: Job;
@group(0) @binding(8) var<storage, read_write> ranges: array<u32>;
@group(0) @binding(9) var<storage, read_write> instance_splats: array<u32>;

@compute @workgroup_size(WORKGROUP)
fn batches(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups) * WORKGROUP + thread;
    if index < frame.macro_tiles {
        let range = macro_ranges[index];
        first_batches[index] = div_ceil(range.y - range.x, EXPAND_BATCH);
    }
}

// A batch of touches of a macro tile.
struct Batch {
    macro_tile: u32,
    // Its touches.
    first: u32,
    end: u32,
    // `offsets[offset + k * stride]` is its count for tile k of the macro tile.
    offset: u32,
    stride: u32,
    is_first: bool,
    is_last: bool,
}

// Batch `number` of the frame: a search for the last macro tile whose first batch is at most `number`.
fn batch(number: u32) -> Batch {
    var macro_tile = 0u;
    var end = frame.macro_tiles;
    while macro_tile + 1u < end {
        let middle = (macro_tile + end) / 2u;
        if first_batches[middle] <= number {
            macro_tile = middle;
        } else {
            end = middle;
        }
    }
    let range = macro_ranges[macro_tile];
    let first_batch = first_batches[macro_tile];
    let index = number - first_batch;
    let first = range.x + index * EXPAND_BATCH;
    let stride = div_ceil(range.y - range.x, EXPAND_BATCH);
    return Batch(
        macro_tile,
        first,
        min(first + EXPAND_BATCH, range.y),
        first_batch * TILES + index,
        stride,
        index == 0u,
        index + 1u == stride,
    );
}

var<workgroup> counts: array<atomic<u32>, TILES>;

@compute @workgroup_size(WORKGROUP)
fn count(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let number = group_index(group, groups);
    if number >= batches_job.length {
        return;
    }
    if thread < TILES {
        atomicStore(&counts[thread], 0u);
    }
    workgroupBarrier();
    let own = batch(number);
    for (var i = own.first + thread; i < own.end; i += WORKGROUP) {
        for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
            atomicAdd(&counts[firstTrailingBit(rest)], 1u);
        }
    }
    workgroupBarrier();
    if thread < TILES {
        offsets[own.offset + thread * own.stride] = atomicLoad(&counts[thread]);
    }
}

// For each tile, one bit per splat of the batch, set if the splat touches the tile. Word-major.
var<workgroup> tile_splats: array<atomic<u32>, TILES * BATCH_WORDS>;
// Index of the instance of the first set bit of each word.
var<workgroup> word_starts: array<u32, TILES * BATCH_WORDS>;

@compute @workgroup_size(WORKGROUP)
fn list(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let number = group_index(group, groups);
    if number >= batches_job.length || instances_job.length == 0u {
        return;
    }
    // Transpose the batch: from one word of tiles per splat to words of splats per tile.
    for (var k = thread; k < TILES * BATCH_WORDS; k += WORKGROUP) {
        atomicStore(&tile_splats[k], 0u);
    }
    workgroupBarrier();
    let own = batch(number);
    let own_bit = 1u << (thread % 32u);
    for (var i = own.first + thread; i < own.end; i += WORKGROUP) {
        let word = (i - own.first) / 32u * TILES;
        for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
            atomicOr(&tile_splats[word + firstTrailingBit(rest)], own_bit);
        }
    }
    workgroupBarrier();
    // For each tile, the index of the first instance of each word. Each of the first 32 threads is
    // responsible for one tile.
    if thread < TILES {
        let first = offsets[own.offset + thread * own.stride];
        var next = first;
        for (var word = thread; word < TILES * BATCH_WORDS; word += TILES) {
            word_starts[word] = next;
            next += countOneBits(atomicLoad(&tile_splats[word]));
        }
        let tile = tile_at(own.macro_tile, thread);
        if tile < frame.tiles && own.is_first {
            ranges[2u * tile] = first;
        }
        if tile < frame.tiles && own.is_last {
            ranges[2u * tile + 1u] = next;
        }
    }
    workgroupBarrier();
    // Write the instances: each splat follows the nearer ones of its word.
    for (var i = own.first + thread; i < own.end; i += WORKGROUP) {
        let splat = touch_splats[i];
        let word = (i - own.first) / 32u * TILES;
        for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
            let at = word + firstTrailingBit(rest);
            let nearer = countOneBits(atomicLoad(&tile_splats[at]) & (own_bit - 1u));
            instance_splats[word_starts[at] + nearer] = splat;
        }
    }
}

// Index of the tile of bit `k` of a macro tile; `frame.tiles` if there is no such tile.
fn tile_at(index: u32, k: u32) -> u32 {
    var number = 0u;
    while number + 1u < frame.views && frame.view[number + 1u].first_macro_tile <= index {
        number++;
    }
    let view = frame.view[number];
    let index_in_view = index - view.first_macro_tile;
    let column = index_in_view % view.macro_columns * MACRO_COLUMNS + k % MACRO_COLUMNS;
    let row = index_in_view / view.macro_columns * MACRO_ROWS + k / MACRO_COLUMNS;
    let is_tile = column < view.columns && row * TILE_PX < view.size_px.y;
    return select(frame.tiles, view.first_tile + row * view.columns + column, is_tile);
}
