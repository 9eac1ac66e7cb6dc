// Stage bin, last part: from each macro tile's splats, those of each of its tiles, in order.
//
// One workgroup per macro tile. `count` counts, a prefix sum over all tiles gives each its places, and
// `list` fills them: by batches, whose bits are transposed from tiles of a splat to splats of a tile.

#import constants
#import layout
#import math

const TILES: u32 = MACRO_COLUMNS * MACRO_ROWS;
const BATCH_WORDS: u32 = EXPAND_BATCH / 32;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> macro_ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> touch_masks: array<u32>;
@group(0) @binding(3) var<storage, read> touch_places: array<u32>;
@group(0) @binding(4) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(5) var<storage, read> instances_job: Job;
@group(0) @binding(6) var<storage, read_write> ranges: array<vec2u>;
@group(0) @binding(7) var<storage, read_write> instance_places: array<u32>;
@group(0) @binding(8) var<storage, read_write> counters: Counters;

var<workgroup> counts: array<atomic<u32>, TILES>;

@compute @workgroup_size(WORKGROUP)
fn count(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= frame.macros {
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

// For each tile, a bit per splat of the batch that touches it, word-major.
var<workgroup> holders: array<atomic<u32>, TILES * BATCH_WORDS>;
// Where the first splat of each word goes.
var<workgroup> word_starts: array<u32, TILES * BATCH_WORDS>;

@compute @workgroup_size(WORKGROUP)
fn list(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= frame.macros {
        return;
    }
    // Of the first 32 threads, each has a tile.
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
        for (var k = thread; k < TILES * BATCH_WORDS; k += WORKGROUP) {
            atomicStore(&holders[k], 0u);
        }
        workgroupBarrier();
        let end = min(start + EXPAND_BATCH, range.y);
        for (var i = start + thread; i < end; i += WORKGROUP) {
            let word = (i - start) / 32u * TILES;
            for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
                atomicOr(&holders[word + firstTrailingBit(rest)], own_bit);
            }
        }
        workgroupBarrier();
        if thread < TILES {
            for (var word = thread; word < TILES * BATCH_WORDS; word += TILES) {
                word_starts[word] = next;
                next += countOneBits(atomicLoad(&holders[word]));
            }
        }
        workgroupBarrier();
        for (var i = start + thread; i < end; i += WORKGROUP) {
            let place = touch_places[i];
            let word = (i - start) / 32u * TILES;
            for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
                let at = word + firstTrailingBit(rest);
                let nearer = countOneBits(atomicLoad(&holders[at]) & (own_bit - 1u));
                instance_places[word_starts[at] + nearer] = place;
            }
        }
        workgroupBarrier();
    }
    if tile < frame.tiles {
        ranges[tile] = vec2u(first, next);
    }
}

// The tile of bit `k` of a macro tile, or as many as there are if it is none or beyond the image.
fn tile_at(index: u32, k: u32) -> u32 {
    var number = 0u;
    while number + 1u < frame.views && frame.view[number + 1u].first_macro <= index {
        number++;
    }
    let view = frame.view[number];
    let of_view = index - view.first_macro;
    let column = of_view % view.macro_columns * MACRO_COLUMNS + k % MACRO_COLUMNS;
    let row = of_view / view.macro_columns * MACRO_ROWS + k / MACRO_COLUMNS;
    let is_tile = k < TILES && column < view.columns && row * TILE_PX < view.size_px.y;
    return select(frame.tiles, view.first_tile + row * view.columns + column, is_tile);
}
