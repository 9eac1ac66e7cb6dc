//! The time of day, as an interface: leases, garbage collection and the log need it, and a simulation lets it jump.

use std::fmt::Debug;
use std::time::{SystemTime, UNIX_EPOCH};

/// A clock. It may be wrong, and may jump.
pub trait Clock: Debug + Send + Sync {
    /// Microseconds since 1970.
    fn now_us(&self) -> i64;
}

/// The clock of this machine.
#[derive(Clone, Copy, Debug, Default)]
pub struct SystemClock;

impl Clock for SystemClock {
    fn now_us(&self) -> i64 {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        i64::try_from(since.as_micros()).unwrap_or(i64::MAX)
    }
}
