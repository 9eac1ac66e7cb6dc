//! The queue of frames in front of the render threads.
//!
//! There are as many render threads as the backend keeps frames in flight. The cpu backend renders one,
//! on all cores: two at once would take as long together and hold twice the memory. A GPU renders one
//! frame while the one before is encoded. Frames start in the order of the requests, and a session
//! requests one at a time, so that sessions take turns.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, timeout_at};

use wildcity_render::Backend;

use crate::error::SessionError;
use crate::limits;

/// Buffers for RGB images that are encoded and then discarded. A render thread keeps its own between
/// frames, so that no step allocates them.
pub type Scratch = Vec<Vec<u8>>;

type Job = Box<dyn FnOnce(&mut Scratch) + Send>;

/// The sending end of the queue. The render threads end when it is dropped.
pub(crate) struct RenderQueue {
    jobs: mpsc::Sender<Job>,
    backend: Arc<dyn Backend>,
}

impl RenderQueue {
    /// Starts the render threads.
    ///
    /// # Errors
    /// [`SessionError::Thread`] if one cannot be started.
    pub(crate) fn start(backend: Arc<dyn Backend>) -> Result<Self, SessionError> {
        let (jobs, receiver) = mpsc::channel::<Job>(limits::QUEUED_FRAMES);
        let receiver = Arc::new(Mutex::new(receiver));
        for number in 0..backend.frames_in_flight().max(1) {
            let receiver = receiver.clone();
            std::thread::Builder::new()
                .name(format!("render-{number}"))
                .spawn(move || run_jobs(&receiver))
                .map_err(|error| SessionError::Thread { reason: error.to_string() })?;
        }
        Ok(Self { jobs, backend })
    }

    /// The backend that the render threads use.
    pub(crate) fn backend(&self) -> &dyn Backend {
        &*self.backend
    }

    /// Jobs that wait for a render thread.
    pub(crate) fn len(&self) -> usize {
        self.jobs.max_capacity() - self.jobs.capacity()
    }

    /// Runs `work` on a render thread. Returns its result and how long it was queued.
    ///
    /// # Errors
    /// [`SessionError::Busy`] if the queue is full, [`SessionError::Crashed`] if `work` panicked, and
    /// [`SessionError::DeadlineExceeded`] if there is no result by the deadline. Work that has not
    /// started by then never starts; work that has is finished, and its result is discarded.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        deadline: Instant,
        work: impl FnOnce(&mut Scratch, &dyn Backend) -> T + Send + 'static,
    ) -> Result<(T, Duration), SessionError> {
        let (reply, answer) = oneshot::channel();
        let requested = Instant::now();
        let backend = self.backend.clone();
        let job = move |scratch: &mut Scratch| {
            let queued = requested.elapsed();
            if reply.is_closed() || Instant::now() >= deadline {
                return;
            }
            // A panic in one session's frame must not end the thread that renders for all sessions.
            let result = catch_unwind(AssertUnwindSafe(|| work(scratch, &*backend)));
            // Sending fails if the deadline has passed and the receiver is gone.
            let _ = reply.send(result.map(|result| (result, queued)));
        };
        self.jobs.try_send(Box::new(job)).map_err(|error| match error {
            mpsc::error::TrySendError::Full(_) => SessionError::Busy { what: "frames queued" },
            mpsc::error::TrySendError::Closed(_) => SessionError::Crashed,
        })?;
        match timeout_at(deadline, answer).await {
            Ok(Ok(Ok(result))) => Ok(result),
            Ok(Ok(Err(_panic))) => Err(SessionError::Crashed),
            // The job was dropped without a reply: its deadline had passed.
            Ok(Err(_)) | Err(_) => Err(SessionError::DeadlineExceeded),
        }
    }
}

/// The body of a render thread: runs one job after the other until the queue is closed.
fn run_jobs(receiver: &Mutex<mpsc::Receiver<Job>>) {
    let mut scratch = Scratch::new();
    // One idle thread waits while it holds the lock and takes the next job; the others wait for the lock.
    let next = || receiver.lock().blocking_recv();
    while let Some(job) = next() {
        job(&mut scratch);
        free_large(&mut scratch);
    }
}

/// Frees the buffers that only unusually large images need.
fn free_large(scratch: &mut Scratch) {
    scratch.retain(|image| image.capacity() <= limits::SCRATCH_IMAGE_BYTES);
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_render::{Frame, FrameStats, OnViewDone, RenderError, Target};

    #[test]
    fn buffers_of_unusually_large_images_are_freed() {
        let mut scratch = vec![vec![0; limits::SCRATCH_IMAGE_BYTES + 1], vec![0; 1000]];
        free_large(&mut scratch);
        assert_eq!(scratch, [vec![0; 1000]]);
    }

    /// Renders nothing, and reports a given number of frames in flight.
    struct IdleBackend {
        frames_in_flight: usize,
    }

    impl Backend for IdleBackend {
        fn name(&self) -> &'static str {
            "idle"
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
                queue.run(Instant::now() + limits::STEP_TIMEOUT, move |_, _| {
                    let begun = Instant::now();
                    let most = || {
                        let mut running = running.lock();
                        running.most = running.most.max(running.now);
                        running.most
                    };
                    running.lock().now += 1;
                    // Wait for the others that should run now, and a little longer for one too many.
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
}
