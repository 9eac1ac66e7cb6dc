//! Sections that are being read, as stored: memory in addition to the budget.

use std::time::Instant;

use parking_lot::{Condvar, Mutex};

use crate::limits;

/// Bounds the bytes, as stored, of the sections that are in memory until they are decoded.
#[derive(Debug, Default)]
pub struct ReadingBytes {
    bytes: Mutex<u64>,
    /// Notified when a section was read.
    was_read: Condvar,
}

/// A section that is being read. Dropped when it was.
#[derive(Debug)]
pub struct Reading<'a> {
    all: &'a ReadingBytes,
    bytes: u64,
}

impl ReadingBytes {
    /// Waits until the sections that are being read leave room for one of so many bytes, or there
    /// are none; a read that hangs does not keep others waiting for ever.
    pub fn begin(&self, bytes: u64) -> Reading<'_> {
        let mut reading_bytes = self.bytes.lock();
        let until = Instant::now() + limits::READING_WAIT;
        while *reading_bytes > 0 && *reading_bytes + bytes > limits::READING_BYTES {
            if self.was_read.wait_until(&mut reading_bytes, until).timed_out() {
                break;
            }
        }
        *reading_bytes += bytes;
        Reading { all: self, bytes }
    }
}

impl Drop for Reading<'_> {
    fn drop(&mut self) {
        *self.all.bytes.lock() -= self.bytes;
        self.all.was_read.notify_all();
    }
}
