// Stage sort: one pass of a stable LSD radix sort, 8 bits of the keys per pass.
//
// `histogram` counts the digits of each block (digit-major), a prefix sum over the counts gives the
// first index of each block's keys of each digit, and `scatter` moves keys and values there.
// `scatter_masked` does the same with two values per key. Twin: `src/render/cpu/sort.rs`, which sorts by
// the same keys in one call.

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
    let block_count = div_ceil(job.length, SORT_BLOCK);
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

// For each digit, one bit per thread whose key has it: bit `t % 32` of word `t / 32`. Word-major.
var<workgroup> digit_threads: array<atomic<u32>, DIGITS * MASK_WORDS>;
// For each digit, the index where its next key goes.
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

// As `scatter`, for keys with two values: an index and a mask.
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

// Moves one key and its value per thread. Returns the index where they went.
fn scatter_round(at: u32, end: u32, thread: u32) -> u32 {
    let i = at + thread;
    let held = i < end;
    var key = 0u;
    if held {
        key = keys[i];
    }
    let to = key_place(key, held, thread);
    if held {
        sorted_keys[to] = key;
        sorted_values[to] = values[i];
    }
    return to;
}

// First key and end of a block; an empty range for a surplus workgroup of the folded dispatch.
fn start_block(block: u32, thread: u32) -> vec2u {
    let block_count = div_ceil(job.length, SORT_BLOCK);
    if block >= block_count {
        return vec2u(0u);
    }
    next[thread] = offsets[thread * block_count + block];
    for (var word = 0u; word < MASK_WORDS; word++) {
        atomicStore(&digit_threads[word * DIGITS + thread], 0u);
    }
    return vec2u(block * SORT_BLOCK, min((block + 1u) * SORT_BLOCK, job.length));
}

// Index where a thread's key goes, if `held`; called once per round of 256 keys.
//
// A key's rank among the equal digits of its round is the number of lower threads with the same digit.
// It is computed from one bit per thread, so the sort is stable for any subgroup size and for any order
// in which the bits were set. The last thread of a digit advances the digit's next index, and each
// thread clears the word in which it set a bit.
fn key_place(key: u32, held: bool, thread: u32) -> u32 {
    let own_word = thread / 32u;
    let own_bit = 1u << (thread % 32u);
    let own_digit = digit(key);
    workgroupBarrier();
    if held {
        atomicOr(&digit_threads[own_word * DIGITS + own_digit], own_bit);
    }
    workgroupBarrier();
    var place = 0u;
    var is_last = false;
    if held {
        let beside = atomicLoad(&digit_threads[own_word * DIGITS + own_digit]);
        place = next[own_digit] + countOneBits(beside & (own_bit - 1u));
        var after = beside & ~(own_bit | (own_bit - 1u));
        for (var word = 0u; word < MASK_WORDS; word++) {
            let others = atomicLoad(&digit_threads[word * DIGITS + own_digit]);
            place += select(0u, countOneBits(others), word < own_word);
            after |= select(0u, others, word > own_word);
        }
        is_last = after == 0u;
    }
    workgroupBarrier();
    if held {
        atomicStore(&digit_threads[own_word * DIGITS + own_digit], 0u);
        if is_last {
            next[own_digit] = place + 1u;
        }
    }
    return place;
}

// The digit of a key that this pass sorts by.
fn digit(key: u32) -> u32 {
    return (key >> SHIFT) & (DIGITS - 1u);
}
