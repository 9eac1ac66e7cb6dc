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
}

/// Memory of the process without files.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10
}
