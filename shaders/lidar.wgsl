// LiDAR sweeps: what the beams of a sector hit. The host lists the Gaussians that each tile of 16 x 16 beams may meet,
// its candidates, almost from the nearest. Twin of `src/render/cpu/lidar/tile.rs`.
//
// `trace`: a workgroup per tile, a thread per beam. A beam keeps its hits up to its return, in order of range.
// `finish`: a thread per beam, after the last candidates of a sector. It writes the returns.

#import constants
#import math

struct Sector {
    // Rows of the LiDAR, and columns of the sector.
    rows: u32,
    width: u32,
    // Columns of the LiDAR, and the sector's first one.
    columns: u32,
    first_column: u32,
    // Entries of each list that are compared: how many were before them, and how many they are.
    first_entry: u32,
    entries: u32,
    // Most hits that a beam keeps.
    most_hits: u32,
    // 1 if nothing was compared with its beams before.
    is_first: u32,
    // Nothing returns up to the first range or beyond the second.
    min_range_m: f32,
    max_range_m: f32,
    alpha_cap: f32,
    padding: u32,
}

// Relative to the LiDAR's place when the middle column is fired, in the axes of the candidate's body.
struct Candidate {
    mean_m: vec3f,
    log2_opacity: f32,
    // Rows of the matrix that takes metres to standard deviations.
    whiten_x: vec3f,
    // Squared standard deviations from the mean at which alpha falls below the cut.
    reach2: f32,
    whiten_y: vec3f,
    // No beam meets it nearer than this.
    nearest_m: f32,
    whiten_z: vec3f,
    luminance: f32,
    // First row that may meet it, and in the high half the end of these rows.
    rows: u32,
    // Its place among all Gaussians of the scene.
    key: u32,
    padding: vec2u,
}

// Where a column is fired, and the LiDAR's axes then.
struct Column {
    forward: vec3f,
    // Cosine and sine of its azimuth in the first row.
    cos_azimuth: f32,
    left: vec3f,
    sin_azimuth: f32,
    up: vec3f,
    padding: f32,
    origin_m: vec3f,
    padding_too: f32,
}

struct Hit {
    range_m: f32,
    alpha: f32,
    luminance: f32,
    key: u32,
}

struct Beam {
    hits: u32,
    // What all of them leave of its light.
    light: f32,
    // How far it is followed: to its return, or the LiDAR's range.
    end_m: f32,
}

struct Return {
    range_m: f32,
    luminance: f32,
    key: u32,
}

@group(0) @binding(0) var<uniform> sector: Sector;
@group(0) @binding(1) var<storage, read> candidates: array<Candidate>;
// For each tile, the place of its first entry; then the number of all.
@group(0) @binding(2) var<storage, read> lists: array<u32>;
@group(0) @binding(3) var<storage, read> entries: array<u32>;
@group(0) @binding(4) var<storage, read> columns: array<Column>;
// Cosine and sine of the elevation, then of the offset of the azimuth.
@group(0) @binding(5) var<storage, read> rows: array<vec4f>;
// The n-th hit of every beam of the sector, then the next.
@group(0) @binding(6) var<storage, read_write> hits: array<Hit>;
@group(0) @binding(7) var<storage, read_write> beams: array<Beam>;
// Of the whole sweep.
@group(0) @binding(8) var<storage, read_write> returns: array<Return>;

const HALF: f32 = 0.5;
const HALF_LOG2_E: f32 = 0.7213475204;

// Candidates that a tile loads at a time. It compares them unless all of its beams have returned in front of all of them.
const LOADED: u32 = 32;

var<workgroup> loaded: array<Candidate, LOADED>;

// The bits of the farthest end of the tile's beams, and of the nearest distance of what is loaded, in metres: those of
// positive numbers have their order.
var<workgroup> farthest_bits: atomic<u32>;
var<workgroup> nearest_bits: atomic<u32>;
var<workgroup> is_behind: u32;

@compute @workgroup_size(WORKGROUP)
fn trace(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let tiles = div_ceil(sector.width, TILE_PX);
    let tile = group_index(group, groups);
    if tile >= tiles * div_ceil(sector.rows, TILE_PX) {
        return;
    }
    let row = tile / tiles * TILE_PX + thread / TILE_PX;
    let column = tile % tiles * TILE_PX + thread % TILE_PX;
    // Threads beyond the last row or column do as that one, and see nothing.
    let exists = row < sector.rows && column < sector.width;
    let own_row = min(row, sector.rows - 1u);
    let own_column = min(column, sector.width - 1u);
    let beam = own_row * sector.width + own_column;
    let origin_m = columns[own_column].origin_m;
    let direction = beam_direction(own_row, own_column);
    var seen = Beam(0u, 1.0, 0.0);
    if exists {
        seen = beams[beam];
        if sector.is_first == 1u {
            seen = Beam(0u, 1.0, sector.max_range_m);
        }
    }
    let first = lists[tile] + sector.first_entry;
    let end = min(lists[tile + 1u], first + sector.entries);
    for (var at = first; at < end; at += LOADED) {
        let count = min(end - at, LOADED);
        if thread < count {
            loaded[thread] = candidates[entries[at + thread]];
        }
        if thread == 0u {
            atomicStore(&farthest_bits, 0u);
            atomicStore(&nearest_bits, 0xFFFFFFFFu);
        }
        workgroupBarrier();
        atomicMax(&farthest_bits, bitcast<u32>(seen.end_m));
        if thread < count {
            atomicMin(&nearest_bits, bitcast<u32>(max(loaded[thread].nearest_m, 0.0)));
        }
        workgroupBarrier();
        if thread == 0u {
            is_behind = u32(atomicLoad(&nearest_bits) > atomicLoad(&farthest_bits));
        }
        if workgroupUniformLoad(&is_behind) == 0u {
            for (var i = 0u; i < count; i++) {
                seen = compare(i, row, beam, origin_m, direction, seen);
            }
        }
        workgroupBarrier();
    }
    if exists {
        beams[beam] = seen;
    }
}

