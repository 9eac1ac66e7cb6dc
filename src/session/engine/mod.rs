//! What all sessions share: the twins in memory, the backend, and one queue for the renderer.

mod leases;
pub(crate) mod twin_summaries;

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, sleep, timeout_at};

use crate::limits;
use wildcity_render::Backend;
use wildcity_scene::RenderProfile;
use wildcity_twin::residency::{
    Cache, Prefetcher, Reservation, ResidencyError, Resident, RigExtent, Stats, Urgency, Viewpoint,
};
use wildcity_twin::store::Catalog;

use self::leases::Leases;
use self::twin_summaries::{SummaryCache, TwinSummary};
use crate::error::SessionError;

/// What an engine is made of.
pub struct EngineSettings {
    /// The twins that can be opened, and the memory for them.
    pub cache: Cache,
    /// Where episodes are recorded.
    pub episodes: PathBuf,
    /// What renders.
    pub backend: Arc<dyn Backend>,
    /// How long one step may take, waiting included.
    pub step_timeout: Duration,
}

/// The renderer and the twins, shared by all sessions.
///
/// As many frames are drawn at a time as the backend wants. The cpu backend draws one, on all cores:
/// two at once would take as long together and hold twice the memory. A GPU draws one while the one
/// before is encoded. Frames are begun in the order in which they were asked for, and a session asks
/// for one at a time, so that sessions take turns.
pub struct Engine {
    listings: Arc<SummaryCache>,
    cache: Cache,
    leases: Arc<Leases>,
    episodes: PathBuf,
    backend: Arc<dyn Backend>,
    step_timeout: Duration,
    jobs: mpsc::Sender<Job>,
    answers: AnswerBudget,
    /// By twin: the version that counts as its latest, while a newer one is made ready.
    held: Mutex<BTreeMap<String, u64>>,
}

/// Keeps what is the latest version of a twin, until dropped.
pub struct LatestPin {
    engine: Arc<Engine>,
    twin: String,
}

/// RGB images that are encoded and forgotten: kept between frames, so that no step allocates them.
pub(crate) type Scratch = Vec<Vec<u8>>;

type Job = Box<dyn FnOnce(&mut Scratch) + Send>;

/// The budget of bytes for answers that are made, sent or kept.
#[derive(Clone, Debug, Default)]
pub(crate) struct AnswerBudget(Arc<AtomicU64>);

/// A part of the budget, given back when dropped.
#[derive(Debug)]
pub(crate) struct BudgetShare {
    answers: AnswerBudget,
    bytes: u64,
}

impl Engine {
    /// Starts the render threads, one for each frame that the backend takes at once. They end when
    /// the engine is dropped.
    ///
    /// # Errors
    /// A thread cannot be started.
    pub fn start(settings: EngineSettings) -> Result<Arc<Self>, SessionError> {
        let EngineSettings { cache, episodes, backend, step_timeout } = settings;
        let (jobs, queue) = mpsc::channel::<Job>(limits::QUEUED_FRAMES);
        let queue = Arc::new(Mutex::new(queue));
        for number in 0..backend.frames_in_flight().max(1) {
            let queue = queue.clone();
            std::thread::Builder::new()
                .name(format!("render-{number}"))
                .spawn(move || draw_all(&queue))
                .map_err(|error| SessionError::Thread { reason: error.to_string() })?;
        }
        let listings = Arc::new(SummaryCache::new(cache.catalog().clone()));
        Ok(Arc::new(Self {
            listings,
            leases: Arc::new(Leases::new(cache.catalog().clone())),
            cache,
            episodes,
            backend,
            step_timeout,
            jobs,
            answers: AnswerBudget::default(),
            held: Mutex::default(),
        }))
    }

    /// The version of every twin that whoever opens it gets, in order of name. A damaged one is logged
    /// and left out, so that it does not hide the others.
    ///
    /// # Errors
    /// The directory of twins cannot be read.
    pub async fn twins(self: &Arc<Self>) -> Result<Vec<Arc<TwinSummary>>, SessionError> {
        let engine = self.clone();
        let listed = tokio::task::spawn_blocking(move || {
            engine.listings.read(&|twin| engine.pinned_latest(twin))
        });
        Ok(listed.await.map_err(|_| SessionError::Crashed)??)
    }

