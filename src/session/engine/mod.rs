//! State that all sessions share: the twins in memory, the render queue, and the budget for
//! answers.

pub(crate) mod answer_budget;
pub(crate) mod devices;
mod exports;
mod latest;
mod leases;
pub(crate) mod render_queue;
pub(crate) mod solid_blocks;
pub(crate) mod spare_memory;
pub(crate) mod turns;
pub(crate) mod twin_summaries;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};
use std::time::Duration;

use parking_lot::Mutex;
use tokio::time::{Instant, sleep};

use wildcity_render::{Backend, RenderError, View, sample_count};
use wildcity_repair::Models;
use wildcity_scene::actor::ActorAsset;
use wildcity_scene::geometry::Lidar;
use wildcity_scene::{Rays, RenderProfile};
use wildcity_sim::traffic::EgoBox;
use wildcity_twin::residency::{
    Cache, FrameBytes, Prefetcher, ResidencyError, Resident, ResidentActor, RigExtent, SceneBytes,
    Stats, Urgency, Viewpoint,
};
use wildcity_twin::store::Catalog;

use self::answer_budget::{AnswerBudget, BudgetShare};
pub use self::devices::DeviceLoad;
use self::devices::{DeviceSlot, Devices};
use self::exports::Exports;
use self::latest::LatestVersions;
use self::leases::Leases;
use self::render_queue::{FrameCost, Scratch};
use self::solid_blocks::SolidBlocks;
use self::turns::{Turn, Turns};
use self::twin_summaries::{SummaryCache, TwinSummaries};
use crate::blocking::{Stop, run_blocking, run_until};
use crate::contact::TwinSolids;
use crate::error::SessionError;
use crate::limits;
use crate::polls::Polls;
use crate::record::quota::{RecordLimits, RecordQuota};
use crate::scenario::load::Scenarios;
use crate::spatial_index::SpatialIndex;

/// The [`FrameCost::session`] of frames that are rendered for pushes, which no session has. They
/// are drawn on device 0.
pub const PUSHES: u64 = 0;

/// The parts and settings of an [`Engine`].
pub struct EngineSettings {
    /// The twins that can be opened, and the memory for them.
    pub cache: Cache,
    /// Directory of the episodes' files.
    pub episodes: PathBuf,
    /// The scenarios that can be opened by name.
    pub scenarios: Scenarios,
    /// The backend that renders.
    pub backend: Arc<dyn Backend>,
    /// How long one step may take, time in queues included.
    pub step_timeout: Duration,
    /// The models that can repair images, by name. Each is loaded when a session asks for it.
    pub repairs: Arc<Models>,
    /// Whether an episode that ends is also written as an MCAP file, next to its record.
    pub mcap: bool,
}

/// The renderer and the twins, shared by all sessions.
pub struct Engine {
    summaries: Arc<SummaryCache>,
    cache: Cache,
    leases: Arc<Leases>,
    episodes: PathBuf,
    scenarios: Scenarios,
    step_timeout: Duration,
    repairs: Arc<Models>,
    devices: Devices,
    answer_budget: AnswerBudget,
    record_quota: Arc<RecordQuota>,
    /// The turns of long simulations, and of records that are read whole.
    turns: Turns,
    polls: Arc<Polls>,
    /// The versions that are open, by place; by the hashes of the versions.
    indexes: Mutex<BTreeMap<String, Weak<SpatialIndex>>>,
    solid_blocks: Arc<SolidBlocks>,
    /// The export of ended episodes as MCAP files; `None` if episodes are not exported.
    exports: Option<Exports>,
    /// For each twin, the version that counts as its latest while a newer one is loaded.
    pins: Mutex<BTreeMap<String, u64>>,
    latest: LatestVersions,
}

/// Pins the version that counts as a twin's latest, until dropped.
pub struct LatestPin {
    engine: Arc<Engine>,
    twin: String,
}

