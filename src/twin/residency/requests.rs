//! Requests for sections: by frames, which wait until all of theirs are in memory, and by
//! prefetches. Decides which section is loaded next, and which frames are notified once it is
//! loaded or has failed.
//!
//! This module has no thread, lock, or file: they belong to the pager. `C` is a frame's callback,
//! which is stored and returned here, but never called.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::limits;
use crate::store::{StoreError, Version};
use wildcity_scene::{Chunk, Scene, Selection, Sky};

use super::demand::SectionRef;
use super::load_times::LoadTimes;
use super::table::{Requester, SectionTable, SlotId};
use super::{ResidencyError, Stats};

/// All requests, and the table of sections that answers them.
pub(super) struct Requests<C> {
    pub(super) table: SectionTable,
    /// The sections to load, the most urgent first. A section may be queued for several requests;
    /// each entry stays until the section is loaded.
    queue: BTreeMap<QueueKey, SectionRef>,
    requests: BTreeMap<u64, Request<C>>,
    /// Sections whose last load failed.
    failures: BTreeMap<SlotId, RetryState>,
    /// Number of requests until now. It numbers requests, and is the time of last use of their
    /// sections.
    number: u64,
    /// Whether the most urgent load waits for free memory.
    pub(super) waiting_for_room: bool,
    stats: Stats,
    pub(super) load_times: LoadTimes,
}

/// Sections of a version.
pub(super) struct RequestedSections {
    pub(super) version: Arc<Version>,
    pub(super) sky: Option<Arc<Sky>>,
    pub(super) sections: Vec<SectionRef>,
    /// Which views of the frame draw which of them; `None` if all views draw all.
    pub(super) selection: Option<Selection>,
    /// Their slots in the table, in the same order.
    pub(super) ids: Vec<SlotId>,
}

/// The position of a section in the queue: the smallest is loaded first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct QueueKey {
    urgency: Urgency,
    request: u64,
    /// Position within a prefetch; 0 for frames.
    order: u32,
    id: SlotId,
}

/// How soon a section is needed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Urgency {
    /// A frame waits for it.
    Required,
    /// Frames of the next second will need it.
    Imminent,
    /// A session may come this way.
    Speculative,
}

pub(super) struct Request<C> {
    requested: RequestedSections,
    /// Decides what its loads may evict.
    requester: Requester,
    /// `None` for a prefetch.
    frame: Option<Frame<C>>,
}

struct Frame<C> {
    callback: C,
    requested: Instant,
    waited_for: usize,
    missing: usize,
}

/// A failed load that is tried again.
struct RetryState {
    attempts: u32,
    not_before: Instant,
}

/// The next action of a loader thread.
pub(super) enum NextLoad {
    Load {
        id: SlotId,
        section: SectionRef,
        version: Arc<Version>,
        /// Number of the request that it is loaded for.
        request: u64,
    },
    /// Wait for a notification, at most until the given time.
    Wait(Option<Instant>),
}

/// Everything that a frame draws.
pub(super) struct CompleteFrame {
    pub(super) scene: Scene,
    pub(super) waited_for: usize,
    pub(super) waited: Duration,
}

/// Why a load failed.
pub(super) enum LoadFailure {
    Store(StoreError),
    Crashed,
}

/// Callbacks to call once the lock is released: a callback may drop the scene that it gets, which
/// locks.
pub(super) type Notifications<C> = Vec<(C, Result<CompleteFrame, ResidencyError>)>;

impl<C> Requests<C> {
    pub(super) fn new(table: SectionTable) -> Self {
        Self {
            table,
            queue: BTreeMap::new(),
            requests: BTreeMap::new(),
            failures: BTreeMap::new(),
            number: 0,
            waiting_for_room: false,
            stats: Stats::default(),
            load_times: LoadTimes::default(),
        }
    }

