//! Runs tasks in the background, one at a time. Only the latest task waits; a new one replaces it.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use parking_lot::Mutex;

/// Runs one task after the other in the background; its owner never waits for them.
#[derive(Debug, Default)]
pub(crate) struct LatestTask(Arc<Mutex<State>>);

#[derive(Default)]
struct State {
    /// A blocking thread runs a task, and takes `next` when that is done.
    running: bool,
    next: Option<Task>,
}

type Task = Box<dyn FnOnce() + Send>;

impl LatestTask {
    /// Runs a task soon, instead of a task that still waits.
    pub(crate) fn submit(&self, task: impl FnOnce() + Send + 'static) {
        let replaced = {
            let mut state = self.0.lock();
            // The flag changes only under the lock under which `next` is looked at: a task that
            // waits always has a thread that will take it.
            if !state.running {
                state.running = true;
                let shared = self.0.clone();
                // The end of the thread is not awaited.
                drop(tokio::task::spawn_blocking(move || run_all(&shared)));
            }
            state.next.replace(Box::new(task))
        };
        // Dropped without the lock: a task may own anything, and dropping it may take long.
        drop(replaced);
    }
}

impl Drop for LatestTask {
    fn drop(&mut self) {
        // The owner has ended, so the waiting task has no use.
        // Bound to a name, so that it is dropped after the lock.
        let _next = self.0.lock().next.take();
    }
}

/// Runs tasks until none waits.
fn run_all(shared: &Mutex<State>) {
    loop {
        let next = {
            let mut state = shared.lock();
            // A `submit` after this starts another thread.
            state.running = state.next.is_some();
            state.next.take()
        };
        let Some(task) = next else { return };
        // A panic is logged where it happens, and the next task runs all the same.
        let _panic = catch_unwind(AssertUnwindSafe(task));
    }
}

impl std::fmt::Debug for State {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("State").field("running", &self.running).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::channel;

    #[tokio::test]
    async fn one_task_runs_at_a_time_and_then_the_latest() {
        let tasks = LatestTask::default();
        let (first_started, wait_for_first) = channel();
        let (release_first, wait_for_release) = channel();
        let (report, reported) = channel();
        tasks.submit(move || {
            first_started.send(()).unwrap();
            wait_for_release.recv().unwrap();
            panic!("this panic is part of the test");
        });
        wait_for_first.recv().unwrap();
        for number in 0..1000 {
            let report = report.clone();
            tasks.submit(move || report.send(number).unwrap());
        }
        assert!(reported.try_recv().is_err(), "the first task still runs");
        release_first.send(()).unwrap();
        // Each task replaced the one that waited before it.
        assert_eq!(reported.recv().unwrap(), 999);
        drop(report);
        assert!(reported.recv().is_err(), "no other task was kept");
    }
}
