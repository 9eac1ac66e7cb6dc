//! Gives free memory of the heap back to the operating system.
//!
//! The sections of twins have 1 kB to 9 MB. They are loaded and evicted between the short-lived
//! blocks of frames and pushes, and glibc keeps most of what is freed for later allocations. A
//! process therefore grows to several times what it uses: BENCHMARKS.md, "City of 20 km".
//! `malloc_trim` gives back every page that is free, wherever it is in the heap.
//!
//! This is the one place with `unsafe`: no well-maintained crate wraps the function.

/// Gives free pages of the heap back to the operating system. Blocks that are in use stay where
/// they are; blocks that are allocated later get new pages. Meanwhile other threads that allocate
/// may wait, for as long as a walk through the heap takes: 0.14 s for 1.1 GiB of sections on two
/// busy cores.
///
/// Without glibc it does nothing: the allocators of other systems give memory back by themselves.
pub fn release_free_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[expect(unsafe_code, reason = "a function of the C library that the standard library lacks")]
    // SAFETY: `malloc_trim` takes a number of bytes and locks the heap itself. Any thread may call
    // it at any time.
    unsafe {
        // The result says whether any memory was returned; it is not needed.
        let _ = libc::malloc_trim(0);
    }
}
