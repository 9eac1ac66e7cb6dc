// Stage sort, for devices with subgroups of 32 or 64 threads. After `histogram` of `sort.wgsl`, `scan_digits` replaces
// the counts of each digit by their prefix sums over the blocks, one workgroup for each digit. Then in `scatter`, 512
// threads with eight keys each sort a block in workgroup memory and write it in order, so that neighbouring threads
// write neighbouring keys. The order that results is that of `sort.wgsl`.
//
// The eight keys of a thread have names of their own: a device keeps an array with a variable index in memory.
//
// A key's rank among the equal digits of its subgroup comes from ballots: one for each bit of the digit leaves the
// threads that agree in all of them. The first of them adds their number to the subgroup's counter of the digit.
// `BALLOTS` stands for `ballots.wgsl` or, for tests on devices without subgroups, `ballots_emulated.wgsl`.

#import constants
#import layout
#import math
#import prefix
#import BALLOTS

const THREADS: u32 = 512;
const DIGIT_BITS: u32 = 8;

override SHIFT: u32;

@group(0) @binding(0) var<storage, read> job: Job;
@group(0) @binding(1) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted_values: array<u32>;
// For each digit, the number of keys that have it.
@group(0) @binding(6) var<storage, read_write> totals: array<u32, DIGITS>;

@compute @workgroup_size(WORKGROUP)
fn scan_digits(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let block_count = div_ceil(job.length, SORT_BLOCK);
    let first = group.x * block_count;
    var before = 0u;
    for (var round = 0u; round < block_count; round += WORKGROUP) {
        let block = round + thread;
        var own = 0u;
        if block < block_count {
            own = offsets[first + block];
        }
        inclusive_prefix(thread, own);
        if block < block_count {
            offsets[first + block] = before + prefix_before(thread);
        }
        before += prefix_sums[WORKGROUP - 1u];
    }
    if thread == 0u {
        totals[group.x] = before;
    }
}

// First a counter for each digit of each subgroup, subgroup after subgroup; then the keys, and then the values, of the
// block in order.
var<workgroup> words: array<atomic<u32>, SORT_BLOCK>;
// For each digit, where its first key goes less its place in the block.
var<workgroup> starts: array<u32, DIGITS>;
// Sums of the digits' counts over 32 digits each.
var<workgroup> sums: array<u32, DIGITS / 32>;

// A thread's place: its subgroup, the lane within it, and the size of subgroups.
struct Team {
    index: u32,
    lane: u32,
    size: u32,
}

// Sorts a block. The entry point is in the file with the ballots.
fn scatter_block(block: u32, thread: u32, team: Team) {
    let block_count = div_ceil(job.length, SORT_BLOCK);
    if block >= block_count {
        return;
    }
    let first = block * SORT_BLOCK;
    let count = min(job.length - first, SORT_BLOCK);
    for (var i = thread; i < SORT_BLOCK; i += THREADS) {
        atomicStore(&words[i], 0u);
    }
    workgroupBarrier();

    // The rank of each key among the equal digits of its subgroup. A subgroup has consecutive keys, row after row.
    let own = team.index * team.size * (SORT_BLOCK / THREADS) + team.lane;
    let at_0 = own + 0u * team.size;
    let at_1 = own + 1u * team.size;
    let at_2 = own + 2u * team.size;
    let at_3 = own + 3u * team.size;
    let at_4 = own + 4u * team.size;
    let at_5 = own + 5u * team.size;
    let at_6 = own + 6u * team.size;
    let at_7 = own + 7u * team.size;
    let key_0 = keys[first + min(at_0, count - 1u)];
    let key_1 = keys[first + min(at_1, count - 1u)];
    let key_2 = keys[first + min(at_2, count - 1u)];
    let key_3 = keys[first + min(at_3, count - 1u)];
    let key_4 = keys[first + min(at_4, count - 1u)];
    let key_5 = keys[first + min(at_5, count - 1u)];
    let key_6 = keys[first + min(at_6, count - 1u)];
    let key_7 = keys[first + min(at_7, count - 1u)];
    let rank_0 = rank(digit(key_0), at_0 < count, team, thread);
    let rank_1 = rank(digit(key_1), at_1 < count, team, thread);
    let rank_2 = rank(digit(key_2), at_2 < count, team, thread);
    let rank_3 = rank(digit(key_3), at_3 < count, team, thread);
    let rank_4 = rank(digit(key_4), at_4 < count, team, thread);
    let rank_5 = rank(digit(key_5), at_5 < count, team, thread);
    let rank_6 = rank(digit(key_6), at_6 < count, team, thread);
    let rank_7 = rank(digit(key_7), at_7 < count, team, thread);
    workgroupBarrier();

    // For each digit, sum the counters of the subgroups before, and of smaller digits.
    let teams = THREADS / team.size;
    var total = 0u;
    var all = 0u;
    if thread < DIGITS {
        for (var k = 0u; k < teams; k++) {
            total += atomicLoad(&words[k * DIGITS + thread]);
        }
        all = totals[thread];
    }
    var before = sum_smaller_digits(thread, total);
    let all_before = sum_smaller_digits(thread, all);
    if thread < DIGITS {
        starts[thread] = all_before + offsets[thread * block_count + block] - before;
        for (var k = 0u; k < teams; k++) {
            let counted = atomicLoad(&words[k * DIGITS + thread]);
            atomicStore(&words[k * DIGITS + thread], before);
            before += counted;
        }
    }
    workgroupBarrier();
    let place_0 = rank_0 + atomicLoad(&words[team.index * DIGITS + digit(key_0)]);
    let place_1 = rank_1 + atomicLoad(&words[team.index * DIGITS + digit(key_1)]);
    let place_2 = rank_2 + atomicLoad(&words[team.index * DIGITS + digit(key_2)]);
    let place_3 = rank_3 + atomicLoad(&words[team.index * DIGITS + digit(key_3)]);
    let place_4 = rank_4 + atomicLoad(&words[team.index * DIGITS + digit(key_4)]);
    let place_5 = rank_5 + atomicLoad(&words[team.index * DIGITS + digit(key_5)]);
    let place_6 = rank_6 + atomicLoad(&words[team.index * DIGITS + digit(key_6)]);
    let place_7 = rank_7 + atomicLoad(&words[team.index * DIGITS + digit(key_7)]);
    workgroupBarrier();

    // Each thread stores its own keys at their places in the block, and writes those of every 512th place.
    store(place_0, key_0, at_0 < count);
    store(place_1, key_1, at_1 < count);
    store(place_2, key_2, at_2 < count);
    store(place_3, key_3, at_3 < count);
    store(place_4, key_4, at_4 < count);
    store(place_5, key_5, at_5 < count);
    store(place_6, key_6, at_6 < count);
    store(place_7, key_7, at_7 < count);
    workgroupBarrier();
    let to_0 = write_key(thread + 0u * THREADS, count);
    let to_1 = write_key(thread + 1u * THREADS, count);
    let to_2 = write_key(thread + 2u * THREADS, count);
    let to_3 = write_key(thread + 3u * THREADS, count);
    let to_4 = write_key(thread + 4u * THREADS, count);
    let to_5 = write_key(thread + 5u * THREADS, count);
    let to_6 = write_key(thread + 6u * THREADS, count);
    let to_7 = write_key(thread + 7u * THREADS, count);
    workgroupBarrier();
    store(place_0, values[first + min(at_0, count - 1u)], at_0 < count);
    store(place_1, values[first + min(at_1, count - 1u)], at_1 < count);
    store(place_2, values[first + min(at_2, count - 1u)], at_2 < count);
    store(place_3, values[first + min(at_3, count - 1u)], at_3 < count);
    store(place_4, values[first + min(at_4, count - 1u)], at_4 < count);
    store(place_5, values[first + min(at_5, count - 1u)], at_5 < count);
    store(place_6, values[first + min(at_6, count - 1u)], at_6 < count);
    store(place_7, values[first + min(at_7, count - 1u)], at_7 < count);
    workgroupBarrier();
    write_value(to_0, thread + 0u * THREADS, count);
    write_value(to_1, thread + 1u * THREADS, count);
    write_value(to_2, thread + 2u * THREADS, count);
    write_value(to_3, thread + 3u * THREADS, count);
    write_value(to_4, thread + 4u * THREADS, count);
    write_value(to_5, thread + 5u * THREADS, count);
    write_value(to_6, thread + 6u * THREADS, count);
    write_value(to_7, thread + 7u * THREADS, count);
}

