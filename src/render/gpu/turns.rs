//! Frames are drawn in the order in which they were asked for. A mutex alone lets in whoever comes at
//! the right moment.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// A queue of callers.
#[derive(Debug, Default)]
pub(super) struct Turns {
    queue: Mutex<Queue>,
    moved: Condvar,
}

#[derive(Debug, Default)]
struct Queue {
    came: u64,
    left: u64,
}

/// A caller's turn. It ends when this is dropped.
#[derive(Debug)]
pub(super) struct Turn<'a>(&'a Turns);

impl Turns {
    /// Waits until everyone who came before has left.
    pub(super) fn wait(&self) -> Turn<'_> {
        let mut queue = self.lock();
        let own = queue.came;
        queue.came += 1;
        let queue = self.moved.wait_while(queue, |queue| queue.left != own);
        drop(queue.unwrap_or_else(PoisonError::into_inner));
        Turn(self)
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        self.0.lock().left += 1;
        self.0.moved.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_come_first_served() {
        let (turns, served) = (Turns::default(), Mutex::new(Vec::new()));
        let first = turns.wait();
        std::thread::scope(|scope| {
            for caller in 1..=20 {
                let (turns, served) = (&turns, &served);
                scope.spawn(move || {
                    let _turn = turns.wait();
                    served.lock().unwrap().push(caller);
                });
                while turns.lock().came <= caller {
                    std::thread::yield_now();
                }
            }
            assert_eq!(*served.lock().unwrap(), [0; 0], "it is not their turn");
            drop(first);
        });
        assert!(served.into_inner().unwrap().into_iter().eq(1..=20));
    }
}