impl Engine {
    /// Starts the render threads of each device, as many as it renders frames at once. They end
    /// when the engine is dropped.
    ///
    /// # Errors
    /// [`SessionError::Thread`] if a thread cannot be started.
    pub fn start(settings: EngineSettings) -> Result<Arc<Self>, SessionError> {
        let EngineSettings { cache, episodes, scenarios, backend, step_timeout, repairs, mcap } =
            settings;
        // Before the queue starts, so that no frame is rendered without the limit.
        backend.limit_frame_bytes(cache.limit_bytes() / limits::FRAME_SHARE);
        let exports = mcap.then(|| Exports::start(episodes.clone())).transpose()?;
        Ok(Arc::new(Self {
            // What reads `cache` comes before the field that it moves into.
            summaries: Arc::new(SummaryCache::new(cache.catalog().clone())),
            leases: Arc::new(Leases::new(cache.catalog().clone())),
            indexes: Mutex::default(),
            solid_blocks: Arc::new(SolidBlocks::new(
                (cache.limit_bytes() / limits::SOLID_SHARE) as usize,
            )),
            record_quota: Arc::new(RecordQuota::new(episodes.clone())),
            cache,
            episodes,
            scenarios,
            step_timeout,
            repairs,
            devices: Devices::start(backend)?,
            answer_budget: AnswerBudget::default(),
            turns: Turns::new(),
            polls: Arc::default(),
            exports,
            pins: Mutex::default(),
            latest: LatestVersions::default(),
        }))
    }

    /// Limits the bytes of records from now on.
    pub fn limit_records(&self, limits: RecordLimits) {
        self.record_quota.limit(limits);
    }

    pub(crate) fn record_quota(&self) -> &Arc<RecordQuota> {
        &self.record_quota
    }

    /// Waits for the turn of a simulation of some work; short ones need none.
    ///
    /// # Errors
    /// [`SessionError::DeadlineExceeded`].
    pub(crate) async fn simulation_turn(
        &self,
        work: u64,
        deadline: Instant,
    ) -> Result<Option<Turn>, SessionError> {
        // Waiting for a turn would delay short work behind long work.
        if work <= limits::SHORT_WORK {
            return Ok(None);
        }
        self.turns.simulation(deadline).await.map(Some)
    }

    /// Waits for the turn to decode the overlays of a rig.
    ///
    /// # Errors
    /// [`SessionError::DeadlineExceeded`] if it takes longer than a step may.
    pub(crate) async fn overlay_turn(&self) -> Result<Turn, SessionError> {
        self.turns.overlay(Instant::now() + self.step_timeout).await
    }

