//! Devices that have failed. A driver that hangs would block the thread that drops its device, so
//! each is dropped in its own thread.

use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use super::chain::Chain;
use crate::limits;

/// Threads that drop failed devices.
#[derive(Debug, Default)]
pub(super) struct Discarded(Mutex<Vec<JoinHandle<()>>>);

impl Discarded {
    /// Drops a device without waiting for its driver.
    pub(super) fn add(&self, chain: Chain) {
        let mut threads = self.0.lock();
        threads.retain(|thread| !thread.is_finished());
        // If no thread can be started, the device is dropped on this one.
        let dropping = Builder::new().name("discard".to_owned()).spawn(move || drop(chain));
        threads.extend(dropping);
    }
}

/// Waits, but not for a driver that hangs: a process that ends while a device is dropped may crash
/// in the driver.
impl Drop for Discarded {
    fn drop(&mut self) {
        let deadline = Instant::now() + limits::DISCARD;
        let threads = self.0.get_mut();
        while threads.iter().any(|thread| !thread.is_finished()) && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}
