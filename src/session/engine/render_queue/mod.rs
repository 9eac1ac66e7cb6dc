//! The queue of frames in front of the render threads.
//!
//! There are as many render threads as the backend keeps frames in flight. The cpu backend renders
//! one, on all cores: two at once would take as long together and hold twice the memory. A GPU
//! renders one frame while the previous one is encoded. Frames of the sessions are scheduled fairly
//! ([`fair`]).
//!
//! **A frame of seconds does not keep the others waiting.** While a large frame is rendered,
//! another thread renders the small ones, if the backend can do both at once: the operating system
//! shares the cores among them.
//!
//! **A frame that cannot be ready in time is not started.** The time that large frames take per
//! sample is measured. A frame that cannot be done before its deadline is refused when it arrives,
//! or when it is next: otherwise a server with too many large frames would discard most of its
//! frames.

mod fair;
#[cfg(test)]
mod interleaved;
mod scratch;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use parking_lot::{Condvar, Mutex, MutexGuard};
use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};
use tracing::{Span, debug_span};

use wildcity_render::Backend;

use crate::error::SessionError;
use crate::limits;

pub use fair::FrameCost;
pub use scratch::Scratch;

use fair::FairQueue;

/// One frame that waits.
struct Job {
    deadline: Instant,
    work: Box<dyn FnOnce(&mut Scratch) + Send>,
}

/// The queue. On drop it waits for its render threads. Otherwise the last of them might drop the
/// backend while the process exits, and NVIDIA's driver crashes then.
pub(crate) struct RenderQueue {
    shared: Arc<Shared>,
}

struct Shared {
    backend: Arc<dyn Backend>,
    frames: Frames<Job, Condvar>,
}

/// The frames that wait, and what wakes the threads that wait for them. A test has another kind of
/// frames and another signal, and otherwise this code: a notification that is missing here is
/// missing there.
struct Frames<T, S> {
    state: Mutex<State<T>>,
    /// Signalled when a frame arrives, when a large frame is started, and when the queue is closed.
    changed: S,
}

/// Wakes all threads that wait for a change.
trait Signal {
    fn wake_all(&self);
}

impl Signal for Condvar {
    fn wake_all(&self) {
        self.notify_all();
    }
}

struct State<T> {
    queue: FairQueue<T>,
    is_closed: bool,
    /// Samples of the large frames that are being rendered.
    rendering: u64,
    /// Nanoseconds that a large frame takes per sample: a moving average; 0 before the first large
    /// frame.
    ns_per_sample: f64,
    /// Whether there is a thread for small frames.
    has_side_thread: bool,
    threads: Vec<JoinHandle<()>>,
}

/// What a render thread does after it has looked at the frames.
enum Looked<'a, T> {
    /// The queue is closed.
    Ends,
    /// It sleeps until it is woken; the lock is released when it does.
    Waits(MutexGuard<'a, State<T>>),
    /// It drops a frame that cannot be ready in time.
    Drops(T),
    Renders {
        cost: FrameCost,
        job: T,
    },
}

/// What a render thread does next.
enum Next<T> {
    /// The queue is closed.
    Ends,
    /// There is nothing for its lane until the state changes.
    Waits,
    /// A frame that cannot be ready in time.
    Drops(T),
    /// A frame. `wakes`: other lanes have to look again.
    Renders { cost: FrameCost, job: T, wakes: bool },
}

/// Which frames a render thread takes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Lane {
    Main,
    /// Renders small frames while a large one is rendered.
    Side,
}

impl RenderQueue {
    /// Starts the render threads.
    ///
    /// # Errors
    /// [`SessionError::Thread`] if one cannot be started.
    pub(crate) fn start(backend: Arc<dyn Backend>) -> Result<Self, SessionError> {
        // A backend that reports 0 still needs a thread that calls it.
        let threads = backend.frames_in_flight().max(1);
        let shared = Shared { backend, frames: Frames::new(Condvar::new()) };
        let queue = Self { shared: Arc::new(shared) };
        for number in 0..threads {
            let mut state = queue.shared.frames.state.lock();
            let name = format!("render-{number}");
            queue.shared.clone().start_thread(&mut state, name, Lane::Main)?;
        }
        Ok(queue)
    }

