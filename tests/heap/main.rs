//! Memory goes back to the operating system: one test, alone in its process, so that the numbers
//! are its own.
#![cfg(all(target_os = "linux", target_env = "gnu"))]

use std::hint::black_box;

/// Small enough that glibc takes it from the heap, and large enough to contain whole pages.
const BLOCK_BYTES: usize = 64 << 10;
const BLOCKS: usize = 2_000;
const MIB: usize = 1 << 20;

#[test]
fn free_pages_and_large_blocks_are_given_back() {
    // First, while the heap has no free pages that a large block could have.
    let mut small = Vec::new();
    let mut remaining_mib = |mib: usize| {
        let large = black_box(vec![1_u8; mib * MIB]);
        small.push(black_box(vec![2_u8; 100]));
        let full = resident_bytes();
        drop(large);
        mib as u64 - full.saturating_sub(resident_bytes()) / MIB as u64
    };
    assert!(remaining_mib(20) < 2, "the first one has pages of its own");
    assert!(remaining_mib(16) > 8, "glibc takes the next one from the heap");
    wildcity_heap::map_large_blocks();
    assert!(remaining_mib(18) < 2, "it is given back");

    let mut short_lived = Vec::new();
    let mut kept = Vec::new();
    for _ in 0..BLOCKS {
        short_lived.push(black_box(vec![1_u8; BLOCK_BYTES]));
        kept.push(black_box(vec![2_u8; 100]));
    }
    let full = resident_bytes();
    drop(short_lived);
    let freed = resident_bytes();
    let short_lived_bytes = (BLOCKS * BLOCK_BYTES) as u64;
    let by_itself = full.saturating_sub(freed);
    assert!(by_itself < short_lived_bytes / 10, "glibc gave back {by_itself} bytes by itself");

    wildcity_heap::release_free_memory();
    let given_back = full.saturating_sub(resident_bytes());
    assert!(given_back > short_lived_bytes * 9 / 10, "{given_back} of {short_lived_bytes}");
    assert!(kept.iter().all(|block| block.iter().all(|&byte| byte == 2)));
    live_bytes_are_those_of_blocks_in_use();
}

/// Small blocks and large ones, whether anything was written to them or not.
fn live_bytes_are_those_of_blocks_in_use() {
    let live = || wildcity_heap::live_bytes().unwrap();
    let before = live();
    let small: Vec<Vec<u8>> = (0..BLOCKS).map(|_| black_box(vec![1; BLOCK_BYTES])).collect();
    let untouched = black_box(vec![0_u8; 64 * MIB]);
    let wanted = (BLOCKS * BLOCK_BYTES + 64 * MIB) as u64;
    let more = live() - before;
    assert!(more.abs_diff(wanted) < wanted / 100, "{more}, and {wanted} were asked for");
    drop((small, untouched));
    assert!(live().abs_diff(before) < MIB as u64, "{} and {before}", live());
}

/// Memory of the process without files.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10
}
