// Stage bin: for every splat, from the nearest, the macro tiles that its ellipse touches, and which of
// their tiles.
//
// `count` counts them; a prefix sum gives each splat its places; `emit` writes (macro tile, splat, bit
// per tile) there. Twin of `src/render/cpu/bin.rs`, where the test is documented.

#import constants
#import layout
#import math
#import prefix

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> job: Job;
@group(0) @binding(2) var<storage, read> touches_job: Job;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> places: array<u32>;
@group(0) @binding(5) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(6) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(7) var<storage, read_write> touch_macros: array<u32>;
@group(0) @binding(8) var<storage, read_write> touch_places: array<u32>;
@group(0) @binding(9) var<storage, read_write> touch_masks: array<u32>;

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
    let macro_rows = macro_rows_of(reach);
    var macros = 0u;
    for (var row = macro_rows.x; row <= macro_rows.y; row++) {
        macros += band_of(reach, row).count;
    }
    offsets[rank] = macros;
}

// Threads whose splat the whole workgroup emits, in any order: places do not depend on it.
var<workgroup> big: array<u32, WORKGROUP>;
var<workgroup> big_count: atomic<u32>;
var<workgroup> big_total: u32;
var<workgroup> bands: array<Band, WORKGROUP>;

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
    if rank < job.length && touches_job.length > 0u {
        let span = touch_span(rank);
        if span.count > BIG_SPLAT_MACROS {
            big[atomicAdd(&big_count, 1u)] = thread;
        } else {
            emit_alone(rank, span);
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

// Where a rank's touches go. `offsets` has no element behind the last one.
fn touch_span(rank: u32) -> Span {
    let first = offsets[rank];
    var end = touches_job.length;
    if rank + 1u < job.length {
        end = offsets[rank + 1u];
    }
    return Span(first, end - first);
}

fn emit_alone(rank: u32, span: Span) {
    let reach = reach_of(rank);
    let macro_rows = macro_rows_of(reach);
    let place = places[rank];
    var at = span.first;
    let end = span.first + span.count;
    for (var row = macro_rows.x; row <= macro_rows.y; row++) {
        let band = band_of(reach, row);
        for (var i = 0u; i < band.count && at < end; i++) {
            write_touch(at, band, i, place);
            at++;
        }
    }
    // Should the two pipelines round a row differently, what is left over belongs to no macro tile.
    for (; at < end; at++) {
        write_nothing(at, place);
    }
}

// One row of macro tiles per thread finds its columns; then one touch per thread finds its row.
fn emit_together(rank: u32, thread: u32) {
    let span = touch_span(rank);
    let reach = reach_of(rank);
    let macro_rows = macro_rows_of(reach);
    let place = places[rank];
    let end = span.first + span.count;
    var at = span.first;
    for (var first_row = macro_rows.x; first_row <= macro_rows.y; first_row += i32(WORKGROUP)) {
        let row = first_row + i32(thread);
        var band: Band;
        if row <= macro_rows.y {
            band = band_of(reach, row);
        }
        inclusive_prefix(thread, band.count);
        bands[thread] = band;
        workgroupBarrier();
        let count = prefix_sums[WORKGROUP - 1u];
        for (var i = thread; i < count && at + i < end; i += WORKGROUP) {
            let holder = first_above(i);
            write_touch(at + i, bands[holder], i - prefix_before(holder), place);
        }
        at += count;
        workgroupBarrier();
    }
    for (var i = at + thread; i < end; i += WORKGROUP) {
        write_nothing(i, place);
    }
}

// Macro tile `i` of a band.
fn write_touch(at: u32, band: Band, i: u32, place: u32) {
    touch_macros[at] = band.first_macro + i;
    touch_places[at] = place;
    let left = band.left + i * MACRO_COLUMNS;
    var mask = 0u;
    for (var k = 0u; k < MACRO_ROWS; k++) {
        mask |= row_mask(band.rows[k], left) << (k * MACRO_COLUMNS);
    }
    touch_masks[at] = mask;
}

fn write_nothing(at: u32, place: u32) {
    touch_macros[at] = frame.macros;
    touch_places[at] = place;
    touch_masks[at] = 0u;
}

// A bit for each column from `left` on that a row of a band has.
fn row_mask(columns: u32, left: u32) -> u32 {
    let first = max(columns & 0xFFFFu, left);
    let end = min(columns >> 16u, left + MACRO_COLUMNS);
    return select(0u, (1u << (end - left)) - (1u << (first - left)), first < end);
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

// What a splat touches of a row of macro tiles. An ellipse so flat that rows miss each other may have
// macro tiles between them of which it touches nothing.
struct Band {
    // Columns of tiles, row by row: the first in the low half of a word, the end in the high half.
    rows: array<u32, MACRO_ROWS>,
    // Column of tiles where the first macro tile begins.
    left: u32,
    first_macro: u32,
    count: u32,
}

fn band_of(reach: Reach, macro_row: i32) -> Band {
    var band: Band;
    var first = reach.view.columns;
    var end = 0u;
    for (var k = 0; k < i32(MACRO_ROWS); k++) {
        let row = macro_row * i32(MACRO_ROWS) + k;
        if row >= reach.first_row && row <= reach.last_row {
            let columns = columns_of(reach, row);
            if columns.x < columns.y {
                first = min(first, columns.x);
                end = max(end, columns.y);
                band.rows[k] = columns.x | (columns.y << 16u);
            }
        }
    }
    if first < end {
        let first_column = first / MACRO_COLUMNS;
        band.left = first_column * MACRO_COLUMNS;
        band.first_macro =
            reach.view.first_macro + u32(macro_row) * reach.view.macro_columns + first_column;
        band.count = (end - 1u) / MACRO_COLUMNS - first_column + 1u;
    }
    return band;
}

// First and last row of macro tiles.
fn macro_rows_of(reach: Reach) -> vec2i {
    if reach.first_row > reach.last_row {
        return vec2i(0, -1);
    }
    return vec2i(reach.first_row, reach.last_row) / i32(MACRO_ROWS);
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

// The tiles of one row that the ellipse touches: the first column, and the one after the last.
fn columns_of(reach: Reach, row: i32) -> vec2u {
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
            return vec2u(0u);
        }
    }
    return vec2u(u32(columns.x) / TILE_PX, u32(columns.y) / TILE_PX + 1u);
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