    /// Jobs that wait for a render thread.
    pub(crate) fn len(&self) -> usize {
        self.shared.frames.state.lock().queue.len()
    }

    /// Runs `work` on a render thread. Returns its result and how long it was queued.
    ///
    /// # Errors
    /// [`SessionError::Busy`] if the queue is full, or earlier frames leave it no time;
    /// [`SessionError::Crashed`] if `work` panicked; and [`SessionError::DeadlineExceeded`] if
    /// there is no result by the deadline. Work that has not started by then never starts; work
    /// that has is finished, and its result is discarded.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        cost: FrameCost,
        deadline: Instant,
        work: impl FnOnce(&mut Scratch, &dyn Backend) -> T + Send + 'static,
    ) -> Result<(T, Duration), SessionError> {
        let (reply, answer) = oneshot::channel();
        // The work runs on a thread that has no span, so that the request's span is taken along.
        let within = Span::current();
        let waiting = debug_span!("queue");
        let requested = Instant::now();
        let backend = self.shared.backend.clone();
        let job = move |scratch: &mut Scratch| {
            let queued = requested.elapsed();
            drop(waiting);
            // The session gave up while the frame waited: its deadline passed, or the request was
            // cancelled.
            if reply.is_closed() {
                return;
            }
            // A panic in one session's frame must not end the thread that renders for all sessions.
            let work = || work(scratch, &*backend);
            let rendering = debug_span!(parent: &within, "render", samples = cost.samples);
            let result = catch_unwind(AssertUnwindSafe(|| rendering.in_scope(work)));
            // Sending fails if the deadline has passed and the receiver is gone.
            let _ = reply.send(result.map(|result| (result, queued)));
        };
        self.shared.add(cost, Job { deadline, work: Box::new(job) })?;
        match timeout_at(deadline, answer).await {
            Ok(Ok(Ok(result))) => Ok(result),
            Ok(Ok(Err(_panic))) => Err(SessionError::Crashed),
            // The job was dropped without a reply: it could not be done by its deadline.
            Ok(Err(_)) | Err(_) => Err(SessionError::DeadlineExceeded),
        }
    }
}

impl Drop for RenderQueue {
    fn drop(&mut self) {
        let threads = self.shared.frames.close();
        // A driver that hangs must not keep the process alive.
        let deadline = Instant::now() + limits::LAST_FRAME_TIMEOUT;
        for thread in threads {
            // A join of std has no timeout.
            while !thread.is_finished() && Instant::now() < deadline {
                thread::sleep(Duration::from_millis(1));
            }
            if thread.is_finished() {
                // A panic of a frame was caught in the thread.
                let _ = thread.join();
            }
        }
    }
}

impl Shared {
    fn start_thread(
        self: Arc<Self>,
        state: &mut State<Job>,
        name: String,
        lane: Lane,
    ) -> Result<(), SessionError> {
        let body = move || self.run_jobs(lane);
        let thread = thread::Builder::new()
            .name(name)
            .spawn(body)
            .map_err(|error| SessionError::Thread { reason: error.to_string() })?;
        state.threads.push(thread);
        Ok(())
    }

    fn add(self: &Arc<Self>, cost: FrameCost, job: Job) -> Result<(), SessionError> {
        let deadline = job.deadline;
        self.frames.add(cost, job, Instant::now(), deadline, |state| {
            // The thread is only useful if the backend can render two frames at once, and only
            // needed once there is a large frame.
            let is_needed = state.rendering > 0 && !state.has_side_thread;
            if is_needed && self.backend.renders_beside() {
                // Without the thread, small frames wait for the large one.
                let name = "render-side".to_owned();
                state.has_side_thread = self.clone().start_thread(state, name, Lane::Side).is_ok();
            }
        })
    }

