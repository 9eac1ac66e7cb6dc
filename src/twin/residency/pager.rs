//! The pager: loads what is wanted, in order of urgency, and gives a frame all it needs at once.
//!
//! A frame that waits holds nothing, so frames cannot block each other; its sections are spared by
//! everybody but older frames ([`super::table::Asker`]). Threads of its own load, because reading blocks; nobody
//! else ever waits in here for more than a lock.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::limits;
use crate::store::Version;
use wildcity_scene::Scene;

use super::load_times::LoadTimes;
use super::requests::{Done, Failed, Next, Ready, Requests, Tellings, Urgency, Wanted};
use super::table::{Id, Table};
use super::{Needed, ResidencyError, Source, Stats};

/// The table of sections and the threads that fill it, which end with it.
pub(super) struct Pager(Arc<Shared>);

/// What a frame draws, all of it in memory for as long as this lives.
#[derive(Debug)]
pub struct Pinned {
    scene: Scene,
    shared: Arc<Shared>,
    /// Sections that were not in memory when the frame asked.
    pub waited_for: usize,
    /// How long it took until all were.
    pub waited: Duration,
}

/// A frame's place among those that wait; dropping it gives the place up.
pub(super) struct Waiting {
    shared: Arc<Shared>,
    number: u64,
}

struct Shared {
    source: Arc<dyn Source>,
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
    pub(super) fn new(source: Arc<dyn Source>, limit_bytes: u64) -> Self {
        let requests = Requests::new(Table::new(limit_bytes));
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
    pub(super) fn with_table<T>(&self, change: impl FnOnce(&mut Table) -> T) -> T {
        change(&mut self.0.lock().requests.table)
    }

    /// Tells `done` as soon as all of what a frame needs is in memory; at once if it is.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`]; `done` is dropped then.
    pub(super) fn ask(&self, wanted: Wanted, done: Done) -> Result<Waiting, ResidencyError> {
        let mut tellings = Tellings::new();
        let number = self.0.lock().requests.ask(wanted, done, &mut tellings)?;
        if tellings.is_empty() {
            self.0.work.notify_all();
        }
        self.0.tell(tellings);
        Ok(Waiting { shared: self.0.clone(), number })
    }

    /// Loads what somebody may need, in order, as far as there is room, in place of what the same
    /// owner wanted under the number `before`; returns the new number.
    pub(super) fn prefetch(
        &self,
        before: Option<u64>,
        wanted: Wanted,
        urgencies: &[Urgency],
    ) -> u64 {
        let number = {
            let requests = &mut self.0.lock().requests;
            if let Some(before) = before {
                requests.withdraw_prefetch(before);
            }
            let number = requests.prefetch(before, wanted, urgencies);
            requests.forget_failures();
            number
        };
        self.0.work.notify_all();
        number
    }

    /// Loads nothing more of what was wanted under a number.
    pub(super) fn withdraw_prefetch(&self, number: u64) {
        let requests = &mut self.0.lock().requests;
        requests.withdraw_prefetch(number);
        requests.forget_failures();
    }

    /// Sections that were wanted under a number and may still come: not those that are there, that
    /// failed or for which there was no room.
    pub(super) fn coming(&self, number: u64) -> usize {
        self.0.lock().requests.coming(number)
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

impl Waiting {
    /// How many of its sections are not there.
    pub(super) fn missing(&self) -> usize {
        self.shared.lock().requests.missing(self.number)
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        // What it was to be told is dropped once the lock is open: it may hold anything.
        let _done = {
            let requests = &mut self.shared.lock().requests;
            let done = requests.give_up(self.number);
            requests.forget_failures();
            done
        };
        self.shared.work.notify_all();
    }
}

impl std::ops::Deref for Pinned {
    type Target = Scene;

    fn deref(&self) -> &Scene {
        &self.scene
    }
}

impl Drop for Pinned {
    fn drop(&mut self) {
        self.scene.chunks.clear();
        // Under the lock: a loader that has just found everything in use is asleep by then.
        if self.shared.lock().requests.starving {
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
                Next::Load { id, needed, version } => {
                    drop(state);
                    let tellings = self.load(id, needed, &version);
                    self.work.notify_all();
                    self.tell(tellings);
                    state = self.lock();
                }
                Next::Wait(until) => {
                    // A frame's end rings. What else may hold a chunk for a moment does not, so that
                    // whoever waits for room looks again now and then.
                    let until = if state.requests.starving {
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

    fn load(&self, id: Id, needed: Needed, version: &Version) -> Tellings {
        let chunk = &version.manifest.chunks[needed.chunk];
        let section = &chunk.sections[needed.section];
        let began = Instant::now();
        // A defect in one section's loading must not end the thread that loads all.
        let read = || self.source.section(version, chunk, section);
        let loaded = catch_unwind(AssertUnwindSafe(read));
        let took = began.elapsed();
        let requests = &mut self.lock().requests;
        match loaded {
            Ok(Ok(loaded)) => requests.arrived(id, Arc::new(loaded), took),
            Ok(Err(error)) => requests.failed(id, &Failed::Store(error)),
            Err(_) => requests.failed(id, &Failed::Crashed),
        }
    }

    /// Hands over what frames waited for.
    fn tell(self: &Arc<Self>, tellings: Tellings) {
        for (done, told) in tellings {
            done(told.map(|Ready { scene, waited_for, waited }| Pinned {
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

impl std::fmt::Debug for Waiting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Waiting").field("number", &self.number).finish_non_exhaustive()
    }
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").finish_non_exhaustive()
    }
}
