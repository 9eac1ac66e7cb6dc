//! A server gives memory that nothing uses any more back to the operating system.
#![cfg(all(target_os = "linux", target_env = "gnu"))]

use std::hint::black_box;
use std::time::{Duration, Instant};

use crate::support::TestServer;

/// Small enough that glibc takes it from the heap, and large enough to contain whole pages.
const BLOCK_BYTES: usize = 64 << 10;
const BLOCKS: usize = 4_000;

#[tokio::test(flavor = "multi_thread")]
async fn free_memory_is_given_back() {
    let _server = TestServer::start().await;
    let mut short_lived = Vec::new();
    let mut kept = Vec::new();
    for _ in 0..BLOCKS {
        short_lived.push(black_box(vec![1_u8; BLOCK_BYTES]));
        kept.push(black_box(vec![2_u8; 100]));
    }
    drop(short_lived);
    // Other tests of this process take and free memory, too, but much less.
    let full = resident_bytes();
    let deadline = Instant::now() + Duration::from_secs(60);
    while full.saturating_sub(resident_bytes()) < (BLOCKS * BLOCK_BYTES / 2) as u64 {
        assert!(Instant::now() < deadline, "{full} bytes, then {}", resident_bytes());
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    drop(kept);
}

fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10
}