    /// The body of a render thread: runs one job after the other until the queue is closed.
    fn run_jobs(&self, lane: Lane) {
        let mut scratch = Scratch::default();
        while let Some((cost, job)) = self.next(lane) {
            let begun = Instant::now();
            (job.work)(&mut scratch);
            // After the answer, which does not wait for memory to be freed.
            scratch.free_excess();
            if is_large(cost) {
                self.frames.state.lock().rendered(cost, begun.elapsed());
            }
        }
    }

    /// Waits for the next job of a lane that can be done in time; `None` once the queue is closed.
    fn next(&self, lane: Lane) -> Option<(FrameCost, Job)> {
        let Frames { state, changed } = &self.frames;
        let mut locked = state.lock();
        loop {
            match self.frames.look(locked, lane, Instant::now(), |job| job.deadline) {
                Looked::Ends => return None,
                // Every change wakes every thread; one that finds nothing for its lane sleeps
                // again.
                Looked::Waits(mut waiting) => {
                    changed.wait(&mut waiting);
                    locked = waiting;
                }
                Looked::Drops(job) => {
                    // This answers its session.
                    drop(job);
                    locked = state.lock();
                }
                Looked::Renders { cost, job } => return Some((cost, job)),
            }
        }
    }
}

impl<T, S: Signal> Frames<T, S> {
    fn new(changed: S) -> Self {
        Self { state: Mutex::new(State::new()), changed }
    }

    /// Adds a frame. `also` changes the state with it.
    ///
    /// # Errors
    /// As [`State::add`].
    fn add(
        &self,
        cost: FrameCost,
        job: T,
        now: Instant,
        deadline: Instant,
        also: impl FnOnce(&mut State<T>),
    ) -> Result<(), SessionError> {
        let mut state = self.state.lock();
        state.add(cost, job, now, deadline)?;
        also(&mut state);
        drop(state);
        self.changed.wake_all();
        Ok(())
    }

    /// What a thread of a lane does, which has the lock.
    fn look<'a>(
        &'a self,
        mut state: MutexGuard<'a, State<T>>,
        lane: Lane,
        now: Instant,
        deadline: impl Fn(&T) -> Instant,
    ) -> Looked<'a, T> {
        match state.next(lane, now, deadline) {
            Next::Ends => Looked::Ends,
            Next::Waits => Looked::Waits(state),
            Next::Drops(job) => Looked::Drops(job),
            Next::Renders { cost, job, wakes } => {
                // Unlocked first, so that the threads that wake up do not wait for the lock.
                drop(state);
                if wakes {
                    self.changed.wake_all();
                }
                Looked::Renders { cost, job }
            }
        }
    }

    /// Closes the queue: all threads end. Returns them.
    fn close(&self) -> Vec<JoinHandle<()>> {
        let mut state = self.state.lock();
        state.is_closed = true;
        // The threads need the lock to see that the queue is closed, so it is not held while they
        // end.
        let threads = std::mem::take(&mut state.threads);
        drop(state);
        self.changed.wake_all();
        threads
    }
}

impl<T> State<T> {
    fn new() -> Self {
        Self {
            queue: FairQueue::default(),
            is_closed: false,
            rendering: 0,
            ns_per_sample: 0.0,
            has_side_thread: false,
            threads: Vec::new(),
        }
    }

