// Stage ranges: where each tile's instances start and end. Tiles without any keep (0, 0).

#import constants
#import layout
#import math

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> job: Job;
@group(0) @binding(2) var<storage, read> tiles: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<vec2u>;

@compute @workgroup_size(WORKGROUP)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group, groups) * WORKGROUP + thread;
    if i >= job.length {
        return;
    }
    // Places that `bin` left over bear the number after the last tile.
    let tile = tiles[i];
    if tile >= frame.tiles {
        return;
    }
    if i == 0u || tiles[i - 1u] != tile {
        ranges[tile].x = i;
    }
    if i + 1u == job.length || tiles[i + 1u] != tile {
        ranges[tile].y = i + 1u;
    }
}
