// Stage bin: for every splat, from the nearest, the tiles that its ellipse touches.
//
// `count` counts them; a prefix sum gives each splat its places; `emit` writes (tile, splat) there.
// Twin of `src/render/cpu/bin.rs`, where the test is documented.

#import constants
#import layout
#import math
#import prefix

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> job: Job;
@group(0) @binding(2) var<storage, read> instances_job: Job;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> places: array<u32>;
@group(0) @binding(5) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(6) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(7) var<storage, read_write> instance_tiles: array<u32>;
@group(0) @binding(8) var<storage, read_write> instance_places: array<u32>;

@compute @workgroup_size(WORKGROUP)
fn count(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let rank = group_index(group, groups) * WORKGROUP + thread;
    if rank >= job.length {
        return;
    }
    let reach = reach_of(rank);
    var tiles = 0u;
    for (var row = reach.first_row; row <= reach.last_row; row++) {
        tiles += columns_of(reach, row).count;
    }
    offsets[rank] = tiles;
}

// Threads whose splat the whole workgroup emits, in any order: places do not depend on it.
var<workgroup> big: array<u32, WORKGROUP>;
var<workgroup> big_count: atomic<u32>;
var<workgroup> big_total: u32;
var<workgroup> row_first_tile: array<u32, WORKGROUP>;

@compute @workgroup_size(WORKGROUP)
fn emit(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let first_rank = group_index(group, groups) * WORKGROUP;
    if thread == 0u {
        atomicStore(&big_count, 0u);
    }
    workgroupBarrier();
    let rank = first_rank + thread;
    if rank < job.length && instances_job.length > 0u {
        let places_of_rank = instance_span(rank);
        if places_of_rank.count > BIG_SPLAT_TILES {
            big[atomicAdd(&big_count, 1u)] = thread;
        } else {
            emit_alone(rank, places_of_rank);
        }
    }
    workgroupBarrier();
    if thread == 0u {
        big_total = atomicLoad(&big_count);
    }
    let total = workgroupUniformLoad(&big_total);
    for (var k = 0u; k < total; k++) {
        emit_together(first_rank + big[k], thread);
    }
}

// Where a rank's instances go. `offsets` has no element behind the last one.
fn instance_span(rank: u32) -> Span {
    let first = offsets[rank];
    var end = instances_job.length;
    if rank + 1u < job.length {
        end = offsets[rank + 1u];
    }
    return Span(first, end - first);
}

fn emit_alone(rank: u32, span: Span) {
    let reach = reach_of(rank);
    let place = places[rank];
    var at = span.first;
    let end = span.first + span.count;
    for (var row = reach.first_row; row <= reach.last_row; row++) {
        let columns = columns_of(reach, row);
        for (var i = 0u; i < columns.count && at < end; i++) {
            instance_tiles[at] = columns.first + i;
            instance_places[at] = place;
            at++;
        }
    }
    // Should the two pipelines round a row differently, what is left over belongs to no tile.
    for (; at < end; at++) {
        instance_tiles[at] = frame.tiles;
        instance_places[at] = place;
    }
}

// One row per thread finds its columns; then one instance per thread finds its row.
fn emit_together(rank: u32, thread: u32) {
    let span = instance_span(rank);
    let reach = reach_of(rank);
    let place = places[rank];
    let end = span.first + span.count;
    var at = span.first;
    for (var first_row = reach.first_row; first_row <= reach.last_row; first_row += i32(WORKGROUP)) {
        let row = first_row + i32(thread);
        var columns = Span(0u, 0u);
        if row <= reach.last_row {
            columns = columns_of(reach, row);
        }
        inclusive_prefix(thread, columns.count);
        row_first_tile[thread] = columns.first;
        workgroupBarrier();
        let count = prefix_sums[WORKGROUP - 1u];
        for (var i = thread; i < count && at + i < end; i += WORKGROUP) {
            let holder = first_above(i);
            instance_tiles[at + i] = row_first_tile[holder] + i - prefix_before(holder);
            instance_places[at + i] = place;
        }
        at += count;
        workgroupBarrier();
    }
    for (var i = at + thread; i < end; i += WORKGROUP) {
        instance_tiles[i] = frame.tiles;
        instance_places[i] = place;
    }
}

