//! Runs tasks in the background, one at a time. Only the latest task waits; a new one replaces it.
//! The one that runs can ask whether its owner has ended.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use parking_lot::Mutex;

/// Runs one task after the other in the background; its owner never waits for them.
#[derive(Debug, Default)]
pub(crate) struct LatestTask {
    state: Arc<Mutex<State>>,
    has_ended: Arc<AtomicBool>,
}

#[derive(Default)]
struct State {
    /// A blocking thread runs a task, and takes `next` when that is done.
    running: bool,
    next: Option<Task>,
}

/// Gets what tells whether its owner still wants it.
type Task = Box<dyn FnOnce(&dyn Fn() -> bool) + Send>;

impl LatestTask {
    /// Runs a task soon, instead of a task that still waits.
    pub(crate) fn submit(&self, task: impl FnOnce(&dyn Fn() -> bool) + Send + 'static) {
        let replaced = {
            let mut state = self.state.lock();
            // The flag changes only under the lock under which `next` is looked at: a task that
            // waits always has a thread that will take it.
            if !state.running {
                state.running = true;
                let shared = self.state.clone();
                let has_ended = self.has_ended.clone();
                // The end of the thread is not awaited.
                drop(tokio::task::spawn_blocking(move || run_all(&shared, &has_ended)));
            }
            state.next.replace(Box::new(task))
        };
        // Dropped without the lock: a task may own anything, and dropping it may take long.
        drop(replaced);
    }
}

impl Drop for LatestTask {
    fn drop(&mut self) {
        // The owner has ended, so neither the running task nor the waiting one has any use.
        self.has_ended.store(true, Relaxed);
        // Bound to a name, so that it is dropped after the lock.
        let _next = self.state.lock().next.take();
    }
}

/// Runs tasks until none waits.
fn run_all(shared: &Mutex<State>, has_ended: &AtomicBool) {
    let is_wanted = || !has_ended.load(Relaxed);
    loop {
        let next = {
            let mut state = shared.lock();
            // A `submit` after this starts another thread.
            state.running = state.next.is_some();
            state.next.take()
        };
        let Some(task) = next else { return };
        // A panic is logged where it happens, and the next task runs all the same.
        let _panic = catch_unwind(AssertUnwindSafe(|| task(&is_wanted)));
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
        tasks.submit(move |_| {
            first_started.send(()).unwrap();
            wait_for_release.recv().unwrap();
            panic!("this panic is part of the test");
        });
        wait_for_first.recv().unwrap();
        for number in 0..1000 {
            let report = report.clone();
            tasks.submit(move |_| report.send(number).unwrap());
        }
        assert!(reported.try_recv().is_err(), "the first task still runs");
        release_first.send(()).unwrap();
        // Each task replaced the one that waited before it.
        assert_eq!(reported.recv().unwrap(), 999);
        drop(report);
        assert!(reported.recv().is_err(), "no other task was kept");
    }

    #[tokio::test]
    async fn a_task_learns_that_its_owner_has_ended() {
        let tasks = LatestTask::default();
        let (report, reported) = channel();
        tasks.submit(move |is_wanted| {
            report.send(is_wanted()).unwrap();
            while is_wanted() {
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            report.send(is_wanted()).unwrap();
        });
        assert!(reported.recv().unwrap());
        drop(tasks);
        let wait = std::time::Duration::from_secs(10);
        assert!(!reported.recv_timeout(wait).unwrap());
    }
}
