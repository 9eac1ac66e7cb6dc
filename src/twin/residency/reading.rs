//! Sections that are being read, as stored: memory in addition to the budget.

use std::collections::VecDeque;
use std::time::Instant;

use parking_lot::{Condvar, Mutex, MutexGuard};

use crate::limits;

/// Bounds the bytes, as stored, of the sections that are in memory until they are decoded. They are
/// read in the order in which they came: a large one, which needs all others to end, is not
/// overtaken by small ones for ever.
#[derive(Debug, Default)]
pub struct ReadingBytes {
    state: Mutex<State>,
    /// Notified when a section was read, or does not wait any longer.
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// Of the sections that are being read.
    bytes: u64,
    /// Numbers of the readers that wait.
    waiting: VecDeque<u64>,
    next: u64,
}

/// A section that is being read. Dropped when it was.
#[derive(Debug)]
pub struct Reading<'a> {
    all: &'a ReadingBytes,
    bytes: u64,
}

impl ReadingBytes {
    /// Waits until the sections that are being read leave room for one of so many bytes, or there
    /// are none; a read that hangs does not keep others waiting for longer than
    /// [`limits::READING_WAIT`]. `None` if no request wants the section any more.
    pub fn begin(&self, bytes: u64, is_wanted: &dyn Fn() -> bool) -> Option<Reading<'_>> {
        let mut state = self.state.lock();
        let until = Instant::now() + limits::READING_WAIT;
        let number = state.next;
        state.next += 1;
        state.waiting.push_back(number);
        let mut wanted = true;
        while !state.has_room(number, bytes) && Instant::now() < until {
            // The answer may need another lock.
            wanted = MutexGuard::unlocked(&mut state, is_wanted);
            if !wanted {
                break;
            }
            // It may have become its turn in between, and no notification follows.
            if !state.has_room(number, bytes) {
                let poll = until.min(Instant::now() + limits::READING_POLL);
                self.changed.wait_until(&mut state, poll);
            }
        }
        state.waiting.retain(|&other| other != number);
        if wanted {
            state.bytes += bytes;
        }
        drop(state);
        // The next one may have room beside this one, or in its place.
        self.changed.notify_all();
        // Not `then_some`: a reading that is made and dropped gives bytes back.
        wanted.then(|| Reading { all: self, bytes })
    }
}

impl State {
    /// Whether it is the turn of a reader, and there is room for its section.
    fn has_room(&self, number: u64, bytes: u64) -> bool {
        let is_next = self.waiting.front() == Some(&number);
        is_next && (self.bytes == 0 || self.bytes + bytes <= limits::READING_BYTES)
    }
}

impl Drop for Reading<'_> {
    fn drop(&mut self) {
        self.all.state.lock().bytes -= self.bytes;
        self.all.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
    use std::sync::mpsc::{TryRecvError, channel};
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_large_section_is_read_alone_and_is_not_overtaken() {
        let all = ReadingBytes::default();
        let small = all.begin(limits::READING_BYTES / 2, &|| true);
        let beside = all.begin(limits::READING_BYTES / 4, &|| true);
        let (begun, order) = channel();
        std::thread::scope(|scope| {
            let read = |name: &'static str, bytes| {
                let begun = begun.clone();
                let waiting = all.state.lock().waiting.len();
                let all = &all;
                scope.spawn(move || {
                    let reading = all.begin(bytes, &|| true);
                    begun.send(name).unwrap();
                    drop(reading);
                });
                while all.state.lock().waiting.len() == waiting {
                    std::thread::yield_now();
                }
            };
            read("large", 2 * limits::READING_BYTES);
            // There is room for it, but the large one came first.
            read("small", 1);
            drop(small);
            assert_eq!(order.try_recv(), Err(TryRecvError::Empty));
            drop(beside);
        });
        assert_eq!(order.iter().take(2).collect::<Vec<_>>(), ["large", "small"]);
        assert!(all.state.lock().bytes == 0 && all.state.lock().waiting.is_empty());
    }

    /// A section that no request wants leaves the queue at once, and the next one has its turn.
    #[test]
    fn what_is_not_wanted_does_not_wait() {
        let all = ReadingBytes::default();
        let _held = all.begin(limits::READING_BYTES / 2, &|| true);
        let is_wanted = AtomicBool::new(true);
        std::thread::scope(|scope| {
            let large = scope
                .spawn(|| all.begin(limits::READING_BYTES, &|| is_wanted.load(Relaxed)).is_none());
            while all.state.lock().waiting.is_empty() {
                std::thread::yield_now();
            }
            let behind = scope.spawn(|| all.begin(1, &|| true).is_some());
            let begun = Instant::now();
            is_wanted.store(false, Relaxed);
            assert!(large.join().unwrap(), "it was read");
            assert!(behind.join().unwrap());
            // Far less than `READING_WAIT`.
            assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());
        });
        assert_eq!(all.state.lock().bytes, limits::READING_BYTES / 2);
    }
}
