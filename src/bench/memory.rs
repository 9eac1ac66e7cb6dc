//! The memory of this process.

use std::fs;

use anyhow::Context as _;

/// Memory of this process that is in RAM, in bytes.
pub(super) struct Rss {
    pub(super) now: u64,
    /// Its largest value since the process started.
    pub(super) peak: u64,
}

pub(super) fn rss_bytes() -> anyhow::Result<Rss> {
    let text = fs::read_to_string("/proc/self/status")
        .context("/proc/self/status; the memory of a process is known on Linux only")?;
    let field = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib << 10)
    };
    let both = field("VmRSS:").zip(field("VmHWM:"));
    let memory = both.map(|(now, peak)| Rss { now, peak });
    memory.context("/proc/self/status does not say how much memory is used")
}

/// Bytes of the blocks of the heap that are in use.
pub(super) fn live_bytes() -> anyhow::Result<u64> {
    wildcity_heap::live_bytes().context("the blocks of the heap are counted with glibc only")
}

pub(super) fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}
