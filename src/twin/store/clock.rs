//! The time, as an interface: leases, garbage collection, the log and the spool of uploads need it,
//! and a simulation lets it jump.

use std::fmt::Debug;
use std::sync::LazyLock;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// A time of day, which may be wrong and may jump, and a monotonic time.
pub trait Clock: Debug + Send + Sync {
    /// Microseconds since 1970.
    fn now_us(&self) -> i64;

    /// Microseconds since a time that the clock chooses. It never jumps.
    fn monotonic_us(&self) -> i64;
}

/// The clock of this machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct SystemClock;

/// Zero of [`SystemClock::monotonic_us`].
static START: LazyLock<Instant> = LazyLock::new(Instant::now);

impl Clock for SystemClock {
    fn now_us(&self) -> i64 {
        // A clock before 1970 counts as 1970. As i64, microseconds reach 290,000 years.
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        i64::try_from(since.as_micros()).unwrap_or(i64::MAX)
    }

    fn monotonic_us(&self) -> i64 {
        i64::try_from(START.elapsed().as_micros()).unwrap_or(i64::MAX)
    }
}