    /// Whether twins can be listed.
    ///
    /// # Errors
    /// The directory of twins cannot be read.
    pub async fn check_twins(&self) -> Result<(), SessionError> {
        let listings = self.listings.clone();
        let checked = tokio::task::spawn_blocking(move || listings.check());
        Ok(checked.await.map_err(|_| SessionError::Crashed)??)
    }

    /// The twins that can be opened.
    pub fn catalog(&self) -> &Catalog {
        self.cache.catalog()
    }

    /// Tells the store which versions are still in use, so that no garbage is made of them. For a server
    /// to call every [`limits::LEASE_RENEWAL`].
    ///
    /// # Errors
    /// The store cannot be told. What it was told before holds for [`limits::LEASE`].
    pub async fn renew_leases(&self) -> Result<(), SessionError> {
        let leases = self.leases.clone();
        let renewed = tokio::task::spawn_blocking(move || leases.renew());
        Ok(renewed.await.map_err(|_| SessionError::Crashed)??)
    }

    /// Frames that wait for the renderer.
    pub fn queued_frames(&self) -> usize {
        self.jobs.max_capacity() - self.jobs.capacity()
    }

    /// Lets a version be the latest of its twin for whoever opens it, whatever is committed meanwhile.
    pub fn pin_latest(self: &Arc<Self>, twin: &str, number: u64) -> LatestPin {
        lock(&self.held).insert(twin.to_owned(), number);
        LatestPin { engine: self.clone(), twin: twin.to_owned() }
    }

    /// The version that is held, where one is.
    pub fn pinned_latest(&self, twin: &str) -> Option<u64> {
        lock(&self.held).get(twin).copied()
    }

    /// Where a version is held, holds another in its place: one that was made the latest on purpose.
    pub fn move_latest_pin(&self, twin: &str, number: u64) {
        if let Some(held) = lock(&self.held).get_mut(twin) {
            *held = number;
        }
    }

    /// Opens a version and loads what frames of it need, for those who will switch to it where they
    /// are: they need not wait. Only as far as there is room beside what sessions look at and expect,
    /// whose frames go first, and for no longer than `limits::PREFETCH_TIMEOUT`.
    ///
    /// # Errors
    /// It cannot be opened.
    pub async fn prepare(
        self: &Arc<Self>,
        twin: &str,
        number: u64,
        frames: Vec<Vec<Viewpoint>>,
    ) -> Result<(), SessionError> {
        let resident = self.resident(twin.to_owned(), Some(number)).await?;
        let deadline = Instant::now() + limits::PREFETCH_TIMEOUT;
        let prefetcher = Arc::new(Prefetcher::new(resident));
        let expected = prefetcher.clone();
        let expect = move || {
            let places: Vec<_> = frames.into_iter().map(|eyes| (Urgency::Imminent, eyes)).collect();
            expected.prefetch(&places, &expected.resident().version.manifest.profile);
        };
        tokio::task::spawn_blocking(expect).await.map_err(|_| SessionError::Crashed)?;
        while prefetcher.pending() > 0 && Instant::now() < deadline {
            sleep(limits::PREPARE_POLL).await;
        }
        Ok(())
    }