// The first thread whose inclusive prefix sum is above `i`.
fn first_above(i: u32) -> u32 {
    var low = 0u;
    var high = WORKGROUP - 1u;
    while low < high {
        let middle = (low + high) / 2u;
        if prefix_sums[middle] > i {
            high = middle;
        } else {
            low = middle + 1u;
        }
    }
    return low;
}

// A splat's box on its view's grid of tiles, and what its rows need.
struct Reach {
    shape: SplatShape,
    view: FrameView,
    first_row: i32,
    last_row: i32,
    // Pixels of the box.
    left: i32,
    right: i32,
    // Whether the box is one tile wide or high: then no row is narrower.
    thin: bool,
    power: f32,
    inverse_l0: f32,
    skew: f32,
    widest_dy: f32,
}

fn reach_of(rank: u32) -> Reach {
    var reach: Reach;
    reach.view = frame.view[keys[rank] >> DEPTH_BITS];
    reach.shape = shapes[places[rank]];
    let mean = reach.shape.mean_px;
    let extent = reach.shape.extent_px;
    let size_px = vec2i(reach.view.size_px);
    let columns = pixels(mean.x, -extent.x, extent.x, size_px.x);
    let rows = pixels(mean.y, -extent.y, extent.y, size_px.y);
    reach.left = columns.x;
    reach.right = columns.y;
    reach.first_row = rows.x / i32(TILE_PX);
    reach.last_row = rows.y / i32(TILE_PX);
    if columns.x > columns.y || rows.x > rows.y {
        reach.last_row = reach.first_row - 1;
    }
    reach.thin = reach.first_row == reach.last_row
        || columns.x / i32(TILE_PX) == columns.y / i32(TILE_PX);
    // Of an image that is drawn in bands, the rows of this one.
    reach.first_row = max(reach.first_row, i32(reach.view.rows.x));
    reach.last_row = min(reach.last_row, i32(reach.view.rows.y) - 1);
    let l = reach.shape.factor;
    reach.power = reach.shape.log2_opacity - frame.log2_alpha_cut;
    reach.inverse_l0 = 1.0 / l.x;
    reach.skew = -l.y * reach.inverse_l0;
    reach.widest_dy = reach.skew * reach.power / (l.z * l.z * extent.x);
    return reach;
}

// The tiles of one row that the ellipse touches: the first, and how many.
fn columns_of(reach: Reach, row: i32) -> Span {
    var columns = vec2i(reach.left, reach.right);
    if !reach.thin {
        let y = reach.shape.mean_px.y;
        let extent_y = reach.shape.extent_px.y;
        let tile = i32(TILE_PX);
        let top = max(f32(row * tile) + 0.5 - y, -extent_y);
        let bottom = max(min(f32(row * tile + tile - 1) + 0.5 - y, extent_y), top);
        let right_dy = clamp(reach.widest_dy, top, bottom);
        let left_dy = clamp(-reach.widest_dy, top, bottom);
        let high = reach.skew * right_dy + half_width(reach, right_dy) + EXTENT_SLACK_PX;
        let low = reach.skew * left_dy - half_width(reach, left_dy) - EXTENT_SLACK_PX;
        columns = pixels(reach.shape.mean_px.x, low, high, i32(reach.view.size_px.x));
        if columns.x > columns.y {
            return Span(0u, 0u);
        }
    }
    let first = u32(columns.x) / TILE_PX;
    let last = u32(columns.y) / TILE_PX;
    let row_start = reach.view.first_tile + u32(row) * reach.view.columns;
    return Span(row_start + first, last - first + 1u);
}

fn half_width(reach: Reach, dy: f32) -> f32 {
    let v = reach.shape.factor.z * dy;
    return sqrt(max(reach.power - v * v, 0.0)) * reach.inverse_l0;
}

// First and last pixel with its centre, at +0.5, between `center + low` and `center + high`, of
// `size`. Clamped before the conversion, which WGSL leaves open beyond the range of i32.
fn pixels(center: f32, low: f32, high: f32, size: i32) -> vec2i {
    let first = clamp(ceil(center + low - 0.5), 0.0, f32(size));
    let last = clamp(floor(center + high - 0.5), -1.0, f32(size - 1));
    return vec2i(i32(first), i32(last));
}