// Stores a word at its place in the block, if it is one of the block.
fn store(place: u32, word: u32, held: bool) {
    if held {
        atomicStore(&words[place], word);
    }
}

// Writes the key at a place of the block. Returns where its value goes.
fn write_key(place: u32, count: u32) -> u32 {
    if place >= count {
        return 0u;
    }
    let key = atomicLoad(&words[place]);
    let to = starts[digit(key)] + place;
    sorted_keys[to] = key;
    return to;
}

fn write_value(to: u32, place: u32, count: u32) {
    if place < count {
        sorted_values[to] = atomicLoad(&words[place]);
    }
}

// Sum of the counts of smaller digits. The first threads have a digit each; all threads call it.
fn sum_smaller_digits(thread: u32, count: u32) -> u32 {
    workgroupBarrier();
    if thread < DIGITS {
        starts[thread] = count;
    }
    workgroupBarrier();
    if thread < DIGITS / 32u {
        var sum = 0u;
        for (var k = 0u; k < 32u; k++) {
            sum += starts[32u * thread + k];
        }
        sums[thread] = sum;
    }
    workgroupBarrier();
    var before = 0u;
    if thread < DIGITS {
        for (var k = 0u; k < thread / 32u; k++) {
            before += sums[k];
        }
        for (var k = thread / 32u * 32u; k < thread; k++) {
            before += starts[k];
        }
    }
    workgroupBarrier();
    return before;
}

// The rank of a key among the equal digits of its subgroup, of this row and of the rows before. All threads call it.
fn rank(own_digit: u32, held: bool, team: Team, thread: u32) -> u32 {
    var equal = ballot(held, thread);
    for (var bit = 0u; bit < DIGIT_BITS; bit++) {
        let is_set = ((own_digit >> bit) & 1u) == 1u;
        let votes = ballot(held && is_set, thread);
        equal &= select(~votes, votes, is_set);
    }
    let below = lanes_below(team.lane);
    let own_rank = countOneBits(equal.x & below.x) + countOneBits(equal.y & below.y);
    var before = 0u;
    if held && own_rank == 0u {
        let number = countOneBits(equal.x) + countOneBits(equal.y);
        before = atomicAdd(&words[team.index * DIGITS + own_digit], number);
    }
    let leader = select(firstTrailingBit(equal.x), 32u + firstTrailingBit(equal.y), equal.x == 0u);
    return own_rank + from_lane(before, select(team.lane, leader, held), thread);
}

// The lanes below one, a bit each.
fn lanes_below(lane: u32) -> vec2u {
    let low = select((1u << (lane % 32u)) - 1u, 0xFFFFFFFFu, lane >= 32u);
    let high = select(0u, (1u << (lane % 32u)) - 1u, lane >= 32u);
    return vec2u(low, high);
}

// The digit of a key that this pass sorts by.
fn digit(key: u32) -> u32 {
    return (key >> SHIFT) & (DIGITS - 1u);
}
