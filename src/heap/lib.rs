//! Gives free memory of the heap back to the operating system.
//!
//! The sections of twins have 1 kB to 9 MB, and are loaded and evicted between the short-lived blocks of frames and
//! pushes. glibc keeps what is freed below its largest blocks for later allocations, so that a process grows to several
//! times of what it uses: after 30 pushes to a twin of 1 km, 80 MB were in use and 280 MB were resident. `malloc_trim`
//! gives back every page that is free, wherever it is in the heap. Of the alternatives, jemalloc and mimalloc kept more
//! (BENCHMARKS.md), and `MALLOC_MMAP_THRESHOLD_` does not help with blocks below it.
//!
//! This is the one place with `unsafe`: no well-kept crate wraps the function.

/// Gives free pages of the heap back to the operating system. Blocks that are in use stay where they are; blocks that
/// are allocated later get new pages. Other threads that allocate meanwhile may wait for milliseconds.
///
/// Without glibc it does nothing: the allocators of other systems give memory back by themselves.
pub fn release_free_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[expect(unsafe_code, reason = "a function of the C library that the standard library lacks")]
    // SAFETY: `malloc_trim` takes a number of bytes and locks the heap itself. Any thread may call it at any time.
    unsafe {
        // The result says whether there was anything to give back.
        let _ = libc::malloc_trim(0);
    }
}