    /// Adds a frame that requests everything it draws. Returns its number.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`].
    pub(super) fn add_frame(
        &mut self,
        requested: RequestedSections,
        callback: C,
        notifications: &mut Notifications<C>,
    ) -> Result<u64, ResidencyError> {
        // A frame that can never fit is refused now. In the queue it would wait in front of all
        // others until its deadline.
        let needed_bytes: u64 = requested.ids.iter().map(|&id| self.table.bytes(id)).sum();
        let limit_bytes = self.table.limit_of_sections_bytes();
        if needed_bytes > limit_bytes {
            let twin = requested.version.manifest.twin.clone();
            return Err(ResidencyError::TooLarge { twin, needed_bytes, limit_bytes });
        }
        self.number += 1;
        let number = self.number;

        // Queue what is not in memory.
        let mut missing = 0;
        for (&id, &section) in requested.ids.iter().zip(&requested.sections) {
            self.table.touch(id, number);
            if self.table.get(id).is_none() {
                missing += 1;
                let urgency = Urgency::Required;
                self.queue.insert(QueueKey { urgency, request: number, order: 0, id }, section);
            }
        }
        self.stats.hits += (requested.ids.len() - missing) as u64;
        self.stats.misses += missing as u64;

        // Answer at once, or wait.
        let frame = Frame { callback, requested: Instant::now(), waited_for: missing, missing };
        let requester = Requester::Frame(number);
        if missing == 0 {
            // A complete frame leaves nothing behind: no request, no waiter, no entry in the queue.
            notifications.push(self.complete(&requested, frame));
        } else {
            self.stats.waits += 1;
            requested.ids.iter().for_each(|&id| self.table.add_waiter(id, number));
            self.requests.insert(number, Request { requested, requester, frame: Some(frame) });
        }
        Ok(number)
    }

    /// Adds a prefetch, after its owner's previous one with the number `before`. Returns its
    /// number.
    pub(super) fn add_prefetch(
        &mut self,
        before: Option<u64>,
        requested: RequestedSections,
        urgencies: &[Urgency],
    ) -> u64 {
        self.number += 1;
        let request = self.number;
        let all = requested.ids.iter().zip(&requested.sections).zip(urgencies);
        for (order, ((&id, &section), &urgency)) in (0..).zip(all) {
            // Touched in any case: that it will be needed soon keeps it from eviction, full queue
            // or not.
            self.table.touch(id, request);
            // A full queue takes no more of a prefetch. Frames are queued in any case.
            if self.table.get(id).is_none() && self.queue.len() < limits::QUEUED_SECTIONS {
                self.queue.insert(QueueKey { urgency, request, order, id }, section);
            }
        }
        // It evicts nothing that was used since its owner's previous prefetch. A new owner's evicts
        // nothing that was used since the oldest prefetch of any other owner.
        let since = |request: &Request<C>| match request.requester {
            Requester::Prefetch(since) => Some(since),
            Requester::Frame(_) => None,
        };
        let others = || self.requests.values().filter_map(since).min();
        // If there is no other prefetch, the number of this request itself: everything that was
        // used before it may go.
        let requester = Requester::Prefetch(before.or_else(others).unwrap_or(request));
        self.requests.insert(request, Request { requested, requester, frame: None });
        request
    }

    pub(super) fn cancel_prefetch(&mut self, number: u64) {
        self.requests.remove(&number);
        // The entries of a prefetch have these two urgencies.
        self.unqueue(Urgency::Imminent, number);
        self.unqueue(Urgency::Speculative, number);
    }

    /// Number of sections of a prefetch that may still be loaded.
    pub(super) fn pending(&self, number: u64) -> usize {
        let queued = |urgency| self.queue.range(request_keys(urgency, number));
        let entries = queued(Urgency::Imminent).chain(queued(Urgency::Speculative));
        // Entries of sections that another request has loaded stay in the queue until `next` meets
        // them.
        entries.filter(|(key, _)| self.table.get(key.id).is_none()).count()
    }

    /// Whether there may be a section to load.
    pub(super) fn has_queued(&self) -> bool {
        !self.queue.is_empty()
    }

    /// Number of sections that a frame still waits for.
    pub(super) fn missing(&self, number: u64) -> usize {
        let frame = self.requests.get(&number).and_then(|request| request.frame.as_ref());
        frame.map_or(0, |frame| frame.missing)
    }

    /// Counts a reservation that is only enough for one camera at a time.
    pub(super) fn count_by_camera(&mut self) {
        self.stats.by_camera += 1;
    }

    /// Counts, and what the table holds.
    pub(super) fn stats(&self) -> Stats {
        Stats {
            held_bytes: self.table.held_bytes(),
            limit_bytes: self.table.limit_bytes(),
            held_sections: self.table.held_sections(),
            ..self.stats
        }
    }

    fn unqueue(&mut self, urgency: Urgency, request: u64) {
        let entries = self.queue.range(request_keys(urgency, request));
        // Collected first, because the queue cannot change while a range of it is read.
        let keys: Vec<QueueKey> = entries.map(|(key, _)| *key).collect();
        keys.iter().for_each(|key| {
            self.queue.remove(key);
        });
    }