    /// Waits for the turn to read and resolve a scenario, and does it until the time of a step has
    /// passed.
    ///
    /// # Errors
    /// [`SessionError::DeadlineExceeded`], or that of the work.
    pub(crate) async fn in_scenario_turn<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Stop) -> Result<T, SessionError> + Send + 'static,
    ) -> Result<T, SessionError> {
        let deadline = Instant::now() + self.step_timeout;
        let turn = self.turns.scenario(deadline).await?;
        run_until(deadline, move |stop| {
            // The turn belongs to the work, which goes on for a moment if the client leaves.
            let _turn = turn;
            stop.refusal()?;
            work(stop)
        })
        .await
    }

    /// Waits for the turn to read a whole record.
    ///
    /// # Errors
    /// [`SessionError::DeadlineExceeded`] if it takes longer than a step may.
    pub(crate) async fn record_turn(&self) -> Result<Turn, SessionError> {
        self.turns.record(Instant::now() + self.step_timeout).await
    }

    /// The version of every twin that `latest` stands for, and the damaged twins, which are also
    /// logged.
    ///
    /// # Errors
    /// The directory of twins cannot be read.
    pub async fn twins(self: &Arc<Self>) -> Result<TwinSummaries, SessionError> {
        let engine = self.clone();
        let pinned = move |twin: &str| engine.pinned_latest(twin);
        let summaries = self.summaries.clone();
        Ok(run_blocking(move || summaries.read(&pinned)).await??)
    }

    /// The scenarios that can be opened by name.
    pub fn scenarios(&self) -> &Scenarios {
        &self.scenarios
    }

    /// The models that can repair images.
    pub fn repairs(&self) -> &Arc<Models> {
        &self.repairs
    }

    /// Checks that twins can be listed.
    ///
    /// # Errors
    /// The directory of twins cannot be read.
    pub async fn check_twins(&self) -> Result<(), SessionError> {
        let summaries = self.summaries.clone();
        Ok(run_blocking(move || summaries.check()).await??)
    }

    /// The twins that can be opened.
    pub fn catalog(&self) -> &Catalog {
        self.cache.catalog()
    }

    /// Renews the leases that keep garbage collection from open versions. A server calls this every
    /// [`limits::LEASE_RENEWAL`].
    ///
    /// # Errors
    /// The store refuses a renewal. Leases that it granted before stay valid for [`limits::LEASE`].
    pub async fn renew_leases(&self) -> Result<(), SessionError> {
        let leases = self.leases.clone();
        Ok(run_blocking(move || leases.renew()).await??)
    }

    /// The twins and assets in memory.
    pub(crate) fn cache(&self) -> &Cache {
        &self.cache
    }

    /// The polls of the tasks of all services that use the engine.
    pub fn polls(&self) -> &Arc<Polls> {
        &self.polls
    }

    /// Frames that wait for the renderer.
    pub fn queued_frames(&self) -> usize {
        self.device_loads().iter().map(|load| load.queued_frames).sum()
    }

    /// A number that rises by 1 with each session that begins, and with each that ends.
    pub fn session_changes(&self) -> u64 {
        self.devices.changes()
    }

    /// What each device of the backend does, in their order.
    pub fn device_loads(&self) -> Vec<DeviceLoad> {
        self.devices.loads()
    }

    /// Lets a version count as the latest of its twin, whatever is committed, until the pin is
    /// dropped. So a push can load its version before sessions open it: agents never wait for a
    /// push.
    pub fn pin_latest(self: &Arc<Self>, twin: &str, number: u64) -> LatestPin {
        self.pins.lock().insert(twin.to_owned(), number);
        LatestPin { engine: self.clone(), twin: twin.to_owned() }
    }

    /// The version that is pinned as the latest of a twin, if one is.
    pub fn pinned_latest(&self, twin: &str) -> Option<u64> {
        self.pins.lock().get(twin).copied()
    }

    /// Moves the pin of a twin to another version, as after a rollback; does nothing without a pin.
    pub fn move_latest_pin(&self, twin: &str, number: u64) {
        if let Some(pinned) = self.pins.lock().get_mut(twin) {
            *pinned = number;
        }
    }

    /// Opens a version and loads the sections that some frames of it need, so that sessions at
    /// these viewpoints do not wait when they switch to it. `frames` has the viewpoints of each
    /// frame.
    ///
    /// Loads only sections that fit into memory in addition to those that sessions need now or
    /// soon, which are loaded first, and returns after [`limits::PRELOAD_TIMEOUT`] even if
    /// something is still missing.
    ///
    /// # Errors
    /// The version cannot be opened.
    pub async fn preload(
        self: &Arc<Self>,
        twin: &str,
        number: u64,
        frames: Vec<Vec<Viewpoint>>,
    ) -> Result<(), SessionError> {
        // By its number, because the pin still stands for the version before.
        let resident = self.open_version(twin.to_owned(), Some(number)).await?;
        let deadline = Instant::now() + limits::PRELOAD_TIMEOUT;
        let prefetcher = Arc::new(Prefetcher::new(resident));
        let requested = prefetcher.clone();
        run_blocking(move || {
            // The most urgent class of a prefetch, because a push waits for these sections.
            let places: Vec<_> =
                frames.into_iter().map(|viewpoints| (Urgency::Imminent, viewpoints)).collect();
            requested.prefetch(&places, &requested.resident().version.manifest.profile);
        })
        .await?;
        // The prefetcher counts what is pending, but reports no end: this polls.
        while prefetcher.pending() > 0 && Instant::now() < deadline {
            sleep(limits::PRELOAD_POLL).await;
        }
        Ok(())
    }

    /// Checks that the backend can draw as a profile asks.
    ///
    /// # Errors
    /// [`RenderError::ExactRays`].
    pub(crate) fn check_profile(&self, profile: &RenderProfile) -> Result<(), SessionError> {
        let backend = self.devices.backend();
        if profile.rays == Rays::Exact && !backend.draws_exact_rays() {
            return Err(RenderError::ExactRays { backend: backend.name() }.into());
        }
        Ok(())
    }

    /// Name of the backend.
    pub fn backend(&self) -> &'static str {
        self.devices.backend().name()
    }

    /// Properties of the backend on which pixels depend in addition to its name, such as its
    /// instruction set.
    pub(crate) fn backend_detail(&self) -> String {
        self.devices.backend().detail()
    }

    /// Memory of the answers that are being made, sent or kept, and of overlays, in bytes.
    pub fn answer_bytes(&self) -> u64 {
        self.answer_budget.reserved()
    }

    /// Counters of the pager, and the memory that twins take now.
    pub fn residency(&self) -> Stats {
        self.cache.stats()
    }

    /// Opens a version of a twin, or the one that counts as its latest. This loads its manifest;
    /// Gaussians are loaded when a frame needs them.
    ///
    /// # Errors
    /// The version does not exist or cannot be read.
    pub async fn open_version(
        self: &Arc<Self>,
        twin: String,
        version: Option<u64>,
    ) -> Result<Arc<Resident>, SessionError> {
        let engine = self.clone();
        // A version that is asked for by its number passes by the pin.
        let version = version.or_else(|| self.pinned_latest(&twin));
        let opened = run_blocking(move || {
            let resident = engine.cache.open(&twin, version)?;
            // Before the version is handed out: garbage collection must not delete what a session
            // begins to read.
            engine.leases.take(&resident);
            Ok::<_, ResidencyError>(resident)
        });
        Ok(opened.await??)
    }

    /// Returns the asset of a hash, 64 lower-case hex digits. It stays in memory until its last
    /// copy is dropped. Blocks while the asset is read, unless it is in memory already.
    ///
    /// # Errors
    /// There is no such asset, or it is damaged, or there is too little memory.
    pub fn actor(&self, hash: &str) -> Result<Arc<ResidentActor>, SessionError> {
        Ok(self.cache.actor(hash)?)
    }

    /// Keeps an asset that is not in the store in memory until its last copy is dropped, or returns
    /// the asset of the same key if there is one. `key` identifies all inputs that the asset is
    /// made from, and is not a hash of the store. The memory counts as that of twins.
    ///
    /// # Errors
    /// There is no room for it.
    pub fn hold_actor(
        &self,
        key: &str,
        asset: ActorAsset,
    ) -> Result<Arc<ResidentActor>, SessionError> {
        Ok(self.cache.hold_actor(key, asset)?)
    }

    /// Bakes the cube map of the twin's sky that frames of this profile look up, so that no frame
    /// waits for it.
    ///
    /// # Errors
    /// [`SessionError::Sky`] if the profile's `sky_error` is below what the finest map has.
    pub async fn bake_sky(
        resident: Arc<Resident>,
        profile: RenderProfile,
    ) -> Result<(), SessionError> {
        let Some(sky) = resident.sky().cloned() else { return Ok(()) };
        let baked = run_blocking(move || sky.drawable(profile.sky_error).map(|_| ())).await?;
        baked.map_err(SessionError::Sky)
    }

    /// What of a version is near a place. Sessions of the same version share it. Blocks: a long
    /// drive has half a million keyframes and sections.
    pub(crate) fn spatial_index(&self, resident: &Resident) -> Arc<SpatialIndex> {
        let hash = &resident.version.hash;
        if let Some(index) = self.indexes.lock().get(hash).and_then(Weak::upgrade) {
            return index;
        }
        // Built without the lock: another session may build the same one, and then one of both is
        // dropped.
        let index = Arc::new(SpatialIndex::new(resident.version.clone()));
        let mut indexes = self.indexes.lock();
        // The versions that were closed meanwhile go, so that the map does not grow with each push.
        indexes.retain(|_, index| index.strong_count() > 0);
        indexes.insert(hash.clone(), Arc::downgrade(&index));
        index
    }

    /// The solid Gaussians of a version, for an ego of a size.
    pub(crate) fn solids(&self, index: Arc<SpatialIndex>, ego_box: EgoBox) -> TwinSolids {
        TwinSolids::new(self.catalog().clone(), index, self.solid_blocks.clone(), ego_box)
    }

    /// Buffers and images that a frame of some views needs in addition to its scene. The frame
    /// renders `rendered` bytes of images, and its session holds `images` bytes of them.
    pub(crate) fn frame_bytes(
        &self,
        views: &[View],
        profile: &RenderProfile,
        rendered: u64,
        images: u64,
    ) -> FrameBytes {
        let is_large = sample_count(views, profile) > limits::LARGE_SAMPLES;
        let backend = self.devices.backend();
        // Each device has images of its own.
        let rendered = rendered * self.devices.count() as u64;
        // Only small frames are rendered beside another one, see `render_queue`: of a large frame,
        // its cameras one by one.
        let side_bytes = |views: &[View]| backend.bytes_beside(views, profile) + rendered;
        let is_small = |views: &&[View]| sample_count(views, profile) <= limits::LARGE_SAMPLES;
        let alone =
            || views.iter().map(std::slice::from_ref).filter(is_small).map(side_bytes).max();
        // Of a large frame whose cameras are all large, nothing is ever rendered beside another
        // frame.
        let beside = if is_large { alone().unwrap_or(0) } else { side_bytes(views) };
        let stages = backend.frame_bytes(views, profile) + rendered;
        FrameBytes { stages, beside, is_large, images }
    }

    /// Buffers that a sweep of a LiDAR needs in addition to its scene, in bytes.
    pub(crate) fn sweep_bytes(&self, lidar: &Lidar) -> u64 {
        self.devices.backend().sweep_bytes(lidar)
    }

    /// Memory that the scene of a rig's worst frame needs, wherever in the twin the rig is.
    /// `may_split` tells whether its frames may be drawn view by view.
    pub(crate) async fn scene_bytes(
        resident: Arc<Resident>,
        extent: RigExtent,
        profile: RenderProfile,
        may_split: bool,
    ) -> Result<SceneBytes, SessionError> {
        run_blocking(move || resident.scene_bytes(extent, &profile, may_split)).await
    }

    /// Runs `work` on a render thread when its session is next. Returns its result and how long it
    /// was queued.
    ///
    /// # Errors
    /// [`SessionError::Busy`] if the queue is full, or earlier frames leave it no time;
    /// [`SessionError::Crashed`] if `work` panicked; and [`SessionError::DeadlineExceeded`] if
    /// there is no result by the deadline. Work that has not started by then never starts; work
    /// that has is finished, and its result is discarded.
    pub async fn run<T: Send + 'static>(
        &self,
        cost: FrameCost,
        deadline: Instant,
        work: impl FnOnce(&mut Scratch, &dyn Backend) -> T + Send + 'static,
    ) -> Result<(T, Duration), SessionError> {
        self.devices.run(cost, deadline, work).await
    }

    /// Places a session on the device with the fewest sessions. Its frames are scheduled by the
    /// number of the slot.
    pub(crate) fn place_session(&self) -> DeviceSlot {
        self.devices.place()
    }

    /// How long one step may take, time in queues included.
    pub fn step_timeout(&self) -> Duration {
        self.step_timeout
    }

    /// Counts bytes that hold answers outside of the sessions against the budget for answers, until
    /// the share is dropped.
    ///
    /// # Errors
    /// [`SessionError::Busy`] if fewer are left.
    pub fn reserve_answer_bytes(&self, bytes: u64) -> Result<BudgetShare, SessionError> {
        self.answer_budget.reserve(bytes)
    }

    pub(crate) fn answer_budget(&self) -> &AnswerBudget {
        &self.answer_budget
    }

    /// Lets a record that ended become an MCAP file. Returns at once.
    pub(crate) fn export(&self, record: PathBuf) {
        if let Some(exports) = &self.exports {
            exports.add(record);
        }
    }

    /// Whether episodes that end become MCAP files.
    pub fn exports_mcap(&self) -> bool {
        self.exports.is_some()
    }

    /// Waits until the export of `episode` has ended, or all exports if it is `None`; at most
    /// `longest`. Returns whether they have ended.
    pub async fn wait_for_exports(&self, episode: Option<&str>, longest: Duration) -> bool {
        match &self.exports {
            Some(exports) => exports.wait(episode, longest).await,
            None => true,
        }
    }

    /// Why an episode of this engine has no MCAP file; `None` if it is unknown.
    pub fn export_failure(&self, episode: &str) -> Option<String> {
        self.exports.as_ref()?.failure(episode)
    }

    pub(crate) fn episodes(&self) -> &Path {
        &self.episodes
    }
}

impl Drop for LatestPin {
    fn drop(&mut self) {
        self.engine.pins.lock().remove(&self.twin);
    }
}

impl std::fmt::Debug for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Engine").field("backend", &self.backend()).finish_non_exhaustive()
    }
}
