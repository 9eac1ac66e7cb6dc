//! The processor time of this process.

use std::fs;
use std::time::Duration;

use anyhow::Context as _;

/// Processor time of this process, user and system, of all threads.
pub(super) fn processor_time() -> anyhow::Result<Duration> {
    let text = fs::read_to_string("/proc/self/stat").context("/proc/self/stat")?;
    // The name of the program, in parentheses, may have spaces. utime and stime are fields 14 and
    // 15 (proc(5)), in ticks, of which Linux has 100 per second on every architecture.
    let after_name = text.rsplit(')').next().unwrap_or_default();
    let mut fields = after_name.split_whitespace().skip(11);
    let mut ticks = || fields.next().and_then(|field| field.parse::<u64>().ok());
    let both = ticks().zip(ticks()).context("/proc/self/stat does not say what time is used")?;
    Ok(Duration::from_millis(10 * (both.0 + both.1)))
}

/// Processor time of the threads of this process that still run: exact to the nanosecond, but
/// without threads that have ended.
pub(super) fn threads_processor_time() -> anyhow::Result<Duration> {
    let mut total = Duration::ZERO;
    for entry in fs::read_dir("/proc/self/task").context("/proc/self/task")? {
        // The first number is the time on a processor, in nanoseconds
        // (Documentation/scheduler/sched-stats.rst).
        let Ok(text) = fs::read_to_string(entry?.path().join("schedstat")) else { continue };
        let nanoseconds = text.split_whitespace().next().and_then(|number| number.parse().ok());
        total += Duration::from_nanos(nanoseconds.context("schedstat is not numbers")?);
    }
    Ok(total)
}
