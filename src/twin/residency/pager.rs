//! The pager: loads what is wanted, in order of urgency, and gives a frame all it needs at once.
//!
//! A frame that waits holds nothing, so frames cannot block each other; its sections are spared by
//! everybody but older frames ([`super::table::Requester`]). Threads of its own load, because reading blocks; nobody
//! else ever waits in here for more than a lock.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::limits;
use crate::store::Version;
use wildcity_scene::Scene;

use super::load_times::LoadTimes;
use super::requests::{
    CompleteFrame, LoadFailure, NextLoad, Notifications, RequestedSections, Requests,
    SceneCallback, Urgency,
};
use super::table::{SectionTable, SlotId};
use super::{ResidencyError, SectionRef, SectionSource, Stats};

/// The table of sections and the threads that fill it, which end with it.
pub(super) struct Pager(Arc<Shared>);

/// What a frame draws, all of it in memory for as long as this lives.
#[derive(Debug)]
pub struct PinnedScene {
    scene: Scene,
    shared: Arc<Shared>,
    /// Sections that were not in memory when the frame asked.
    pub waited_for: usize,
    /// How long it took until all were.
    pub waited: Duration,
}

/// A frame's place among those that wait; dropping it gives the place up.
pub(super) struct WaitingFrame {
    shared: Arc<Shared>,
    number: u64,
}

struct Shared {
    source: Arc<dyn SectionSource>,
    state: Mutex<State>,
    /// Rings when there may be something to load, or room for it.
    work: Condvar,
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
        Self(Arc::new(Shared { source, state: Mutex::new(state), work: Condvar::new() }))
    }

    /// Starts the threads that load, unless they run.
    ///
    /// # Errors
    /// [`ResidencyError::Thread`].
    pub(super) fn start(&self) -> Result<(), ResidencyError> {
        let mut state = self.0.lock();
        if state.started {
            return Ok(());
        }
        for number in 0..limits::LOADERS {
            let shared = self.0.clone();
            std::thread::Builder::new()
                .name(format!("load-{number}"))
                .spawn(move || shared.load_all())
                .map_err(|error| ResidencyError::Thread { reason: error.to_string() })?;
            state.started = true;
        }
        Ok(())
    }

    /// Changes what the table knows of versions.
    pub(super) fn with_table<T>(&self, change: impl FnOnce(&mut SectionTable) -> T) -> T {
        change(&mut self.0.lock().requests.table)
    }

    /// Tells `done` as soon as all of what a frame needs is in memory; at once if it is.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`]; `done` is dropped then.
    pub(super) fn request_frame(
        &self,
        wanted: RequestedSections,
        done: SceneCallback,
    ) -> Result<WaitingFrame, ResidencyError> {
        let mut notifications = Notifications::new();
        let number = self.0.lock().requests.add_frame(wanted, done, &mut notifications)?;
        if notifications.is_empty() {
            self.0.work.notify_all();
        }
        self.0.notify(notifications);
        Ok(WaitingFrame { shared: self.0.clone(), number })
    }

    /// Loads what somebody may need, in order, as far as there is room, in place of what the same
    /// owner wanted under the number `before`; returns the new number.
    pub(super) fn prefetch(
        &self,
        before: Option<u64>,
        wanted: RequestedSections,
        urgencies: &[Urgency],
    ) -> u64 {
        let number = {
            let requests = &mut self.0.lock().requests;
            if let Some(before) = before {
                requests.cancel_prefetch(before);
            }
            let number = requests.add_prefetch(before, wanted, urgencies);
            requests.forget_failures();
            number
        };
        self.0.work.notify_all();
        number
    }

    /// Loads nothing more of what was wanted under a number.
    pub(super) fn cancel_prefetch(&self, number: u64) {
        let requests = &mut self.0.lock().requests;
        requests.cancel_prefetch(number);
        requests.forget_failures();
    }

    /// Sections that were wanted under a number and may still come: not those that are there, that
    /// failed or for which there was no room.
    pub(super) fn pending(&self, number: u64) -> usize {
        self.0.lock().requests.pending(number)
    }

    /// Bytes of memory in use, and bytes there are.
    pub(super) fn memory(&self) -> (u64, u64) {
        let table = &self.0.lock().requests.table;
        (table.held_bytes(), table.limit_bytes())
    }

    /// How long the last loads took.
    pub(super) fn load_times(&self) -> LoadTimes {
        self.0.lock().requests.load_times.clone()
    }

    /// All but what is set aside, which the pager does not know.
    pub(super) fn stats(&self) -> Stats {
        // Sorted once the lock is open again.
        let times = self.load_times();
        let stats = self.0.lock().requests.stats();
        Stats { load_p50: times.quantile(0.5), load_p99: times.quantile(0.99), ..stats }
    }
}

