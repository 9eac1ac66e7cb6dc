//! A fair queue: callers are served in the order in which they called. A mutex by itself does not
//! guarantee any order.

use parking_lot::{Condvar, Mutex};

/// A queue of callers, each with a ticket number.
#[derive(Debug, Default)]
pub(super) struct TicketQueue {
    counts: Mutex<Counts>,
    advanced: Condvar,
}

#[derive(Debug, Default)]
struct Counts {
    issued: u64,
    /// Number of tickets whose turn has ended, which is also the number of the ticket that is
    /// served now.
    served: u64,
}

/// The right to be served. It passes to the next caller when this is dropped.
#[derive(Debug)]
pub(super) struct Ticket<'a>(&'a TicketQueue);

impl TicketQueue {
    /// Blocks until all earlier callers have dropped their tickets.
    pub(super) fn wait(&self) -> Ticket<'_> {
        let mut counts = self.counts.lock();
        let own = counts.issued;
        counts.issued += 1;
        // The number is drawn and the wait begins under one lock: no turn can end unnoticed in
        // between.
        self.advanced.wait_while(&mut counts, |counts| counts.served != own);
        Ticket(self)
    }
}

impl Drop for Ticket<'_> {
    fn drop(&mut self) {
        self.0.counts.lock().served += 1;
        // Each caller waits for a number of its own: one that is woken alone might have a later
        // number.
        self.0.advanced.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn callers_are_served_in_the_order_of_their_calls() {
        let queue = TicketQueue::default();
        let served = Mutex::new(Vec::new());
        let first = queue.wait();
        std::thread::scope(|scope| {
            for caller in 1..=20 {
                let queue = &queue;
                let served = &served;
                scope.spawn(move || {
                    let _ticket = queue.wait();
                    served.lock().push(caller);
                });
                // The first ticket counts as well: with that of this caller, `caller` + 1 are
                // issued.
                while queue.counts.lock().issued <= caller {
                    std::thread::yield_now();
                }
            }
            assert_eq!(*served.lock(), [0; 0], "a caller was served before the first one had left");
            drop(first);
        });
        assert!(served.into_inner().into_iter().eq(1..=20));
    }
}
