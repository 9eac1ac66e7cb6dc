// Computes on the device how many workgroups the next stages need (for indirect dispatches), so that
// nothing is read back in the middle of a frame.
//
// If a total exceeds its buffers, the job is set to zero elements and the rest of the frame does
// nothing. The host sees the total in the counters after the frame, allocates larger buffers, and draws
// the frame again.

#import constants
#import layout
#import math

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read_write> jobs: array<JobSlot, JOB_COUNT>;
@group(0) @binding(2) var<storage, read> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> counters: Counters;

// Slots of `jobs`; `src/render/gpu/plan.rs` has the same numbers.
const CLUSTER_VIEWS: u32 = 0;
const SPLATS: u32 = 1;
const SPLATS_SCAN: u32 = 2;
const SPLATS_SORT: u32 = 3;
const SPLATS_DIGITS: u32 = 4;
const TOUCHES: u32 = 5;
const TOUCHES_SORT: u32 = 6;
const TOUCHES_DIGITS: u32 = 7;
const MACRO_TILES: u32 = 8;
const BATCHES: u32 = 9;
const BATCH_TILES: u32 = 10;
const INSTANCES: u32 = 11;
const LONG_TILES: u32 = 12;
const JOB_COUNT: u32 = 13;

// Runs after the prefix sum over the visible splats of all cluster views.
@compute @workgroup_size(1)
fn splats() {
    let total = block_sums[div_ceil(jobs[CLUSTER_VIEWS].job.length, SCAN_BLOCK)];
    counters.splats = total;
    let length = select(0u, total, total <= frame.splat_capacity);
    jobs[SPLATS].job = job(length, WORKGROUP);
    jobs[SPLATS_SCAN].job = job(length, SCAN_BLOCK);
    jobs[SPLATS_SORT].job = job(length, SORT_BLOCK);
    jobs[SPLATS_DIGITS].job = job(DIGITS * div_ceil(length, SORT_BLOCK), SCAN_BLOCK);
}

// Runs after the prefix sum over the touches of all splats.
@compute @workgroup_size(1)
fn touches() {
    let total = block_sums[div_ceil(jobs[SPLATS].job.length, SCAN_BLOCK)];
    counters.touches = total;
    let length = select(0u, total, total <= frame.touch_capacity);
    jobs[TOUCHES].job = job(length, WORKGROUP);
    jobs[TOUCHES_SORT].job = job(length, SORT_BLOCK);
    jobs[TOUCHES_DIGITS].job = job(DIGITS * div_ceil(length, SORT_BLOCK), SCAN_BLOCK);
}

// Runs after the prefix sum over the batches of all macro tiles. `Bin::reserve` makes room for the most
// batches that the touches can have.
@compute @workgroup_size(1)
fn batches() {
    let total = block_sums[div_ceil(jobs[MACRO_TILES].job.length, SCAN_BLOCK)];
    jobs[BATCHES].job = job(total, 1u);
    jobs[BATCH_TILES].job = job(MACRO_COLUMNS * MACRO_ROWS * total, SCAN_BLOCK);
}

// Runs after the prefix sum over the instances of all tiles in all batches.
@compute @workgroup_size(1)
fn instances() {
    let total = block_sums[div_ceil(jobs[BATCH_TILES].job.length, SCAN_BLOCK)];
    counters.instances = total;
    jobs[INSTANCES].job = job(select(0u, total, total <= frame.instance_capacity), WORKGROUP);
}

// A job of `length` elements, `per_group` in a workgroup. Workgroups are folded into rows of at most
// 65,535, of about equal length.
fn job(length: u32, per_group: u32) -> Job {
    let groups = div_ceil(length, per_group);
    let rows = max(div_ceil(groups, MAX_GROUPS), 1u);
    return Job(length, array(div_ceil(groups, rows), rows, 1u));
}