// Where the beam goes, in the axes of the candidates' body.
fn beam_direction(row: u32, column: u32) -> vec3f {
    let angles = rows[row];
    let at = columns[column];
    let cosine = at.cos_azimuth * angles.z - at.sin_azimuth * angles.w;
    let sine = at.sin_azimuth * angles.z + at.cos_azimuth * angles.w;
    return angles.x * (cosine * at.forward + sine * at.left) + angles.y * at.up;
}

// The beam after it was compared with a candidate that is loaded.
fn compare(i: u32, row: u32, beam: u32, origin_m: vec3f, direction: vec3f, seen: Beam) -> Beam {
    let rows_of = loaded[i].rows;
    let is_in_reach = row >= (rows_of & 0xFFFFu) && row < (rows_of >> 16u) && loaded[i].nearest_m <= seen.end_m;
    if !is_in_reach {
        return seen;
    }
    let candidate = loaded[i];
    let to_mean_m = candidate.mean_m - origin_m;
    let to_mean = vec3f(dot(candidate.whiten_x, to_mean_m), dot(candidate.whiten_y, to_mean_m), dot(candidate.whiten_z, to_mean_m));
    let step = vec3f(dot(candidate.whiten_x, direction), dot(candidate.whiten_y, direction), dot(candidate.whiten_z, direction));
    let step2 = dot(step, step);
    // The distance of a line from a point: it loses no digits to a Gaussian that is flat, unlike a difference of two
    // long vectors.
    let aside = cross(to_mean, step);
    let aside2 = dot(aside, aside);
    let range_m = dot(to_mean, step) / step2;
    let meets = aside2 <= candidate.reach2 * step2 && range_m > sector.min_range_m && range_m <= seen.end_m;
    if !meets {
        return seen;
    }
    let peak = exp2(candidate.log2_opacity - HALF_LOG2_E * (aside2 / step2));
    let alpha = min(peak, sector.alpha_cap);
    return insert(Hit(range_m, alpha, candidate.luminance, candidate.key), beam, seen);
}

fn place(beam: u32, hit: u32) -> u32 {
    return hit * sector.rows * sector.width + beam;
}

fn is_before(a: Hit, b: Hit) -> bool {
    return a.range_m < b.range_m || (a.range_m == b.range_m && a.key < b.key);
}

// Adds a hit of a beam, and drops those behind its return.
fn insert(hit: Hit, beam: u32, seen: Beam) -> Beam {
    if seen.hits == sector.most_hits && !is_before(hit, hits[place(beam, seen.hits - 1u)]) {
        return seen;
    }
    var at = min(seen.hits, sector.most_hits - 1u);
    while at > 0u {
        let before = hits[place(beam, at - 1u)];
        if !is_before(hit, before) {
            break;
        }
        hits[place(beam, at)] = before;
        at -= 1u;
    }
    hits[place(beam, at)] = hit;
    let count = min(seen.hits + 1u, sector.most_hits);
    let light = seen.light * (1.0 - hit.alpha);
    if light > HALF {
        return Beam(count, light, seen.end_m);
    }
    var transmittance = 1.0;
    for (var i = 0u; i < count; i++) {
        let passed = hits[place(beam, i)];
        transmittance *= 1.0 - passed.alpha;
        if transmittance <= HALF {
            return Beam(i + 1u, transmittance, passed.range_m);
        }
    }
    return Beam(count, transmittance, seen.end_m);
}

@compute @workgroup_size(WORKGROUP)
fn finish(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let beam = group_index(group, groups) * WORKGROUP + thread;
    if beam >= sector.rows * sector.width {
        return;
    }
    var found = Return();
    var transmittance = 1.0;
    var luminance = 0.0;
    let count = beams[beam].hits;
    for (var i = 0u; i < count; i++) {
        let hit = hits[place(beam, i)];
        luminance += transmittance * hit.alpha * hit.luminance;
        transmittance *= 1.0 - hit.alpha;
        if transmittance <= HALF {
            found = Return(hit.range_m, luminance / (1.0 - transmittance), hit.key);
            break;
        }
    }
    let column = sector.first_column + beam % sector.width;
    returns[beam / sector.width * sector.columns + column] = found;
}