    /// Adds a frame, after which every thread has to look at the queue.
    ///
    /// # Errors
    /// [`SessionError::Busy`]: the queue is full, or the frame cannot be ready in time.
    fn add(
        &mut self,
        cost: FrameCost,
        job: T,
        now: Instant,
        deadline: Instant,
    ) -> Result<(), SessionError> {
        if self.queue.len() >= limits::QUEUED_FRAMES {
            return Err(SessionError::Busy { what: "frames queued" });
        }
        // Small frames are not refused for their time: it is not measured, and short.
        if is_large(cost) {
            // On average, half of a frame that is being rendered is still to be done. The sum has
            // at most 2⁹ frames of 2²⁹ samples.
            let before = self.rendering / 2 + self.queue.samples_above(limits::LARGE_SAMPLES);
            if now + self.time_for(before.saturating_add(cost.samples)) > deadline {
                return Err(SessionError::Busy { what: "samples queued" });
            }
        }
        self.queue.push(cost, job);
        Ok(())
    }

    /// What a thread of a lane does next.
    fn next(&mut self, lane: Lane, now: Instant, deadline: impl Fn(&T) -> Instant) -> Next<T> {
        // First of all: frames that still wait are dropped with the queue, and their sessions get
        // an error.
        if self.is_closed {
            return Next::Ends;
        }
        let most_samples = match lane {
            // While no large frame is rendered, the main lane serves all frames, and the side lane
            // sleeps.
            Lane::Main => Some(u64::MAX),
            Lane::Side => (self.rendering > 0).then_some(limits::LARGE_SAMPLES),
        };
        let Some((cost, job)) = most_samples.and_then(|most| self.queue.pop(most)) else {
            return Next::Waits;
        };
        // The time of a small frame is unknown: it begins unless its deadline has passed already.
        let needed = if is_large(cost) { self.time_for(cost.samples) } else { Duration::ZERO };
        if now + needed >= deadline(&job) {
            return Next::Drops(job);
        }
        if is_large(cost) {
            self.rendering += cost.samples;
        }
        Next::Renders { cost, job, wakes: is_large(cost) }
    }

    /// Expected time to render some samples of large frames.
    fn time_for(&self, samples: u64) -> Duration {
        Duration::from_secs_f64(samples as f64 * self.ns_per_sample * 1e-9)
    }

    /// Notes that a large frame was rendered.
    fn rendered(&mut self, cost: FrameCost, took: Duration) {
        // `next` added them, so that this does not underflow.
        self.rendering -= cost.samples;
        let measured = took.as_secs_f64() * 1e9 / cost.samples as f64;
        // The last frame counts a quarter: after eight frames of another speed, the average is 90 %
        // theirs (1 - 0.75⁸).
        let is_first = self.ns_per_sample == 0.0;
        self.ns_per_sample =
            if is_first { measured } else { 0.75 * self.ns_per_sample + 0.25 * measured };
    }
}

