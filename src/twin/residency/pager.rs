//! The pager: loads requested sections in order of urgency, and hands a frame all of its sections
//! at once.
//!
//! A frame that waits holds no memory, so frames cannot block each other; only older frames may
//! evict the sections that it waits for ([`super::table::Requester`]). The pager has threads of its
//! own for loading, because reading blocks. All other threads wait for nothing but the lock.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};

use crate::limits;
use crate::store::Version;
use wildcity_scene::Scene;
use wildcity_scene::actor::PlacedChunk;

use super::demand::SectionRef;
use super::load_times::LoadTimes;
use super::reading::ReadingBytes;
use super::requests::{self, CompleteFrame, LoadFailure, NextLoad, RequestedSections, Urgency};
use super::table::{SectionTable, SlotId};
use super::{ResidencyError, SectionSource, Stats};

/// The table of sections and the loader threads, which end when this is dropped.
pub(super) struct Pager(Arc<Shared>);

/// Is called once with what a frame draws, or the reason why the frame cannot be drawn.
pub type SceneCallback = Box<dyn FnOnce(Result<PinnedScene, ResidencyError>) + Send>;

type Requests = requests::Requests<SceneCallback>;
type Notifications = requests::Notifications<SceneCallback>;

/// Everything that a frame draws, held in memory for as long as this lives.
#[derive(Debug)]
pub struct PinnedScene {
    scene: Scene,
    shared: Arc<Shared>,
    /// Number of sections that were not in memory when the frame requested them.
    pub waited_for: usize,
    /// Time until all of them were.
    pub waited: Duration,
}

/// A frame that waits for its sections. Dropping it cancels the request.
pub(super) struct WaitingFrame {
    shared: Arc<Shared>,
    number: u64,
}

struct Shared {
    source: Arc<dyn SectionSource>,
    state: Mutex<State>,
    /// Notified when there may be a section to load, or memory for one.
    work: Condvar,
    reading: ReadingBytes,
}

struct State {
    requests: Requests,
    started: bool,
    closed: bool,
}

impl Pager {
    pub(super) fn new(source: Arc<dyn SectionSource>, limit_bytes: u64) -> Self {
        let requests = Requests::new(SectionTable::new(limit_bytes));
        let state = State { requests, started: false, closed: false };
        Self(Arc::new(Shared {
            source,
            state: Mutex::new(state),
            work: Condvar::new(),
            reading: ReadingBytes::default(),
        }))
    }

    /// Starts the loader threads, unless they run.
    ///
    /// # Errors
    /// [`ResidencyError::Thread`].
    pub(super) fn start(&self) -> Result<(), ResidencyError> {
        let mut state = self.0.state.lock();
        if state.started {
            return Ok(());
        }
        for number in 0..limits::LOADERS {
            let shared = self.0.clone();
            std::thread::Builder::new()
                .name(format!("load-{number}"))
                .spawn(move || shared.load_until_closed())
                .map_err(|error| ResidencyError::Thread { reason: error.to_string() })?;
            // Set with the first thread. If a later one cannot be started, those that run suffice
            // for progress.
            state.started = true;
        }
        Ok(())
    }

    /// Registers or unregisters sections of a version.
    pub(super) fn with_table<T>(&self, change: impl FnOnce(&mut SectionTable) -> T) -> T {
        change(&mut self.0.state.lock().requests.table)
    }

    /// Counts a reservation that is only enough for one camera at a time.
    pub(super) fn count_by_camera(&self) {
        self.0.state.lock().requests.count_by_camera();
    }

    /// Requests the sections of a frame. `callback` is called once all are in memory; before this
    /// returns, if they are already.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`]; `callback` is dropped then.
    pub(super) fn request_frame(
        &self,
        requested: RequestedSections,
        callback: SceneCallback,
    ) -> Result<WaitingFrame, ResidencyError> {
        let mut notifications = Notifications::new();
        let added = self.0.state.lock().requests.add_frame(requested, callback, &mut notifications);
        let number = added?;
        // Notifications mean that the frame is complete and has queued nothing.
        if notifications.is_empty() {
            self.0.work.notify_all();
        }
        // Called without the lock, because a callback may request the next frame.
        self.0.notify(notifications);
        Ok(WaitingFrame { shared: self.0.clone(), number })
    }

    /// Loads sections that frames may need later, in order, as far as the memory allows. This
    /// replaces the prefetch of the same owner with the number `before`. Returns the new number.
    pub(super) fn prefetch(
        &self,
        before: Option<u64>,
        requested: RequestedSections,
        urgencies: &[Urgency],
    ) -> u64 {
        let (number, has_work) = {
            let requests = &mut self.0.state.lock().requests;
            if let Some(before) = before {
                requests.cancel_prefetch(before);
            }
            let number = requests.add_prefetch(before, requested, urgencies);
            requests.forget_unrequested_failures();
            (number, requests.has_queued())
        };
        // Usually all is in memory. To wake eight loaders for nothing took a tenth of a millisecond
        // of each step.
        if has_work {
            self.0.work.notify_all();
        }
        number
    }

    /// Cancels the loads of a prefetch that have not begun.
    pub(super) fn cancel_prefetch(&self, number: u64) {
        let requests = &mut self.0.state.lock().requests;
        requests.cancel_prefetch(number);
        requests.forget_unrequested_failures();
    }

    /// Number of sections of a prefetch that may still be loaded: without those that are in memory,
    /// that failed, or for which there was no room.
    pub(super) fn pending(&self, number: u64) -> usize {
        self.0.state.lock().requests.pending(number)
    }

