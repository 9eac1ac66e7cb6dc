//! The number of frames that the device has at once.

use parking_lot::{Condvar, Mutex};

use crate::limits;

/// Slots for frames on the device.
#[derive(Debug, Default)]
pub(super) struct Slots {
    taken: Mutex<usize>,
    freed: Condvar,
}

/// A frame's slot. It is free again when this is dropped.
#[derive(Debug)]
pub(super) struct Slot<'a>(&'a Slots);

impl Slots {
    /// Blocks until fewer than [`limits::GPU_FRAMES_ON_DEVICE`] slots are taken. A caller that
    /// waits must not hold what the frames on the device wait for.
    pub(super) fn wait(&self) -> Slot<'_> {
        let mut taken = self.taken.lock();
        self.freed.wait_while(&mut taken, |taken| *taken >= limits::GPU_FRAMES_ON_DEVICE);
        *taken += 1;
        Slot(self)
    }
}

impl Drop for Slot<'_> {
    fn drop(&mut self) {
        *self.0.taken.lock() -= 1;
        // One slot is free, and any of the callers can take it.
        self.0.freed.notify_one();
    }
}
