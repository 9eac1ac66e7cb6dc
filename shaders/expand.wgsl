// Stage bin, last part: distributes the touches of each macro tile to the lists of its tiles, in order
// of depth. One workgroup per macro tile.
//
// `count` counts the splats of each tile, a prefix sum over all tiles gives each tile the start of its
// list, and `list` fills the lists. It works in batches: the bit matrix of a batch is transposed from
// "tiles of a splat" to "splats of a tile".

#import constants
#import layout
#import math

const TILES: u32 = MACRO_COLUMNS * MACRO_ROWS;
const BATCH_WORDS: u32 = EXPAND_BATCH / 32;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> macro_ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> touch_masks: array<u32>;
@group(0) @binding(3) var<storage, read> touch_splats: array<u32>;
@group(0) @binding(4) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(5) var<storage, read> instances_job: Job;
@group(0) @binding(6) var<storage, read_write> ranges: array<vec2u>;
@group(0) @binding(7) var<storage, read_write> instance_splats: array<u32>;
@group(0) @binding(8) var<storage, read_write> counters: Counters;

var<workgroup> counts: array<atomic<u32>, TILES>;

@compute @workgroup_size(WORKGROUP)
fn count(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= frame.macro_tiles {
        return;
    }
    if thread < TILES {
        atomicStore(&counts[thread], 0u);
    }
    workgroupBarrier();
    let range = macro_ranges[index];
    for (var i = range.x + thread; i < range.y; i += WORKGROUP) {
        for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
            atomicAdd(&counts[firstTrailingBit(rest)], 1u);
        }
    }
    workgroupBarrier();
    let tile = tile_at(index, thread);
    if tile < frame.tiles {
        offsets[tile] = atomicLoad(&counts[thread]);
    }
    if thread == 0u {
        atomicMax(&counters.most_touches, range.y - range.x);
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
    let index = group_index(group, groups);
    if index >= frame.macro_tiles {
        return;
    }
    // Each of the first 32 threads is responsible for one tile.
    let tile = tile_at(index, thread);
    var first = 0u;
    if tile < frame.tiles {
        first = offsets[tile];
    }
    var next = first;
    let own_bit = 1u << (thread % 32u);
    var range = macro_ranges[index];
    if instances_job.length == 0u {
        range = vec2u(0u);
    }
    for (var start = range.x; start < range.y; start += EXPAND_BATCH) {
        // Transpose the batch: from one word of tiles per splat to words of splats per tile.
        for (var k = thread; k < TILES * BATCH_WORDS; k += WORKGROUP) {
            atomicStore(&tile_splats[k], 0u);
        }
        workgroupBarrier();
        let end = min(start + EXPAND_BATCH, range.y);
        for (var i = start + thread; i < end; i += WORKGROUP) {
            let word = (i - start) / 32u * TILES;
            for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
                atomicOr(&tile_splats[word + firstTrailingBit(rest)], own_bit);
            }
        }
        workgroupBarrier();
        // For each tile, the index of the first instance of each word.
        if thread < TILES {
            for (var word = thread; word < TILES * BATCH_WORDS; word += TILES) {
                word_starts[word] = next;
                next += countOneBits(atomicLoad(&tile_splats[word]));
            }
        }
        workgroupBarrier();
        // Write the instances: each splat follows the nearer ones of its word.
        for (var i = start + thread; i < end; i += WORKGROUP) {
            let splat = touch_splats[i];
            let word = (i - start) / 32u * TILES;
            for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
                let at = word + firstTrailingBit(rest);
                let nearer = countOneBits(atomicLoad(&tile_splats[at]) & (own_bit - 1u));
                instance_splats[word_starts[at] + nearer] = splat;
            }
        }
        workgroupBarrier();
    }
    if tile < frame.tiles {
        ranges[tile] = vec2u(first, next);
    }
}

// Index of the tile of bit `k` of a macro tile; `frame.tiles` if there is no such bit or tile.
fn tile_at(index: u32, k: u32) -> u32 {
    var number = 0u;
    while number + 1u < frame.views && frame.view[number + 1u].first_macro_tile <= index {
        number++;
    }
    let view = frame.view[number];
    let index_in_view = index - view.first_macro_tile;
    let column = index_in_view % view.macro_columns * MACRO_COLUMNS + k % MACRO_COLUMNS;
    let row = index_in_view / view.macro_columns * MACRO_ROWS + k / MACRO_COLUMNS;
    let is_tile = k < TILES && column < view.columns && row * TILE_PX < view.size_px.y;
    return select(frame.tiles, view.first_tile + row * view.columns + column, is_tile);
}