impl Drop for Pager {
    fn drop(&mut self) {
        self.0.lock().closed = true;
        self.0.work.notify_all();
    }
}

impl WaitingFrame {
    /// How many of its sections are not there.
    pub(super) fn missing(&self) -> usize {
        self.shared.lock().requests.missing(self.number)
    }
}

impl Drop for WaitingFrame {
    fn drop(&mut self) {
        // What it was to be told is dropped once the lock is open: it may hold anything.
        let _done = {
            let requests = &mut self.shared.lock().requests;
            let done = requests.cancel_frame(self.number);
            requests.forget_failures();
            done
        };
        self.shared.work.notify_all();
    }
}

impl std::ops::Deref for PinnedScene {
    type Target = Scene;

    fn deref(&self) -> &Scene {
        &self.scene
    }
}

impl Drop for PinnedScene {
    fn drop(&mut self) {
        self.scene.chunks.clear();
        // Under the lock: a loader that has just found everything in use is asleep by then.
        if self.shared.lock().requests.waiting_for_room {
            self.shared.work.notify_all();
        }
    }
}

impl Shared {
    /// A panic elsewhere leaves nothing half-done behind this lock.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What a loader does, until the pager is dropped.
    fn load_all(self: Arc<Self>) {
        let mut state = self.lock();
        while !state.closed {
            match state.requests.next(Instant::now()) {
                NextLoad::Load { id, needed, version } => {
                    drop(state);
                    let notifications = self.load(id, needed, &version);
                    self.work.notify_all();
                    self.notify(notifications);
                    state = self.lock();
                }
                NextLoad::Wait(until) => {
                    // A frame's end rings. What else may hold a chunk for a moment does not, so that
                    // whoever waits for room looks again now and then.
                    let until = if state.requests.waiting_for_room {
                        Some(Instant::now() + limits::ROOM_POLL)
                    } else {
                        until
                    };
                    state = match until {
                        None => self.work.wait(state).unwrap_or_else(PoisonError::into_inner),
                        Some(until) => {
                            let patience = until.saturating_duration_since(Instant::now());
                            let woken = self.work.wait_timeout(state, patience);
                            woken.unwrap_or_else(PoisonError::into_inner).0
                        }
                    };
                }
            }
        }
    }

    fn load(&self, id: SlotId, needed: SectionRef, version: &Version) -> Notifications {
        let chunk = &version.manifest.chunks[needed.chunk];
        let section = &chunk.sections[needed.section];
        let began = Instant::now();
        // A defect in one section's loading must not end the thread that loads all.
        let read = || self.source.section(version, chunk, section);
        let loaded = catch_unwind(AssertUnwindSafe(read));
        let took = began.elapsed();
        let requests = &mut self.lock().requests;
        match loaded {
            Ok(Ok(loaded)) => requests.loaded(id, Arc::new(loaded), took),
            Ok(Err(error)) => requests.load_failed(id, &LoadFailure::Store(error)),
            Err(_) => requests.load_failed(id, &LoadFailure::Crashed),
        }
    }

    /// Hands over what frames waited for.
    fn notify(self: &Arc<Self>, notifications: Notifications) {
        for (done, told) in notifications {
            done(told.map(|CompleteFrame { scene, waited_for, waited }| PinnedScene {
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
