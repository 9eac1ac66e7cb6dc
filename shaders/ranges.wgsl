// Stage bin, after the sort of touches by macro tile: finds where each macro tile's touches start and
// end. The host clears the ranges first, so a macro tile without touches keeps (0, 0).

#import constants
#import layout
#import math

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> job: Job;
@group(0) @binding(2) var<storage, read> touch_macro_tiles: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<u32>;

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
    // Touches of no tile have the index after the last macro tile; see `write_nothing` in `bin.wgsl`.
    let own = touch_macro_tiles[i];
    if own >= frame.macro_tiles {
        return;
    }
    if i == 0u || touch_macro_tiles[i - 1u] != own {
        ranges[2u * own] = i;
    }
    if i + 1u == job.length || touch_macro_tiles[i + 1u] != own {
        ranges[2u * own + 1u] = i + 1u;
    }
}