    /// Forgets the failures of sections that are no longer requested. The next request for one gets
    /// all attempts, and its slot may be reused for another section. What is requested and not in
    /// memory is in the queue.
    pub(super) fn forget_unrequested_failures(&mut self) {
        // Usually there are no failures, so that the set of all queued sections is rarely built.
        if !self.failures.is_empty() {
            let queued: BTreeSet<SlotId> = self.queue.keys().map(|key| key.id).collect();
            self.failures.retain(|id, _| queued.contains(id));
        }
    }

    /// Removes a frame that waits.
    pub(super) fn cancel_frame(&mut self, number: u64) -> Option<Request<C>> {
        let request = self.requests.remove(&number)?;
        request.requested.ids.iter().for_each(|&id| self.table.remove_waiter(id, number));
        self.unqueue(Urgency::Required, number);
        let frame = request.frame.as_ref()?;
        self.stats.waits_given_up += 1;
        self.stats.wait_time += frame.requested.elapsed();
        Some(request)
    }

    /// The most urgent section that can be loaded now. Its memory is reserved.
    pub(super) fn next(&mut self, now: Instant) -> NextLoad {
        self.waiting_for_room = false;
        let mut obsolete = Vec::new();
        let mut next_retry: Option<Instant> = None;
        let mut found = None;
        // The prefetch that did not find enough memory: the rest of it is dropped as well.
        let mut without_room = None;
        // The entries that are met are obsolete, being loaded, waiting for a retry, or the one to
        // load. Obsolete ones are removed below, so that each is met once.
        for (key, section) in &self.queue {
            let QueueKey { urgency, request, id, .. } = *key;
            if self.table.get(id).is_some() || without_room == Some(request) {
                obsolete.push(*key);
                continue;
            }
            // Another thread reads it. The entry stays, because that load may fail.
            let is_loading = !self.table.is_absent(id);
            if is_loading {
                continue;
            }
            // A failed load waits for its next attempt.
            if let Some(failure) = self.failures.get(&id)
                && failure.not_before > now
            {
                let not_before = failure.not_before;
                next_retry = Some(next_retry.map_or(not_before, |soonest| soonest.min(not_before)));
                continue;
            }
            // The request was cancelled.
            let Some(Request { requester, requested, .. }) = self.requests.get(&request) else {
                obsolete.push(*key);
                continue;
            };
            match self.table.reserve(id, *requester) {
                Some(evicted) => {
                    found = Some((*key, *section, requested.version.clone(), evicted));
                    break;
                }
                // No younger frame may take the memory that this one waits for.
                None if urgency == Urgency::Required => {
                    self.waiting_for_room = true;
                    break;
                }
                None => {
                    without_room = Some(request);
                    obsolete.push(*key);
                    self.stats.prefetches_dropped += 1;
                }
            }
        }
        obsolete.iter().for_each(|key| {
            self.queue.remove(key);
        });
        self.forget_unrequested_failures();

        let Some((QueueKey { id, request, .. }, section, version, evicted)) = found else {
            return NextLoad::Wait(next_retry);
        };
        self.stats.evictions += evicted.len() as u64;
        evicted.into_iter().for_each(|evicted| self.requeue_evicted(evicted));
        if self.failures.contains_key(&id) {
            self.stats.retries += 1;
        }
        NextLoad::Load { id, section, version, request }
    }

    /// Whether a section that is being loaded for a request is needed by that one or by another.
    pub(super) fn is_wanted(&self, id: SlotId, request: u64) -> bool {
        self.requests.contains_key(&request)
            || !self.table.waiters(id).is_empty()
            // The whole queue, but only for a request that was cancelled.
            || self.queue.keys().any(|key| key.id == id)
    }

    /// A section was evicted that younger frames need: it is queued again for them.
    fn requeue_evicted(&mut self, id: SlotId) {
        for &number in self.table.waiters(id) {
            let Some(request) = self.requests.get_mut(&number) else { continue };
            let Request { requested, frame: Some(frame), .. } = request else { continue };
            let Some(index) = requested.ids.iter().position(|&other| other == id) else { continue };
            frame.missing += 1;
            let key = QueueKey { urgency: Urgency::Required, request: number, order: 0, id };
            self.queue.insert(key, requested.sections[index]);
        }
    }

