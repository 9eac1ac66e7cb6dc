// Stage rasterize, first part: finds the tiles with long lists, which `rasterize_long.wgsl` blends. Their order is
// arbitrary; no pixel depends on it.

#import constants
#import layout
#import math

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read_write> job: LongJob;
@group(0) @binding(2) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read_write> long_tiles: array<u32>;
@group(0) @binding(4) var<storage, read_write> long_places: array<u32>;

// A `Job` whose numbers the threads change.
struct LongJob {
    length: atomic<u32>,
    columns: atomic<u32>,
    rows: u32,
    layers: u32,
}

@compute @workgroup_size(WORKGROUP)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_index(group, groups) * WORKGROUP + thread;
    if tile >= frame.tiles {
        return;
    }
    let range = ranges[tile];
    var place = 0u;
    if range.y - range.x > frame.long_tile_splats {
        let index = atomicAdd(&job.length, 1u);
        // Beyond the room that there is, tiles are blended as those with short lists.
        if index < frame.long_tiles {
            long_tiles[index] = tile;
            atomicMax(&job.columns, index + 1u);
            place = index + 1u;
        }
    }
    long_places[tile] = place;
}
