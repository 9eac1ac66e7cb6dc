// Stage bin, after its sort: where each macro tile's touches start and end. Macro tiles without any
// keep (0, 0).

#import constants
#import layout
#import math

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> job: Job;
@group(0) @binding(2) var<storage, read> macros: array<u32>;
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
    // Places that `bin` left over bear the number after the last macro tile.
    let own = macros[i];
    if own >= frame.macros {
        return;
    }
    if i == 0u || macros[i - 1u] != own {
        ranges[own].x = i;
    }
    if i + 1u == job.length || macros[i + 1u] != own {
        ranges[own].y = i + 1u;
    }
}
