// Subgroups of the device, of 32 or 64 threads. The other choice of `BALLOTS` is `ballots_emulated.wgsl`.

@compute @workgroup_size(THREADS)
fn scatter(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_invocation_id) lane: u32,
    @builtin(subgroup_size) size: u32,
) {
    scatter_block(group_index(group, groups), thread, Team(subgroup, lane, size));
}

// The lanes of the subgroup for which a condition holds, a bit each.
fn ballot(condition: bool, thread: u32) -> vec2u {
    return subgroupBallot(condition).xy;
}

// The value of another lane.
fn from_lane(value: u32, lane: u32, thread: u32) -> u32 {
    return subgroupShuffle(value, lane);
}
