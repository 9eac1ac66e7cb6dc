//! The pager: loads what is wanted, in order of urgency, and gives a frame all it needs at once.
//!
//! A frame that waits holds nothing, so frames cannot block each other; its sections are spared by
//! everybody but older frames ([`Asker`]). Threads of its own load, because reading blocks; nobody
//! else ever waits in here for more than a lock.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::config;
use crate::scene::{Chunk, Scene, Sky};
use crate::store::{StoreError, Version};

use super::load_times::LoadTimes;
use super::table::{Asker, Id, Table};
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

/// What a frame is told once: what it draws, or why it cannot.
pub type Done = Box<dyn FnOnce(Result<Pinned, ResidencyError>) + Send>;

/// A frame's place among those that wait; dropping it gives the place up.
pub(super) struct Waiting {
    shared: Arc<Shared>,
    number: u64,
}

/// Sections of a version.
pub(super) struct Wanted {
    pub(super) version: Arc<Version>,
    pub(super) sky: Option<Arc<Sky>>,
    pub(super) needed: Vec<Needed>,
    /// Their names in the table, in the same order.
    pub(super) ids: Vec<Id>,
}

struct Shared {
    source: Arc<dyn Source>,
    state: Mutex<State>,
    /// Rings when there may be something to load, or room for it.
    work: Condvar,
}

struct State {
    table: Table,
    /// What is to be loaded, the most urgent first. A section may stand here for several, and stays
    /// until it is there.
    queue: BTreeMap<Place, Needed>,
    requests: BTreeMap<u64, Request>,
    /// Sections whose last load failed.
    failures: BTreeMap<Id, Failure>,
    /// Requests so far: numbers them, and stamps what they want.
    number: u64,
    /// A load waits for room.
    starving: bool,
    started: bool,
    closed: bool,
    stats: Stats,
    load_times: LoadTimes,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    urgency: Urgency,
    request: u64,
    /// Sooner is smaller.
    order: u32,
    id: Id,
}

/// How soon something is needed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Urgency {
    /// A frame waits for it.
    Required,
    /// The next second's frames will.
    Imminent,
    /// Somebody may come that way.
    Speculative,
}

struct Request {
    wanted: Wanted,
    /// What it may push out.
    asker: Asker,
    /// Only of frames.
    frame: Option<Frame>,
}

struct Frame {
    done: Done,
    asked: Instant,
    waited_for: usize,
    missing: usize,
}

struct Failure {
    attempts: u32,
    not_before: Instant,
}

/// What a loader does next.
enum Next {
    Load { id: Id, needed: Needed, version: Arc<Version> },
    Wait(Option<Instant>),
}

/// Frames to be told, once the lock is open: whoever is told may drop what it gets, which locks.
type Tellings = Vec<(Done, Result<Pinned, ResidencyError>)>;

impl Pager {
    pub(super) fn new(source: Arc<dyn Source>, limit_bytes: u64) -> Self {
        let state = State {
            table: Table::new(limit_bytes),
            queue: BTreeMap::new(),
            requests: BTreeMap::new(),
            failures: BTreeMap::new(),
            number: 0,
            starving: false,
            started: false,
            closed: false,
            stats: Stats::default(),
            load_times: LoadTimes::default(),
        };
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
        for number in 0..config::LOADERS {
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
        change(&mut self.0.lock().table)
    }

    /// Tells `done` as soon as all of what a frame needs is in memory; at once if it is.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`]; `done` is dropped then.
    pub(super) fn ask(&self, wanted: Wanted, done: Done) -> Result<Waiting, ResidencyError> {
        let mut tellings = Tellings::new();
        let number = self.0.lock().ask(wanted, done, &self.0, &mut tellings)?;
        if tellings.is_empty() {
            self.0.work.notify_all();
        }
        tell(tellings);
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
            let mut state = self.0.lock();
            if let Some(before) = before {
                state.withdraw_prefetch(before);
            }
            let number = state.prefetch(before, wanted, urgencies);
            state.forget_failures();
            number
        };
        self.0.work.notify_all();
        number
    }

    /// Loads nothing more of what was wanted under a number.
    pub(super) fn withdraw_prefetch(&self, number: u64) {
        let mut state = self.0.lock();
        state.withdraw_prefetch(number);
        state.forget_failures();
    }

