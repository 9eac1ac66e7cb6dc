// Gradients, after `rasterize_gradient.wgsl`: adds up the sums of each splat, from instances to touches (`touches`) and
// from touches to splats (`splats`), for one run of macro tiles after the other. The order is that of tiles within a
// macro tile, and of macro tiles, whatever thread adds, so the same input gives the same bytes.
//
// The touches of a macro tile are in order of depth, and so of the ranks of their splats. A splat finds its own by a
// binary search in each macro tile that its box reaches: nothing is sorted again.

#import constants
#import layout
#import math
#import macro_tile
#import touch_batch
#import splat_sums

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> macro_ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> touch_masks: array<u32>;
@group(0) @binding(3) var<storage, read> touch_splats: array<u32>;
@group(0) @binding(4) var<storage, read> first_batches: array<u32>;
@group(0) @binding(5) var<storage, read> offsets: array<u32>;
@group(0) @binding(6) var<uniform> run: MacroRun;
@group(0) @binding(8) var<storage, read> splats_job: Job;
@group(0) @binding(9) var<storage, read> splat_indices: array<u32>;
@group(0) @binding(10) var<storage, read> keys: array<u32>;
@group(0) @binding(11) var<storage, read> shapes: array<SplatShape>;
// Of each touch of the run, and then of each instance.
@group(0) @binding(12) var<storage, read_write> run_sums: array<SplatSums>;
// For each splat, its place in the order of depth.
@group(0) @binding(13) var<storage, read_write> ranks: array<u32>;
// For each touch of the run.
@group(0) @binding(14) var<storage, read_write> touch_ranks: array<u32>;
@group(0) @binding(15) var<storage, read_write> splat_sums: array<SplatSums>;

@compute @workgroup_size(WORKGROUP)
fn rank(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let rank = group_index(group, groups) * WORKGROUP + thread;
    if rank < splats_job.length {
        ranks[splat_indices[rank]] = rank;
    }
}

// One workgroup per batch of touches, as `list` of `expand.wgsl`, which gave each its instances.
@compute @workgroup_size(WORKGROUP)
fn touches(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= run.batches {
        return;
    }
    let own = batch(run.first_batch + index);
    transpose(own, thread);
    if thread < TILES {
        find_word_starts(offsets[own.offset + thread * own.stride], thread);
    }
    workgroupBarrier();
    for (var i = own.first + thread; i < own.end; i += WORKGROUP) {
        let at = i - run.first_touch;
        touch_ranks[at] = ranks[touch_splats[i]];
        var sums = SplatSums();
        if run.continues == 1u {
            sums = run_sums[at];
        }
        for (var rest = touch_masks[i] & run.tiles; rest != 0u; rest &= rest - 1u) {
            let instance = instance_index(own, i, firstTrailingBit(rest));
            sums = plus(sums, run_sums[run.touches + instance - run.first_instance]);
        }
        run_sums[at] = sums;
    }
}

@compute @workgroup_size(WORKGROUP)
fn splats(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let rank = group_index(group, groups) * WORKGROUP + thread;
    if rank >= splats_job.length {
        return;
    }
    let splat = splat_indices[rank];
    let view = frame.view[keys[rank] >> DEPTH_BITS];
    let shape = shapes[splat];
    // A pixel more on all sides: `bin.wgsl` may have rounded differently.
    let macro_px = vec2f(f32(MACRO_COLUMNS * TILE_PX), f32(MACRO_ROWS * TILE_PX));
    let grid = vec2u(view.macro_columns, div_ceil(view.size_px.y, TILE_PX * MACRO_ROWS));
    let most = vec2f(grid) - 1.0;
    let first = vec2u(clamp(floor((shape.mean_px - shape.extent_px - 1.0) / macro_px), vec2f(0.0), most));
    let last = vec2u(clamp(floor((shape.mean_px + shape.extent_px + 1.0) / macro_px), vec2f(0.0), most));
    var sums = splat_sums[splat];
    for (var row = first.y; row <= last.y; row++) {
        for (var column = first.x; column <= last.x; column++) {
            let macro_tile = view.first_macro_tile + row * grid.x + column;
            if macro_tile - run.first_macro_tile >= run.macro_tiles {
                continue;
            }
            let range = macro_ranges[macro_tile] - run.first_touch;
            let at = first_not_before(range, rank);
            if at < range.y && touch_ranks[at] == rank {
                sums = plus(sums, run_sums[at]);
            }
        }
    }
    splat_sums[splat] = sums;
}

// The first touch of a range whose splat has this rank or a later one.
fn first_not_before(range: vec2u, rank: u32) -> u32 {
    var low = range.x;
    var high = range.y;
    while low < high {
        let middle = (low + high) / 2u;
        if touch_ranks[middle] < rank {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}
