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
#import macro_tile
#import touch_batch

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
    let own = batch(number);
    transpose(own, thread);
    if thread < TILES {
        let first = offsets[own.offset + thread * own.stride];
        let end = find_word_starts(first, thread);
        let tile = tile_at(own.macro_tile, thread);
        if tile < frame.tiles && own.is_first {
            ranges[2u * tile] = first;
        }
        if tile < frame.tiles && own.is_last {
            ranges[2u * tile + 1u] = end;
        }
    }
    workgroupBarrier();
    for (var i = own.first + thread; i < own.end; i += WORKGROUP) {
        let splat = touch_splats[i];
        for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
            instance_splats[instance_index(own, i, firstTrailingBit(rest))] = splat;
        }
    }
}
