// Exclusive prefix sum of `values` in place, by reduce-then-scan: three dispatches, so that no workgroup
// waits for another.
//
// `reduce` sums each block of 2,048 values, `sums` scans the sums of the blocks and appends the total,
// and `apply` scans within each block. Sums saturate, so an overflowing total is detected.

#import constants
#import layout
#import math
#import prefix

const PER_THREAD: u32 = SCAN_BLOCK / WORKGROUP;

@group(0) @binding(0) var<storage, read> job: Job;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> block_sums: array<u32>;

@compute @workgroup_size(WORKGROUP)
fn reduce(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = group_index(group, groups);
    if block >= div_ceil(job.length, SCAN_BLOCK) {
        return;
    }
    let first = block * SCAN_BLOCK + thread * PER_THREAD;
    var sum = 0u;
    for (var i = first; i < min(first + PER_THREAD, job.length); i++) {
        sum = saturating_add(sum, values[i]);
    }
    sum = inclusive_prefix(thread, sum);
    if thread == WORKGROUP - 1u {
        block_sums[block] = sum;
    }
}

@compute @workgroup_size(WORKGROUP)
fn sums(@builtin(local_invocation_index) thread: u32) {
    let count = div_ceil(job.length, SCAN_BLOCK);
    var before = 0u;
    for (var first = 0u; first < count; first += WORKGROUP) {
        let block = first + thread;
        var own = 0u;
        if block < count {
            own = block_sums[block];
        }
        inclusive_prefix(thread, own);
        if block < count {
            block_sums[block] = saturating_add(before, prefix_before(thread));
        }
        before = saturating_add(before, prefix_sums[WORKGROUP - 1u]);
    }
    if thread == 0u {
        block_sums[count] = before;
    }
}

@compute @workgroup_size(WORKGROUP)
fn apply(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = group_index(group, groups);
    if block >= div_ceil(job.length, SCAN_BLOCK) {
        return;
    }
    let first = block * SCAN_BLOCK + thread * PER_THREAD;
    let end = min(first + PER_THREAD, job.length);
    var sum = 0u;
    for (var i = first; i < end; i++) {
        sum = saturating_add(sum, values[i]);
    }
    inclusive_prefix(thread, sum);
    var before = saturating_add(block_sums[block], prefix_before(thread));
    for (var i = first; i < end; i++) {
        let value = values[i];
        values[i] = before;
        before = saturating_add(before, value);
    }
}
