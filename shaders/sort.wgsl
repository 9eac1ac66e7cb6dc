// Stage sort: one pass of a stable radix sort over 8 bits of the keys, from the least significant.
//
// `histogram` counts each block's digits, digit-major; their prefix sum says where each block's keys
// of each digit go; `scatter` puts them there, `scatter_masked` with two values each. Twin:
// `src/render/cpu/sort.rs`, which sorts by the same keys at once.

#import constants
#import layout
#import math

const ROUNDS: u32 = SORT_BLOCK / WORKGROUP;
const MASK_WORDS: u32 = WORKGROUP / 32;

override SHIFT: u32;

@group(0) @binding(0) var<storage, read> job: Job;
@group(0) @binding(1) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted_values: array<u32>;
@group(0) @binding(6) var<storage, read> masks: array<u32>;
@group(0) @binding(7) var<storage, read_write> sorted_masks: array<u32>;

var<workgroup> counts: array<atomic<u32>, DIGITS>;

@compute @workgroup_size(WORKGROUP)
fn histogram(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = group_index(group, groups);
    let block_count = blocks(job.length, SORT_BLOCK);
    if block >= block_count {
        return;
    }
    atomicStore(&counts[thread], 0u);
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS; round++) {
        let i = block * SORT_BLOCK + round * WORKGROUP + thread;
        if i < job.length {
            atomicAdd(&counts[digit(keys[i])], 1u);
        }
    }
    workgroupBarrier();
    offsets[thread * block_count + block] = atomicLoad(&counts[thread]);
}

// For each digit, a bit per thread that has it: bit `t % 32` of word `t / 32`, word-major.
var<workgroup> holders: array<atomic<u32>, DIGITS * MASK_WORDS>;
// For each digit, where its next key goes.
var<workgroup> next: array<u32, DIGITS>;

@compute @workgroup_size(WORKGROUP)
fn scatter(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = start_block(group_index(group, groups), thread);
    for (var at = block.x; at < block.y; at += WORKGROUP) {
        scatter_round(at, block.y, thread);
    }
}

// The same for keys with two values.
@compute @workgroup_size(WORKGROUP)
fn scatter_masked(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = start_block(group_index(group, groups), thread);
    for (var at = block.x; at < block.y; at += WORKGROUP) {
        let i = at + thread;
        let to = scatter_round(at, block.y, thread);
        if i < block.y {
            sorted_masks[to] = masks[i];
        }
    }
}

// A key and its value per thread; where they went.
fn scatter_round(at: u32, end: u32, thread: u32) -> u32 {
    let i = at + thread;
    let held = i < end;
    var key = 0u;
    if held {
        key = keys[i];
    }
    let to = place_of(key, held, thread);
    if held {
        sorted_keys[to] = key;
        sorted_values[to] = values[i];
    }
    return to;
}

// First key and end of a block; none for a group too many.
fn start_block(block: u32, thread: u32) -> vec2u {
    let block_count = blocks(job.length, SORT_BLOCK);
    if block >= block_count {
        return vec2u(0u);
    }
    next[thread] = offsets[thread * block_count + block];
    for (var word = 0u; word < MASK_WORDS; word++) {
        atomicStore(&holders[word * DIGITS + thread], 0u);
    }
    return vec2u(block * SORT_BLOCK, min((block + 1u) * SORT_BLOCK, job.length));
}

// Where a thread's key goes, if it holds one, round after round. A key's rank among the equal digits of
// its round is the number of holders before its thread: stable for subgroups of any size, whatever the
// order in which the bits were set. The last holder moves the digit's place on, and each clears the
// word that it set a bit of.
fn place_of(key: u32, held: bool, thread: u32) -> u32 {
    let own_word = thread / 32u;
    let own_bit = 1u << (thread % 32u);
    let own_digit = digit(key);
    workgroupBarrier();
    if held {
        atomicOr(&holders[own_word * DIGITS + own_digit], own_bit);
    }
    workgroupBarrier();
    var place = 0u;
    var is_last = false;
    if held {
        let beside = atomicLoad(&holders[own_word * DIGITS + own_digit]);
        place = next[own_digit] + countOneBits(beside & (own_bit - 1u));
        var after = beside & ~(own_bit | (own_bit - 1u));
        for (var word = 0u; word < MASK_WORDS; word++) {
            let others = atomicLoad(&holders[word * DIGITS + own_digit]);
            place += select(0u, countOneBits(others), word < own_word);
            after |= select(0u, others, word > own_word);
        }
        is_last = after == 0u;
    }
    workgroupBarrier();
    if held {
        atomicStore(&holders[own_word * DIGITS + own_digit], 0u);
        if is_last {
            next[own_digit] = place + 1u;
        }
    }
    return place;
}

fn digit(key: u32) -> u32 {
    return (key >> SHIFT) & (DIGITS - 1u);
}
