// How much the next stages have to do, decided on the device: nothing is read back in mid-frame.
//
// A total that exceeds its buffers leaves nothing to do; the host sees it in the counters after the
// frame, makes larger buffers, and draws the frame again.

#import constants
#import layout
#import math

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read_write> jobs: array<JobSlot, JOB_COUNT>;
@group(0) @binding(2) var<storage, read> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> counters: Counters;

// Slots of `jobs`.
const ITEMS: u32 = 0;
const SPLATS: u32 = 1;
const SPLATS_SCAN: u32 = 2;
const SPLATS_SORT: u32 = 3;
const SPLATS_DIGITS: u32 = 4;
const TOUCHES: u32 = 5;
const TOUCHES_SORT: u32 = 6;
const TOUCHES_DIGITS: u32 = 7;
const TILES: u32 = 8;
const INSTANCES: u32 = 9;
const JOB_COUNT: u32 = 10;

// After the visible splats of all items were counted.
@compute @workgroup_size(1)
fn splats() {
    let total = block_sums[blocks(jobs[ITEMS].job.length, SCAN_BLOCK)];
    counters.splats = total;
    let length = select(0u, total, total <= frame.splat_capacity);
    jobs[SPLATS].job = job(length, WORKGROUP);
    jobs[SPLATS_SCAN].job = job(length, SCAN_BLOCK);
    jobs[SPLATS_SORT].job = job(length, SORT_BLOCK);
    jobs[SPLATS_DIGITS].job = job(DIGITS * blocks(length, SORT_BLOCK), SCAN_BLOCK);
}

// After the macro tiles of all splats were counted.
@compute @workgroup_size(1)
fn touches() {
    let total = block_sums[blocks(jobs[SPLATS].job.length, SCAN_BLOCK)];
    counters.touches = total;
    let length = select(0u, total, total <= frame.touch_capacity);
    jobs[TOUCHES].job = job(length, WORKGROUP);
    jobs[TOUCHES_SORT].job = job(length, SORT_BLOCK);
    jobs[TOUCHES_DIGITS].job = job(DIGITS * blocks(length, SORT_BLOCK), SCAN_BLOCK);
}

// After the splats of all tiles were counted.
@compute @workgroup_size(1)
fn instances() {
    let total = block_sums[blocks(jobs[TILES].job.length, SCAN_BLOCK)];
    counters.instances = total;
    jobs[INSTANCES].job = job(select(0u, total, total <= frame.instance_capacity), WORKGROUP);
}

fn job(length: u32, per_group: u32) -> Job {
    let groups = blocks(length, per_group);
    let rows = max(blocks(groups, MAX_GROUPS), 1u);
    return Job(length, array(blocks(groups, rows), rows, 1u));
}
