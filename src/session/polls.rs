//! How long the threads that answer requests are held up.
//!
//! A task holds its thread from the beginning of a poll to its end: everything else on this thread
//! waits. So long work and work that waits for a disk belong on other threads
//! ([`run_blocking`](crate::run_blocking)). Each task of a server is spawned by [`Polls::spawn`],
//! which measures all its polls. tokio measures the same only when it is built with
//! `tokio_unstable`.

use std::cell::Cell;
use std::fs;
use std::future::poll_fn;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tokio::task::JoinHandle;

use crate::limits;

/// Upper bounds of the counted polls, in milliseconds. Longer ones count in a last bucket.
const BOUNDS_MS: [u64; 9] = [1, 2, 5, 10, 20, 50, 100, 200, 500];

/// A poll that took less is measured by the clock alone. Also how old the waiting time of a thread
/// may be when a poll begins.
const SHORT: Duration = Duration::from_millis(5);

/// The polls of all tasks of a server.
#[derive(Debug, Default)]
pub struct Polls {
    counts: [AtomicU64; BOUNDS_MS.len() + 1],
    total_ns: AtomicU64,
    longest_ns: AtomicU64,
}

/// The polls until some moment.
#[derive(Clone, Debug, PartialEq)]
pub struct PollTimes {
    /// Polls of at most some seconds that were longer than the bound before. The last bound is
    /// infinite.
    pub counts: Vec<(f64, u64)>,
    pub total: Duration,
    pub longest: Duration,
}

impl Polls {
    /// Spawns a task and measures its polls. `task` names it in the log.
    pub fn spawn<F>(self: &Arc<Self>, task: &'static str, future: F) -> JoinHandle<F::Output>
    where
        F: Future<Output: Send> + Send + 'static,
    {
        let polls = self.clone();
        // Boxed at once: that of a connection is large, and each further layer would copy it on the
        // stack.
        let mut future = Box::pin(future);
        tokio::spawn(poll_fn(move |context| {
            let poll = Running::begin();
            let polled = future.as_mut().poll(context);
            polls.add(task, poll.held());
            polled
        }))
    }

    fn add(&self, task: &'static str, held: Duration) {
        let bucket = BOUNDS_MS.iter().position(|&ms| held <= Duration::from_millis(ms));
        self.counts[bucket.unwrap_or(BOUNDS_MS.len())].fetch_add(1, Ordering::Relaxed);
        // 584 years fit.
        let held_ns = held.as_nanos() as u64;
        self.total_ns.fetch_add(held_ns, Ordering::Relaxed);
        let longest_ns = self.longest_ns.fetch_max(held_ns, Ordering::Relaxed);
        // Only records, so that a server that is always late does not fill its log.
        if held > limits::LONGEST_POLL && held_ns > longest_ns {
            tracing::warn!(task, ?held, "a task held up other requests: please report this defect");
        }
    }

    /// The polls until now.
    pub fn times(&self) -> PollTimes {
        let bounds = BOUNDS_MS.iter().map(|&ms| ms as f64 / 1e3).chain([f64::INFINITY]);
        let counts = self.counts.iter().map(|count| count.load(Ordering::Relaxed));
        PollTimes {
            counts: bounds.zip(counts).collect(),
            total: Duration::from_nanos(self.total_ns.load(Ordering::Relaxed)),
            longest: Duration::from_nanos(self.longest_ns.load(Ordering::Relaxed)),
        }
    }
}

/// A poll that has begun.
struct Running {
    begun: Instant,
    /// How long the thread had waited for a processor before.
    waited: Duration,
}

thread_local! {
    /// How long this thread had waited for a processor, and when that was read.
    static WAITED: Cell<Option<(Instant, Duration)>> = const { Cell::new(None) };
}

impl Running {
    fn begin() -> Self {
        let begun = Instant::now();
        // Reading takes some microseconds, and a poll often less: the time of a short while ago
        // does as well.
        let waited = match WAITED.get() {
            Some((read, waited)) if begun.saturating_duration_since(read) < SHORT => waited,
            _ => {
                let waited = waited();
                WAITED.set(Some((begun, waited)));
                waited
            }
        };
        Self { begun, waited }
    }

    /// How long the poll has held its thread, less what the operating system gave its processor to
    /// others: that is no fault of the task.
    fn held(&self) -> Duration {
        let took = self.begun.elapsed();
        if took < SHORT { took } else { took.saturating_sub(waited().saturating_sub(self.waited)) }
    }
}

/// How long this thread has waited for a processor: the second number of `schedstat`
/// ([documentation](https://docs.kernel.org/scheduler/sched-stats.html)). Systems other than Linux
/// do not say, and count as ones on which it never waits.
fn waited() -> Duration {
    let waited_ns = fs::read_to_string("/proc/thread-self/schedstat")
        .ok()
        .and_then(|text| text.split_whitespace().nth(1)?.parse().ok());
    Duration::from_nanos(waited_ns.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use std::thread::sleep;

    use tokio::task::yield_now;

    use super::*;

    #[tokio::test]
    async fn a_task_that_blocks_its_thread_is_noticed() {
        let polls = Arc::new(Polls::default());
        let blocking = Duration::from_millis(60);
        let task = async move {
            yield_now().await;
            sleep(blocking);
            yield_now().await;
        };
        polls.spawn("blocks", task).await.unwrap();
        let times = polls.times();
        assert!(times.longest >= blocking && times.total >= times.longest, "{times:?}");
        assert_eq!(times.counts.iter().map(|(_, count)| count).sum::<u64>(), 3);
        let long = |(bound_s, count): &&(f64, u64)| *bound_s > 0.05 && *count > 0;
        assert_eq!(times.counts.iter().filter(long).count(), 1, "{times:?}");
    }

    #[tokio::test]
    async fn a_task_that_waits_is_not() {
        let polls = Arc::new(Polls::default());
        polls.spawn("waits", tokio::time::sleep(Duration::from_millis(60))).await.unwrap();
        let waiting = polls.times().longest;
        polls.spawn("blocks", async { sleep(Duration::from_millis(60)) }).await.unwrap();
        assert!(waiting < polls.times().longest / 2, "{waiting:?} of {:?}", polls.times());
    }

    /// More threads than processors compute, so that each waits for most of the time.
    #[cfg(target_os = "linux")]
    #[test]
    fn what_others_take_does_not_count() {
        let threads = 4 * std::thread::available_parallelism().map_or(2, usize::from);
        let spun = || {
            let poll = Running::begin();
            while poll.begun.elapsed() < Duration::from_millis(400) {
                std::hint::spin_loop();
            }
            poll.held()
        };
        let held: Vec<Duration> = std::thread::scope(|scope| {
            let all: Vec<_> = (0..threads).map(|_| scope.spawn(spun)).collect();
            all.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        let sum: Duration = held.iter().sum();
        // A quarter each, and no more than half on average on a machine that does other things.
        assert!(sum < Duration::from_millis(200) * threads as u32, "{held:?}");
    }
}