/// Whether a frame takes so long that small ones do not wait for it.
fn is_large(cost: FrameCost) -> bool {
    cost.samples > limits::LARGE_SAMPLES
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_render::{Frame, FrameStats, OnViewDone, RenderError, Target};

    /// Renders nothing, and reports a given number of frames in flight.
    struct IdleBackend {
        frames_in_flight: usize,
    }

    impl Backend for IdleBackend {
        fn name(&self) -> &'static str {
            "idle"
        }

        fn renders_beside(&self) -> bool {
            true
        }

        fn frames_in_flight(&self) -> usize {
            self.frames_in_flight
        }

        fn render(
            &self,
            _: &Frame<'_>,
            _: &mut [Target<'_>],
            _: OnViewDone<'_>,
        ) -> Result<FrameStats, RenderError> {
            Ok(FrameStats::default())
        }
    }

    const SMALL: FrameCost = FrameCost { session: 0, samples: 768 };

    /// How many jobs run now, and the most that ever ran at once.
    #[derive(Default)]
    struct Running {
        now: usize,
        most: usize,
    }

    #[tokio::test]
    async fn as_many_frames_run_at_once_as_the_backend_renders() {
        for frames_in_flight in [1, 3] {
            let queue = RenderQueue::start(Arc::new(IdleBackend { frames_in_flight })).unwrap();
            let running = Arc::new(Mutex::new(Running::default()));
            let jobs = (0..frames_in_flight + 3).map(|_| {
                let running = running.clone();
                queue.run(SMALL, Instant::now() + limits::STEP_TIMEOUT, move |_, _| {
                    let begun = Instant::now();
                    let most = || {
                        let mut running = running.lock();
                        running.most = running.most.max(running.now);
                        running.most
                    };
                    running.lock().now += 1;
                    // Wait for the others that should run now, and a little longer for one too
                    // many.
                    while most() < frames_in_flight && begun.elapsed() < Duration::from_secs(10) {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    std::thread::sleep(Duration::from_millis(20));
                    most();
                    running.lock().now -= 1;
                })
            });
            for result in futures_util::future::join_all(jobs).await {
                result.unwrap();
            }
            let running = running.lock();
            assert_eq!((running.now, running.most), (0, frames_in_flight));
        }
    }

    fn large(session: u64) -> FrameCost {
        FrameCost { session, samples: 2 * limits::LARGE_SAMPLES }
    }

    /// Twelve sessions with large frames of 100 ms, and one with small frames of 1 ms.
    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn small_frames_do_not_wait_for_large_ones() {
        let backend = Arc::new(IdleBackend { frames_in_flight: 1 });
        let queue = Arc::new(RenderQueue::start(backend).unwrap());
        let end = Instant::now() + Duration::from_secs(2);
        let sleeping = |cost: FrameCost, time: Duration| {
            let queue = queue.clone();
            async move {
                let mut steps = 0;
                while Instant::now() < end {
                    let work = move |_: &mut Scratch, _: &dyn Backend| std::thread::sleep(time);
                    queue.run(cost, Instant::now() + limits::STEP_TIMEOUT, work).await.unwrap();
                    steps += 1;
                }
                steps
            }
        };
        let each = (1..=12).map(|session| sleeping(large(session), Duration::from_millis(100)));
        let all = futures_util::future::join_all(each);
        let small = sleeping(SMALL, Duration::from_millis(1));
        let (large_steps, small_steps) = tokio::join!(all, small);
        // Alone, large frames would be 20, and the last of each session ends after the end.
        let large_steps: usize = large_steps.iter().sum();
        assert!(large_steps >= 18, "{large_steps} large frames");
        // Its share of an otherwise idle renderer would be 2,000.
        assert!(small_steps >= 500, "{small_steps} small frames");
    }

    /// Frames that cannot be ready by their deadline take no time from those that can.
    #[tokio::test]
    async fn frames_without_time_are_refused_and_not_begun() {
        let queue = RenderQueue::start(Arc::new(IdleBackend { frames_in_flight: 1 })).unwrap();
        let begun = Arc::new(Mutex::new(0));
        let run = async |session: u64, time: Duration| {
            let begun = begun.clone();
            let work = move |_: &mut Scratch, _: &dyn Backend| {
                *begun.lock() += 1;
                std::thread::sleep(Duration::from_millis(100));
            };
            queue.run(large(session), Instant::now() + time, work).await.map(|_| ())
        };
        // The first one is the measure.
        run(0, limits::STEP_TIMEOUT).await.unwrap();
        // Time for three frames of 100 ms, and for some delay.
        let time = Duration::from_millis(350);
        let runs = futures_util::future::join_all((1..=12).map(|session| run(session, time))).await;
        let ready = runs.iter().filter(|result| result.is_ok()).count();
        assert!((2..=4).contains(&ready), "{ready} of 12 are ready");
        for result in runs.iter().filter_map(|result| result.as_ref().err()) {
            let is_refused =
                matches!(result, SessionError::Busy { .. } | SessionError::DeadlineExceeded);
            assert!(is_refused, "{result}");
        }
        assert_eq!(*begun.lock(), 1 + ready, "nothing was rendered in vain");
    }
}
