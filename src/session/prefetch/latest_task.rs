//! Who looks ahead for a session: one submit at a time, and only the latest of those that wait.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Does one submit after the other beside the session, which never waits for it.
#[derive(Debug, Default)]
pub(crate) struct LatestTask(Arc<Mutex<State>>);

#[derive(Default)]
struct State {
    /// A task is under way, which takes `next` when it is done with the one before.
    busy: bool,
    next: Option<Task>,
}

type Task = Box<dyn FnOnce() + Send>;

impl LatestTask {
    /// Does this soon, in place of what waits.
    pub(crate) fn submit(&self, submit: impl FnOnce() + Send + 'static) {
        let replaced = {
            let mut state = lock(&self.0);
            if !state.busy {
                state.busy = true;
                let shared = self.0.clone();
                // Nobody waits for it.
                drop(tokio::task::spawn_blocking(move || run_all(&shared)));
            }
            state.next.replace(Box::new(submit))
        };
        // Once the lock is open: it may hold anything.
        drop(replaced);
    }
}

impl Drop for LatestTask {
    fn drop(&mut self) {
        // Nobody is interested any more.
        let _next = lock(&self.0).next.take();
    }
}

/// Until nothing waits.
fn run_all(shared: &Mutex<State>) {
    loop {
        let next = {
            let mut state = lock(shared);
            state.busy = state.next.is_some();
            state.next.take()
        };
        let Some(submit) = next else { return };
        // A defect in one is logged where it happens, and the next is looked at all the same.
        let _looked = catch_unwind(AssertUnwindSafe(submit));
    }
}

/// A panic elsewhere leaves nothing half-done behind this lock.
fn lock(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

impl std::fmt::Debug for State {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("State").field("busy", &self.busy).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::channel;

    #[tokio::test]
    async fn one_look_at_a_time_and_then_the_latest() {
        let lookout = LatestTask::default();
        let (begun, has_begun) = channel();
        let (go_on, may_go_on) = channel();
        let (tell, told) = channel();
        lookout.submit(move || {
            begun.send(()).unwrap();
            may_go_on.recv().unwrap();
            panic!("this crash was asked for");
        });
        has_begun.recv().unwrap();
        for number in 0..1000 {
            let tell = tell.clone();
            lookout.submit(move || tell.send(number).unwrap());
        }
        assert!(told.try_recv().is_err(), "the first is still under way");
        go_on.send(()).unwrap();
        assert_eq!(told.recv().unwrap(), 999);
        drop(tell);
        assert!(told.recv().is_err(), "no other submit was kept");
    }
}
