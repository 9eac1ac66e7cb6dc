// Subgroups of 32 threads in workgroup memory: tests run `sort_ballots.wgsl` with them on devices without subgroups.

const LANES: u32 = 32;

var<workgroup> votes: array<atomic<u32>, THREADS / LANES>;
var<workgroup> values_of_threads: array<u32, THREADS>;

@compute @workgroup_size(THREADS)
fn scatter(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let team = Team(thread / LANES, thread % LANES, LANES);
    scatter_block(group_index(group, groups), thread, team);
}

fn ballot(condition: bool, thread: u32) -> vec2u {
    workgroupBarrier();
    if thread % LANES == 0u {
        atomicStore(&votes[thread / LANES], 0u);
    }
    workgroupBarrier();
    if condition {
        atomicOr(&votes[thread / LANES], 1u << (thread % LANES));
    }
    workgroupBarrier();
    return vec2u(atomicLoad(&votes[thread / LANES]), 0u);
}

fn from_lane(value: u32, lane: u32, thread: u32) -> u32 {
    workgroupBarrier();
    values_of_threads[thread] = value;
    workgroupBarrier();
    return values_of_threads[thread / LANES * LANES + lane];
}
