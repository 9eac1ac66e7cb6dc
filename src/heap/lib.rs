//! Gives free memory of the heap back to the operating system, and measures what is in use.
//!
//! The sections of twins have 1 kB to 9 MB. They are loaded and evicted between the short-lived
//! blocks of frames and pushes, and glibc keeps most of what is freed for later allocations. A
//! process therefore grows to several times what it uses: BENCHMARKS.md, "City of 20 km".
//! `malloc_trim` gives back every page that is free, wherever it is in the heap.
//!
//! Large blocks have pages of their own, which are given back at once. But when such a block is
//! freed, glibc takes the next ones of its size from the heap, up to 32 MiB. There they leave
//! holes: a server of a dense capture that may use 0.6 GiB took 120 MB more. [`map_large_blocks`]
//! fixes the size.
//!
//! This is the one place with `unsafe`: no well-maintained crate wraps the functions.

/// Size from which a block has pages of its own. To map those of a frame took 1 % of the processor
/// time of a step.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const LARGE_BYTES: libc::c_int = 1 << 20;

/// Gives the pages of blocks of 1 MiB and more back to the operating system as soon as they are
/// freed, from now on. Call it at the start of a program, before it has other threads. The
/// variable `MALLOC_MMAP_THRESHOLD_` of the environment has another size.
///
/// Without glibc it does nothing: other allocators have such a size of their own.
pub fn map_large_blocks() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    if std::env::var_os("MALLOC_MMAP_THRESHOLD_").is_none() {
        #[expect(unsafe_code, reason = "a function that the standard library lacks")]
        // SAFETY: `mallopt` takes two numbers. It must not run while another thread allocates
        // memory, and does not at the start of a program.
        unsafe {
            // It refuses sizes above 32 MiB only.
            let _ = libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE_BYTES);
        }
    }
}

/// Bytes of all blocks that are in use, touched or not, as they were asked for; `None` without
/// glibc. Blocks that were freed and that a thread keeps for its next ones, 0.1 MB at most, count.
pub fn live_bytes() -> Option<u64> {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        #[expect(unsafe_code, reason = "a function that the standard library lacks")]
        // SAFETY: `mallinfo2` takes nothing and locks the heap itself. Any thread may call it at
        // any time.
        let counts = unsafe { libc::mallinfo2() };
        // Blocks of the heap, and blocks with pages of their own.
        Some((counts.uordblks + counts.hblkhd) as u64)
    }
    #[cfg(not(all(target_os = "linux", target_env = "gnu")))]
    None
}

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
