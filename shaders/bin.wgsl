// Stage bin, first part: for every splat, in order of depth, lists the macro tiles that its ellipse
// touches, with one bit for each touched tile of the macro tile. Such a (splat, macro tile) pair is
// called a touch.
//
// `count` counts the touches of each splat, a prefix sum gives each splat the index of its first touch,
// and `emit` writes the touches. Twin of `src/render/cpu/bin`; `rows.rs` there documents
// the ellipse test.

#import constants
#import layout
#import math
#import prefix

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> job: Job;
@group(0) @binding(2) var<storage, read> touches_job: Job;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> splat_indices: array<u32>;
@group(0) @binding(5) var<storage, read> shapes: array<SplatShape>;
@group(0) @binding(6) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(7) var<storage, read_write> touch_macro_tiles: array<u32>;
@group(0) @binding(8) var<storage, read_write> touch_splats: array<u32>;
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
    let reach = read_reach(rank);
    let macro_rows = reached_macro_rows(reach);
    var count = 0u;
    for (var row = macro_rows.x; row <= macro_rows.y; row++) {
        count += band_in_row(reach, row).count;
    }
    offsets[rank] = count;
}

// Threads whose splat the whole workgroup emits. Their order is arbitrary; where touches are written does
// not depend on it.
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
        if span.count > LARGE_SPLAT_MACRO_TILES {
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

// Range of the touches of the splat with this rank (its position in depth order). `offsets` has no
// element after the last rank.
fn touch_span(rank: u32) -> Span {
    let first = offsets[rank];
    var end = touches_job.length;
    if rank + 1u < job.length {
        end = offsets[rank + 1u];
    }
    return Span(first, end - first);
}

// Emits the touches of one splat by one thread.
fn emit_alone(rank: u32, span: Span) {
    let reach = read_reach(rank);
    let macro_rows = reached_macro_rows(reach);
    let splat = splat_indices[rank];
    var at = span.first;
    let end = span.first + span.count;
    for (var row = macro_rows.x; row <= macro_rows.y; row++) {
        let band = band_in_row(reach, row);
        for (var i = 0u; i < band.count && at < end; i++) {
            write_touch(at, band, i, splat);
            at++;
        }
    }
    // `count` and `emit` are two pipelines, and a compiler may round a row differently in each. Touches
    // that `count` counted and this one does not find are assigned to no macro tile.
    for (; at < end; at++) {
        write_nothing(at, splat);
    }
}

// Emits the touches of one splat by the whole workgroup: first each thread computes the columns of one
// row of macro tiles, then each thread writes touches and finds the row of each by binary search.
fn emit_together(rank: u32, thread: u32) {
    let span = touch_span(rank);
    let reach = read_reach(rank);
    let macro_rows = reached_macro_rows(reach);
    let splat = splat_indices[rank];
    let end = span.first + span.count;
    var at = span.first;
    for (var first_row = macro_rows.x; first_row <= macro_rows.y; first_row += i32(WORKGROUP)) {
        let row = first_row + i32(thread);
        var band: Band;
        if row <= macro_rows.y {
            band = band_in_row(reach, row);
        }
        inclusive_prefix(thread, band.count);
        bands[thread] = band;
        workgroupBarrier();
        let count = prefix_sums[WORKGROUP - 1u];
        for (var i = thread; i < count && at + i < end; i += WORKGROUP) {
            let band_index = first_above(i);
            write_touch(at + i, bands[band_index], i - prefix_before(band_index), splat);
        }
        at += count;
        workgroupBarrier();
    }
    for (var i = at + thread; i < end; i += WORKGROUP) {
        write_nothing(i, splat);
    }
}

// Writes the touch of macro tile `i` of a band.
fn write_touch(at: u32, band: Band, i: u32, splat: u32) {
    touch_macro_tiles[at] = band.first_macro_tile + i;
    touch_splats[at] = splat;
    let left = band.left + i * MACRO_COLUMNS;
    var mask = 0u;
    for (var k = 0u; k < MACRO_ROWS; k++) {
        mask |= row_mask(band.rows[k], left) << (k * MACRO_COLUMNS);
    }
    touch_masks[at] = mask;
}

// Writes a touch of no tile; `ranges.wgsl` skips it.
fn write_nothing(at: u32, splat: u32) {
    touch_macro_tiles[at] = frame.macro_tiles;
    touch_splats[at] = splat;
    touch_masks[at] = 0u;
}

// Bits of the eight columns from `left` on, set where a row of a band touches the column's tile.
fn row_mask(columns: u32, left: u32) -> u32 {
    let first = max(columns & 0xFFFFu, left);
    let end = min(columns >> 16u, left + MACRO_COLUMNS);
    return select(0u, (1u << (end - left)) - (1u << (first - left)), first < end);
}

// First thread whose inclusive prefix sum is greater than `i`.
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

// Tiles of one row of macro tiles that a splat touches. For an ellipse so flat that the columns of
// neighbouring rows do not overlap, macro tiles between them may have no touched tile.
struct Band {
    // Columns of tiles of each row: the first in the low 16 bits, the end (exclusive) in the high 16.
    rows: array<u32, MACRO_ROWS>,
    // First column of tiles of the first macro tile.
    left: u32,
    first_macro_tile: u32,
    count: u32,
}

fn band_in_row(reach: Reach, macro_row: i32) -> Band {
    var band: Band;
    var first = reach.view.columns;
    var end = 0u;
    for (var k = 0; k < i32(MACRO_ROWS); k++) {
        let row = macro_row * i32(MACRO_ROWS) + k;
        if row >= reach.first_row && row <= reach.last_row {
            let columns = columns_in_row(reach, row);
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
        band.first_macro_tile =
            reach.view.first_macro_tile + u32(macro_row) * reach.view.macro_columns + first_column;
        band.count = (end - 1u) / MACRO_COLUMNS - first_column + 1u;
    }
    return band;
}

// First and last row of macro tiles that a splat's box covers; (0, -1) if it covers none.
fn reached_macro_rows(reach: Reach) -> vec2i {
    if reach.first_row > reach.last_row {
        return vec2i(0, -1);
    }
    return vec2i(reach.first_row, reach.last_row) / i32(MACRO_ROWS);
}

// A splat's box on its view's grid of tiles, and the terms that the ellipse test of each row needs.
struct Reach {
    shape: SplatShape,
    view: FrameView,
    first_row: i32,
    last_row: i32,
    // First and last column of pixels of the box.
    left: i32,
    right: i32,
    // Whether the box is one tile wide or high. Then every row has the box's columns.
    thin: bool,
    // log2(peak opacity / alpha_cut): the exponent that may be lost before alpha falls below the cut.
    power: f32,
    inverse_l0: f32,
    // Shift of the row's middle per pixel of dy: -l1 / l0.
    skew: f32,
    // dy at which the ellipse reaches farthest to the right; it reaches farthest to the left at -widest_dy.
    widest_dy: f32,
}

fn read_reach(rank: u32) -> Reach {
    var reach: Reach;
    reach.view = frame.view[keys[rank] >> DEPTH_BITS];
    reach.shape = shapes[splat_indices[rank]];
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
    // Of a frame that is drawn region by region, only the rows of this region.
    reach.first_row = max(reach.first_row, i32(reach.view.rows.x));
    reach.last_row = min(reach.last_row, i32(reach.view.rows.y) - 1);
    let l = reach.shape.factor;
    reach.power = reach.shape.log2_opacity - frame.log2_alpha_cut;
    reach.inverse_l0 = 1.0 / l.x;
    reach.skew = -l.y * reach.inverse_l0;
    reach.widest_dy = reach.skew * reach.power / (l.z * l.z * extent.x);
    return reach;
}

// Columns of the tiles of one row that the ellipse touches: first, and end (exclusive).
fn columns_in_row(reach: Reach, row: i32) -> vec2u {
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

// Half-width of the ellipse in pixels at a vertical distance from its centre.
fn half_width(reach: Reach, dy: f32) -> f32 {
    let v = reach.shape.factor.z * dy;
    return sqrt(max(reach.power - v * v, 0.0)) * reach.inverse_l0;
}

// First and last of `size` pixels whose centre, at +0.5, lies between `center + low` and
// `center + high`. The values are clamped before the conversion, since WGSL does not define conversions
// of values outside of i32's range.
fn pixels(center: f32, low: f32, high: f32, size: i32) -> vec2i {
    let first = clamp(ceil(center + low - 0.5), 0.0, f32(size));
    let last = clamp(floor(center + high - 0.5), -1.0, f32(size - 1));
    return vec2i(i32(first), i32(last));
}
