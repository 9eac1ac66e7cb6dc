//! Processor time of a thread. Other programs on the machine do not change it, as they change the
//! time of a clock.

use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

/// Processor time that `work` takes on this thread.
pub(crate) fn thread_time(work: impl FnOnce()) -> Duration {
    let now = || {
        let time = clock_gettime(ClockId::ThreadCPUTime);
        Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec.unsigned_abs() as u32)
    };
    let start = now();
    work();
    now() - start
}