    /// Sections that were wanted under a number and may still come: not those that are there, that
    /// failed or for which there was no room.
    pub(super) fn coming(&self, number: u64) -> usize {
        let state = self.0.lock();
        let of = |urgency| state.queue.range(places_of(urgency, number));
        let places = of(Urgency::Imminent).chain(of(Urgency::Speculative));
        places.filter(|(place, _)| state.table.get(place.id).is_none()).count()
    }

    /// Bytes of memory in use, and bytes there are.
    pub(super) fn memory(&self) -> (u64, u64) {
        let state = self.0.lock();
        (state.table.held_bytes(), state.table.limit_bytes())
    }

    /// How long the last loads took.
    pub(super) fn load_times(&self) -> LoadTimes {
        self.0.lock().load_times.clone()
    }

    /// All but what is set aside, which the pager does not know.
    pub(super) fn stats(&self) -> Stats {
        // Sorted once the lock is open again.
        let times = self.load_times();
        let state = self.0.lock();
        let stats = Stats {
            held_bytes: state.table.held_bytes(),
            limit_bytes: state.table.limit_bytes(),
            held_sections: state.table.held_sections(),
            ..state.stats
        };
        drop(state);
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
        let state = self.shared.lock();
        let frame = state.requests.get(&self.number).and_then(|request| request.frame.as_ref());
        frame.map_or(0, |frame| frame.missing)
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        // What it was to be told is dropped once the lock is open: it may hold anything.
        let _done = {
            let mut state = self.shared.lock();
            let done = state.give_up(self.number);
            state.forget_failures();
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
        if self.shared.lock().starving {
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
            match state.next(Instant::now()) {
                Next::Load { id, needed, version } => {
                    drop(state);
                    let tellings = self.load(id, needed, &version);
                    self.work.notify_all();
                    tell(tellings);
                    state = self.lock();
                }
                Next::Wait(until) => {
                    // A frame's end rings. What else may hold a chunk for a moment does not, so that
                    // whoever waits for room looks again now and then.
                    let until = if state.starving {
                        Some(Instant::now() + config::ROOM_POLL)
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

    fn load(self: &Arc<Self>, id: Id, needed: Needed, version: &Arc<Version>) -> Tellings {
        let chunk = &version.manifest.chunks[needed.chunk];
        let section = &chunk.sections[needed.section];
        let began = Instant::now();
        // A defect in one section's loading must not end the thread that loads all.
        let read = || self.source.section(version, chunk, section);
        let loaded = catch_unwind(AssertUnwindSafe(read));
        let took = began.elapsed();
        let mut tellings = Tellings::new();
        let mut state = self.lock();
        match loaded {
            Ok(Ok(loaded)) => state.arrived(id, Arc::new(loaded), took, self, &mut tellings),
            Ok(Err(error)) => {
                match error {
                    StoreError::Damaged { .. } => state.stats.failed_damaged += 1,
                    _ => state.stats.failed_unreadable += 1,
                }
                state.failed(id, &error.to_string(), &mut tellings);
            }
            Err(_) => {
                state.stats.failed_crashed += 1;
                state.failed(id, "the program crashed; its log says where", &mut tellings);
            }
        }
        tellings
    }
}

impl State {
    fn ask(
        &mut self,
        wanted: Wanted,
        done: Done,
        shared: &Arc<Shared>,
        tellings: &mut Tellings,
    ) -> Result<u64, ResidencyError> {
        let needed_bytes: u64 = wanted.ids.iter().map(|&id| self.table.bytes(id)).sum();
        let limit_bytes = self.table.limit_bytes();
        if needed_bytes > limit_bytes {
            let twin = wanted.version.manifest.twin.clone();
            return Err(ResidencyError::TooLarge { twin, needed_bytes, limit_bytes });
        }
        self.number += 1;
        let number = self.number;
        let mut missing = 0;
        for (&id, &needed) in wanted.ids.iter().zip(&wanted.needed) {
            self.table.want(id, number);
            if self.table.get(id).is_none() {
                missing += 1;
                let urgency = Urgency::Required;
                self.queue.insert(Place { urgency, request: number, order: 0, id }, needed);
            }
        }
        self.stats.hits += (wanted.ids.len() - missing) as u64;
        self.stats.misses += missing as u64;
        let frame = Frame { done, asked: Instant::now(), waited_for: missing, missing };
        let asker = Asker::Frame(number);
        if missing == 0 {
            tellings.push(self.complete(Request { wanted, asker, frame: None }, frame, shared));
        } else {
            self.stats.waits += 1;
            wanted.ids.iter().for_each(|&id| self.table.wait(id, number));
            self.requests.insert(number, Request { wanted, asker, frame: Some(frame) });
        }
        Ok(number)
    }

    fn prefetch(&mut self, before: Option<u64>, wanted: Wanted, urgencies: &[Urgency]) -> u64 {
        self.number += 1;
        let request = self.number;
        let all = wanted.ids.iter().zip(&wanted.needed).zip(urgencies);
        for (order, ((&id, &needed), &urgency)) in (0..).zip(all) {
            self.table.want(id, request);
            if self.table.get(id).is_none() && self.queue.len() < config::QUEUED_SECTIONS {
                self.queue.insert(Place { urgency, request, order, id }, needed);
            }
        }
        // What its owner has wanted since its last time stays; for an owner that is new, what any
        // other has.
        let since = |request: &Request| match request.asker {
            Asker::Prefetch(since) => Some(since),
            Asker::Frame(_) => None,
        };
        let others = || self.requests.values().filter_map(since).min();
        let asker = Asker::Prefetch(before.or_else(others).unwrap_or(request));
        self.requests.insert(request, Request { wanted, asker, frame: None });
        request
    }

    fn withdraw_prefetch(&mut self, number: u64) {
        self.requests.remove(&number);
        self.unqueue(Urgency::Imminent, number);
        self.unqueue(Urgency::Speculative, number);
    }

    fn unqueue(&mut self, urgency: Urgency, request: u64) {
        let places = self.queue.range(places_of(urgency, request));
        let places: Vec<Place> = places.map(|(place, _)| *place).collect();
        places.iter().for_each(|place| {
            self.queue.remove(place);
        });
    }

    /// Drops the failures of what nobody wants any more: whoever wants it next has all attempts, and
    /// its name may become another section's. What is wanted and not there stands in the queue.
    fn forget_failures(&mut self) {
        if !self.failures.is_empty() {
            let wanted: BTreeSet<Id> = self.queue.keys().map(|place| place.id).collect();
            self.failures.retain(|id, _| wanted.contains(id));
        }
    }

    /// Takes a frame from those that wait.
    fn give_up(&mut self, number: u64) -> Option<Request> {
        let request = self.requests.remove(&number)?;
        request.wanted.ids.iter().for_each(|&id| self.table.unwait(id, number));
        self.unqueue(Urgency::Required, number);
        let frame = request.frame.as_ref()?;
        self.stats.waits_given_up += 1;
        self.stats.wait_time += frame.asked.elapsed();
        Some(request)
    }

    /// The most urgent section that can be loaded now. Room is taken for it.
    fn next(&mut self, now: Instant) -> Next {
        self.starving = false;
        let (mut over, mut soonest, mut found) = (Vec::new(), None, None);
        let mut full = None;
        for (place, needed) in &self.queue {
            let Place { urgency, request, id, .. } = *place;
            if self.table.get(id).is_some() || full == Some(request) {
                over.push(*place);
                continue;
            }
            if !self.table.is_absent(id) {
                continue;
            }
            if let Some(failure) = self.failures.get(&id)
                && failure.not_before > now
            {
                soonest = Some(soonest.map_or(failure.not_before, |s| failure.not_before.min(s)));
                continue;
            }
            let Some(Request { asker, wanted, .. }) = self.requests.get(&request) else {
                over.push(*place);
                continue;
            };
            match self.table.reserve(id, *asker) {
                Some(dropped) => {
                    let version = wanted.version.clone();
                    found = Some((id, *needed, version, dropped));
                    break;
                }
                // Nobody younger may take the room that it waits for.
                None if urgency == Urgency::Required => {
                    self.starving = true;
                    break;
                }
                None => {
                    full = Some(request);
                    over.push(*place);
                    self.stats.prefetches_dropped += 1;
                }
            }
        }
        over.iter().for_each(|place| {
            self.queue.remove(place);
        });
        self.forget_failures();
        let Some((id, needed, version, dropped)) = found else { return Next::Wait(soonest) };
        self.stats.evictions += dropped.len() as u64;
        dropped.into_iter().for_each(|dropped| self.is_missing_again(dropped));
        if self.failures.contains_key(&id) {
            self.stats.retries += 1;
        }
        Next::Load { id, needed, version }
    }

    /// Something was dropped that younger frames wait for: they wait for it to be loaded again.
    fn is_missing_again(&mut self, id: Id) {
        for &number in self.table.waiting(id) {
            let Some(Request { wanted, frame: Some(frame), .. }) = self.requests.get_mut(&number)
            else {
                continue;
            };
            let Some(index) = wanted.ids.iter().position(|&other| other == id) else { continue };
            frame.missing += 1;
            let place = Place { urgency: Urgency::Required, request: number, order: 0, id };
            self.queue.insert(place, wanted.needed[index]);
        }
    }

    fn arrived(
        &mut self,
        id: Id,
        chunk: Arc<Chunk>,
        took: Duration,
        shared: &Arc<Shared>,
        tellings: &mut Tellings,
    ) {
        self.stats.loads += 1;
        self.load_times.add(took);
        self.failures.remove(&id);
        self.table.fill(id, chunk, self.number);
        let mut complete = Vec::new();
        for number in self.table.waiting(id) {
            let request = self.requests.get_mut(number);
            if let Some(frame) = request.and_then(|request| request.frame.as_mut()) {
                frame.missing -= 1;
                if frame.missing == 0 {
                    complete.push(*number);
                }
            }
        }
        for number in complete {
            let Some(mut request) = self.requests.remove(&number) else { continue };
            let Some(frame) = request.frame.take() else { continue };
            request.wanted.ids.iter().for_each(|&id| self.table.unwait(id, number));
            self.unqueue(Urgency::Required, number);
            self.stats.wait_time += frame.asked.elapsed();
            tellings.push(self.complete(request, frame, shared));
        }
    }

    /// Everything is there: the frame takes hold of it.
    fn complete(
        &self,
        request: Request,
        frame: Frame,
        shared: &Arc<Shared>,
    ) -> (Done, Result<Pinned, ResidencyError>) {
        let chunks = request.wanted.ids.iter().filter_map(|&id| self.table.get(id).cloned());
        let pinned = Pinned {
            scene: Scene { chunks: chunks.collect(), sky: request.wanted.sky.clone() },
            shared: shared.clone(),
            waited_for: frame.waited_for,
            waited: if frame.waited_for == 0 { Duration::ZERO } else { frame.asked.elapsed() },
        };
        (frame.done, Ok(pinned))
    }

    /// A load failed: it is tried again after a while, or the frames that wait for it are told.
    fn failed(&mut self, id: Id, cause: &str, tellings: &mut Tellings) {
        let attempts = self.failures.get(&id).map_or(0, |failure| failure.attempts) + 1;
        if attempts < config::LOAD_ATTEMPTS {
            let not_before = Instant::now() + config::LOAD_BACKOFF * 4_u32.pow(attempts - 1);
            self.failures.insert(id, Failure { attempts, not_before });
            self.forget_failures();
            self.table.fail(id);
            return;
        }
        self.failures.remove(&id);
        for number in self.table.waiting(id).to_vec() {
            let Some(request) = self.give_up(number) else { continue };
            let Request { wanted, frame: Some(frame), .. } = request else { continue };
            let index = wanted.ids.iter().position(|&other| other == id).unwrap_or(0);
            let Needed { chunk, section } = wanted.needed[index];
            let manifest = &wanted.version.manifest;
            let (chunk, twin) = (&manifest.chunks[chunk], manifest.twin.clone());
            let (section, cell) = (&chunk.sections[section], chunk.cell);
            let (block, level, cause) = (section.block, section.level, cause.to_owned());
            let error = ResidencyError::Load { twin, cell, block, level, attempts, cause };
            tellings.push((frame.done, Err(error)));
        }
        // Whoever would only have liked to have it, does without.
        self.queue.retain(|place, _| place.id != id);
        self.table.fail(id);
    }
}

/// Where a request's sections stand in the queue.
fn places_of(urgency: Urgency, request: u64) -> RangeInclusive<Place> {
    let first = Place { urgency, request, order: 0, id: 0 };
    first..=Place { order: u32::MAX, id: Id::MAX, ..first }
}

fn tell(tellings: Tellings) {
    for (done, told) in tellings {
        done(told);
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