    /// Name of the backend.
    pub fn backend(&self) -> &'static str {
        self.backend.name()
    }

    /// What else of the backend pixels depend on.
    pub(crate) fn backend_detail(&self) -> String {
        self.backend.detail()
    }

    /// What the pager did so far, and the memory that twins take now.
    pub fn residency(&self) -> Stats {
        self.cache.stats()
    }

    /// A version of a twin, or its latest. None of its Gaussians need be in memory.
    pub(crate) async fn resident(
        self: &Arc<Self>,
        twin: String,
        version: Option<u64>,
    ) -> Result<Arc<Resident>, SessionError> {
        let engine = self.clone();
        let version = version.or_else(|| self.pinned_latest(&twin));
        let opened = tokio::task::spawn_blocking(move || {
            let resident = engine.cache.open(&twin, version)?;
            engine.leases.hold(&resident);
            Ok::<_, ResidencyError>(resident)
        });
        Ok(opened.await.map_err(|_| SessionError::Crashed)??)
    }

    /// Makes the map of the twin's sky that a profile's frames look up, so that none of them waits for it.
    pub(crate) async fn bake(
        resident: Arc<Resident>,
        profile: RenderProfile,
    ) -> Result<(), SessionError> {
        let Some(sky) = resident.sky().cloned() else { return Ok(()) };
        let baked = tokio::task::spawn_blocking(move || sky.drawable(profile.sky_error));
        let drawn = baked.await.map_err(|_| SessionError::Crashed)?;
        drawn.map(|_| ()).map_err(SessionError::Sky)
    }

    /// Sets aside the memory for the frames of a rig, if there is enough.
    pub(crate) async fn reserve(
        resident: Arc<Resident>,
        lens: RigExtent,
        profile: RenderProfile,
    ) -> Result<Reservation, SessionError> {
        let reserved = tokio::task::spawn_blocking(move || resident.reserve_with(lens, &profile));
        Ok(reserved.await.map_err(|_| SessionError::Crashed)??)
    }

    /// The most that a frame of a rig anywhere in the twin needs, in bytes.
    pub(crate) async fn worst_case_bytes(
        resident: Arc<Resident>,
        lens: RigExtent,
        profile: RenderProfile,
    ) -> Result<u64, SessionError> {
        let sought =
            tokio::task::spawn_blocking(move || resident.worst_case_bytes_with(lens, &profile));
        sought.await.map_err(|_| SessionError::Crashed)
    }

    /// Does some work on a render thread when its turn comes, and tells how long it waited.
    ///
    /// # Errors
    /// [`SessionError::Busy`] if too much is queued, [`SessionError::DeadlineExceeded`] if the
    /// result is not there in time: work that has not begun by then is dropped, work that has is
    /// finished and its result dropped.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        deadline: Instant,
        work: impl FnOnce(&mut Scratch, &dyn Backend) -> T + Send + 'static,
    ) -> Result<(T, Duration), SessionError> {
        let (reply, answer) = oneshot::channel();
        let asked = Instant::now();
        let backend = self.backend.clone();
        let job = move |scratch: &mut Scratch| {
            let queued = asked.elapsed();
            if reply.is_closed() || Instant::now() >= deadline {
                return;
            }
            // A defect in one session's frame must not end the thread that draws all sessions'.
            let done = catch_unwind(AssertUnwindSafe(|| work(scratch, &*backend)));
            // Nobody waits any more: the deadline has passed.
            let _ = reply.send(done.map(|done| (done, queued)));
        };
        self.jobs.try_send(Box::new(job)).map_err(|error| match error {
            mpsc::error::TrySendError::Full(_) => SessionError::Busy { what: "frames queued" },
            mpsc::error::TrySendError::Closed(_) => SessionError::Crashed,
        })?;
        match timeout_at(deadline, answer).await {
            Ok(Ok(Ok(done))) => Ok(done),
            Ok(Ok(Err(_))) => Err(SessionError::Crashed),
            Ok(Err(_)) | Err(_) => Err(SessionError::DeadlineExceeded),
        }
    }

    pub(crate) fn answers(&self) -> &AnswerBudget {
        &self.answers
    }

    pub(crate) fn episodes(&self) -> &Path {
        &self.episodes
    }

    pub(crate) fn step_timeout(&self) -> Duration {
        self.step_timeout
    }
}

impl Drop for LatestPin {
    fn drop(&mut self) {
        lock(&self.engine.held).remove(&self.twin);
    }
}

/// A panic elsewhere leaves nothing half-done behind these locks.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl std::fmt::Debug for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Engine").field("backend", &self.backend.name()).finish_non_exhaustive()
    }
}

/// What a render thread does: the next job in its turn, until there is no engine any more.
fn draw_all(queue: &Mutex<mpsc::Receiver<Job>>) {
    let mut scratch = Scratch::new();
    // The lock is held while waiting: whoever holds it takes the next job, and lets the next in.
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).blocking_recv();
    while let Some(job) = next() {
        job(&mut scratch);
        shrink(&mut scratch);
    }
}