    /// A section was loaded. Returns the frames that it completes.
    pub(super) fn loaded(
        &mut self,
        id: SlotId,
        chunk: Arc<Chunk>,
        took: Duration,
    ) -> Notifications<C> {
        self.stats.loads += 1;
        self.load_times.add(took);
        self.failures.remove(&id);
        // The last number that was given is the present time of use, so that the list stays in
        // order.
        self.table.loaded(id, chunk, self.number);

        // Which frames have all of their sections now.
        let mut complete = Vec::new();
        for number in self.table.waiters(id) {
            let request = self.requests.get_mut(number);
            if let Some(frame) = request.and_then(|request| request.frame.as_mut()) {
                // No underflow: a frame's `missing` counts its sections that are not in memory, and
                // this one was not until now.
                frame.missing -= 1;
                // A frame is complete at the moment at which all are in memory together, under this
                // one lock. Its scene gets its `Arc`s before anything can be evicted.
                if frame.missing == 0 {
                    complete.push(*number);
                }
            }
        }
        let mut notifications = Notifications::new();
        for number in complete {
            let Some(Request { requested, frame, .. }) = self.requests.remove(&number) else {
                continue;
            };
            let Some(frame) = frame else { continue };
            requested.ids.iter().for_each(|&id| self.table.remove_waiter(id, number));
            self.unqueue(Urgency::Required, number);
            self.stats.wait_time += frame.requested.elapsed();
            notifications.push(self.complete(&requested, frame));
        }
        notifications
    }

    /// Pins all sections of a frame, which are in memory.
    fn complete(
        &self,
        requested: &RequestedSections,
        frame: Frame<C>,
    ) -> (C, Result<CompleteFrame, ResidencyError>) {
        // None is filtered out: `missing` is 0. The filter only avoids a panic.
        let chunks = requested.ids.iter().filter_map(|&id| self.table.get(id).cloned());
        let complete = CompleteFrame {
            scene: Scene {
                chunks: chunks.collect(),
                selection: requested.selection.clone(),
                placed: Vec::new(),
                sky: requested.sky.clone(),
            },
            waited_for: frame.waited_for,
            // A frame that waited for no section did not wait, however long the call took.
            waited: match frame.waited_for {
                0 => Duration::ZERO,
                _ => frame.requested.elapsed(),
            },
        };
        (frame.callback, Ok(complete))
    }

    /// A load failed. It is tried again after a while; after the last attempt, the frames that wait
    /// for the section are returned with the error.
    pub(super) fn load_failed(&mut self, id: SlotId, failure: &LoadFailure) -> Notifications<C> {
        let mut notifications = Notifications::new();
        let cause = self.count_failure(failure);
        let attempts = self.failures.get(&id).map_or(0, |failure| failure.attempts) + 1;
        if attempts < limits::LOAD_ATTEMPTS {
            // 50 ms after the first failure, then 200 ms.
            let not_before = Instant::now() + limits::LOAD_BACKOFF * 4_u32.pow(attempts - 1);
            self.failures.insert(id, RetryState { attempts, not_before });
            self.forget_unrequested_failures();
            self.table.load_failed(id);
            return notifications;
        }
        self.failures.remove(&id);
        // Copied, because cancelling a frame removes it from the list.
        for number in self.table.waiters(id).to_vec() {
            let Some(request) = self.cancel_frame(number) else { continue };
            let Request { requested, frame: Some(frame), .. } = request else { continue };
            // It is there, because the frame waits for it. The default only avoids a panic.
            let index = requested.ids.iter().position(|&other| other == id).unwrap_or(0);
            let SectionRef { chunk, section } = requested.sections[index];
            let manifest = &requested.version.manifest;
            let chunk = &manifest.chunks[chunk];
            let section = &chunk.sections[section];
            let error = ResidencyError::Load {
                twin: manifest.twin.clone(),
                cell: chunk.cell,
                block: section.block,
                level: section.level,
                attempts,
                cause: cause.clone(),
            };
            notifications.push((frame.callback, Err(error)));
        }
        // Prefetches continue without the section.
        self.queue.retain(|key, _| key.id != id);
        // Last, because it may release the slot, whose number another section then gets.
        self.table.load_failed(id);
        notifications
    }

    /// Counts a failure by kind, and returns its text.
    fn count_failure(&mut self, failure: &LoadFailure) -> String {
        match failure {
            LoadFailure::Store(error @ StoreError::Damaged { .. }) => {
                self.stats.failed_damaged += 1;
                error.to_string()
            }
            LoadFailure::Store(error) => {
                self.stats.failed_unreadable += 1;
                error.to_string()
            }
            LoadFailure::Crashed => {
                self.stats.failed_crashed += 1;
                "the program crashed; its log says where".to_owned()
            }
        }
    }
}

/// The queue keys of a request's sections.
fn request_keys(urgency: Urgency, request: u64) -> RangeInclusive<QueueKey> {
    // Keys are ordered by urgency, then request, so that a request's entries of one urgency are a
    // range.
    let first = QueueKey { urgency, request, order: 0, id: 0 };
    first..=QueueKey { order: u32::MAX, id: SlotId::MAX, ..first }
}