    /// Bytes of memory in use, and bytes that may be used.
    pub(super) fn memory(&self) -> (u64, u64) {
        let table = &self.0.state.lock().requests.table;
        (table.held_bytes(), table.limit_bytes())
    }

    /// How long the last loads took.
    pub(super) fn load_times(&self) -> LoadTimes {
        self.0.state.lock().requests.load_times.clone()
    }

    /// All statistics except the reserved bytes, which the pager does not count.
    pub(super) fn stats(&self) -> Stats {
        // A copy, so that it is sorted without the lock.
        let times = self.load_times();
        let stats = self.0.state.lock().requests.stats();
        Stats { load_p50: times.quantile(0.5), load_p99: times.quantile(0.99), ..stats }
    }
}

impl Drop for Pager {
    fn drop(&mut self) {
        // Loaders that read finish their section; then they see the flag. They own the shared
        // state, so that this need not wait for them.
        self.0.state.lock().closed = true;
        self.0.work.notify_all();
    }
}

impl WaitingFrame {
    /// Number of its sections that are not in memory.
    pub(super) fn missing(&self) -> usize {
        self.shared.state.lock().requests.missing(self.number)
    }
}

impl Drop for WaitingFrame {
    fn drop(&mut self) {
        // Dropped without the lock, because the callback may own anything.
        let cancelled = {
            let requests = &mut self.shared.state.lock().requests;
            let request = requests.cancel_frame(self.number);
            requests.forget_unrequested_failures();
            request
        };
        // A frame that is complete has released its loads already.
        if cancelled.is_some() {
            // The load that waits for room may have been for this frame: the next in order may go
            // on.
            self.shared.work.notify_all();
        }
    }
}

impl std::ops::Deref for PinnedScene {
    type Target = Scene;

    fn deref(&self) -> &Scene {
        &self.scene
    }
}

impl PinnedScene {
    /// Draws these actors, too, in place of those given before.
    pub fn place(&mut self, placed: Vec<PlacedChunk>) {
        self.scene.placed = placed;
    }
}

impl Drop for PinnedScene {
    fn drop(&mut self) {
        // The chunks are released before the loaders wake, because these look for sections with one
        // `Arc`.
        self.scene.chunks.clear();
        // The flag is read under the lock: a loader that has just found every section pinned sleeps
        // by then, and gets the notification.
        if self.shared.state.lock().requests.waiting_for_room {
            self.shared.work.notify_all();
        }
    }
}

impl Shared {
    /// The main function of a loader thread: loads sections until the pager is dropped.
    fn load_until_closed(self: Arc<Self>) {
        let mut state = self.state.lock();
        // The lock is held at each test of the flag, and `wait` releases it atomically, so that no
        // notification is lost.
        while !state.closed {
            match state.requests.next(Instant::now()) {
                NextLoad::Load { id, section, version, request } => {
                    // Reading takes milliseconds to seconds, and the other loaders need the lock.
                    drop(state);
                    let notifications = self.load(id, request, section, &version);
                    // The others are woken before the callbacks run, which may take long: a
                    // finished load may have made sections of other requests loadable.
                    self.work.notify_all();
                    self.notify(notifications);
                    state = self.state.lock();
                }
                // The end of a frame notifies. Code that holds a chunk for a moment otherwise does
                // not, so a load that waits for room also looks again from time to time.
                NextLoad::Wait(_) if state.requests.waiting_for_room => {
                    self.work.wait_for(&mut state, limits::ROOM_POLL);
                }
                NextLoad::Wait(Some(until)) => {
                    self.work.wait_until(&mut state, until);
                }
                NextLoad::Wait(None) => self.work.wait(&mut state),
            }
        }
    }

    fn load(
        &self,
        id: SlotId,
        request: u64,
        section: SectionRef,
        version: &Version,
    ) -> Notifications {
        let chunk = &version.manifest.chunks[section.chunk];
        let section = &chunk.sections[section.section];
        let is_wanted = || self.state.lock().requests.is_wanted(id, request);
        let Some(reading) = self.reading.begin(section.bytes.into(), &is_wanted) else {
            // A request since then finds it absent.
            self.state.lock().requests.table.load_failed(id);
            return Notifications::new();
        };
        // Without the wait: prefetching looks as far ahead as loads take long.
        let began = Instant::now();
        // A defect in loading one section must not end the thread that loads all of them.
        let read = || self.source.section(version, chunk, section);
        // A panic cannot leave broken state behind: the source gets only shared references, and the
        // lock is not held.
        let loaded = catch_unwind(AssertUnwindSafe(read));
        drop(reading);
        let took = began.elapsed();
        let requests = &mut self.state.lock().requests;
        match loaded {
            Ok(Ok(loaded)) => requests.loaded(id, Arc::new(loaded), took),
            Ok(Err(error)) => requests.load_failed(id, &LoadFailure::Store(error)),
            Err(_) => requests.load_failed(id, &LoadFailure::Crashed),
        }
    }

    /// Calls the callbacks of frames that are complete or have failed.
    fn notify(self: &Arc<Self>, notifications: Notifications) {
        for (callback, result) in notifications {
            callback(result.map(|CompleteFrame { scene, waited_for, waited }| PinnedScene {
                scene,
                shared: self.clone(),
                waited_for,
                waited,
            }));
        }
    }
}

impl std::fmt::Debug for Pager {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pager").finish_non_exhaustive()
    }
}

impl std::fmt::Debug for WaitingFrame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("WaitingFrame").field("number", &self.number).finish_non_exhaustive()
    }
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").finish_non_exhaustive()
    }
}