/// Gives back what one session's huge images left behind.
fn shrink(scratch: &mut Scratch) {
    scratch.retain(|image| image.capacity() <= limits::SCRATCH_IMAGE_BYTES);
}

impl AnswerBudget {
    /// InstantBackend a part of the budget.
    ///
    /// # Errors
    /// [`SessionError::Busy`] if it is used up.
    pub(crate) fn hold(&self, bytes: u64) -> Result<BudgetShare, SessionError> {
        let limit = limits::ANSWERS_BYTES;
        let fits = |held: u64| held.checked_add(bytes).filter(|&sum| sum <= limit);
        self.0
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits)
            .map(|_| BudgetShare { answers: self.clone(), bytes })
            .map_err(|_| SessionError::Busy { what: "too many answers are kept" })
    }
}

impl BudgetShare {
    /// InstantBackend over another part of the same budget.
    pub(crate) fn join(&mut self, mut other: Self) {
        self.bytes += std::mem::take(&mut other.bytes);
    }
}

impl Drop for BudgetShare {
    fn drop(&mut self) {
        self.answers.0.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn huge_images_are_not_kept() {
        let mut scratch = vec![vec![0; limits::SCRATCH_IMAGE_BYTES + 1], vec![0; 1000]];
        shrink(&mut scratch);
        assert_eq!(scratch, [vec![0; 1000]]);
    }

    struct InstantBackend(usize);

    impl Backend for InstantBackend {
        fn name(&self) -> &'static str {
            "takes"
        }

        fn frames_in_flight(&self) -> usize {
            self.0
        }

        fn render(
            &self,
            _: &wildcity_render::Frame<'_>,
            _: &mut [wildcity_render::Target<'_>],
            _: wildcity_render::OnViewDone<'_>,
        ) -> Result<wildcity_render::FrameStats, wildcity_render::RenderError> {
            Ok(wildcity_render::FrameStats::default())
        }
    }

    #[tokio::test]
    async fn as_many_frames_at_once_as_the_backend_takes() {
        for at_once in [1, 3] {
            let dir = tempfile::tempdir().unwrap();
            let engine = Engine::start(EngineSettings {
                cache: Cache::new(Catalog::open(dir.path()).unwrap()),
                episodes: dir.path().to_owned(),
                backend: Arc::new(InstantBackend(at_once)),
                step_timeout: limits::STEP_TIMEOUT,
            });
            let engine = engine.unwrap();
            // How many run now, and how many ever ran at once.
            let counts = Arc::new(Mutex::new((0, 0)));
            let jobs = (0..at_once + 3).map(|_| {
                let counts = counts.clone();
                engine.run(Instant::now() + limits::STEP_TIMEOUT, move |_, _| {
                    let begun = Instant::now();
                    let most = || {
                        let mut counts = counts.lock().unwrap();
                        counts.1 = counts.0.max(counts.1);
                        counts.1
                    };
                    counts.lock().unwrap().0 += 1;
                    while most() < at_once && begun.elapsed() < Duration::from_secs(10) {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    std::thread::sleep(Duration::from_millis(20));
                    most();
                    counts.lock().unwrap().0 -= 1;
                })
            });
            for done in futures_util::future::join_all(jobs).await {
                done.unwrap();
            }
            assert_eq!(*counts.lock().unwrap(), (0, at_once));
        }
    }

    #[test]
    fn the_budget_for_answers_comes_back() {
        let answers = AnswerBudget::default();
        for _ in 0..3 {
            let mut half = answers.hold(limits::ANSWERS_BYTES / 2).unwrap();
            half.join(answers.hold(limits::ANSWERS_BYTES / 2).unwrap());
            assert!(matches!(answers.hold(2), Err(SessionError::Busy { .. })));
        }
        assert!(answers.hold(limits::ANSWERS_BYTES).is_ok());
        assert!(answers.hold(limits::ANSWERS_BYTES + 1).is_err());
        assert!(answers.hold(u64::MAX).is_err());
    }
}
