//! What this process has in memory, where the system says it.

use std::fs;

/// A field of `/proc/self/status` (proc(5)), such as `VmHWM:`, in KiB.
pub(super) fn status_kib(field: &str) -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(field))?;
    line.split_whitespace().next()?.parse().ok()
}
