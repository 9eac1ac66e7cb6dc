//! Who wants what: frames that wait for all of theirs, and what is fetched ahead. Which section is loaded
//! next, and who is told what once it is there or has failed.
//!
//! No thread, no lock and no file: those are the pager's.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::limits;
use crate::store::{StoreError, Version};
use wildcity_scene::{Chunk, Scene, Sky};

use super::load_times::LoadTimes;
use super::pager::PinnedScene;
use super::table::{Requester, SectionTable, SlotId};
use super::{ResidencyError, SectionRef, Stats};

/// All requests, and the table of sections that answers them.
pub(super) struct Requests {
    pub(super) table: SectionTable,
    /// What is to be loaded, the most urgent first. A section may stand here for several, and stays
    /// until it is there.
    queue: BTreeMap<QueueKey, SectionRef>,
    requests: BTreeMap<u64, Request>,
    /// Sections whose last load failed.
    failures: BTreeMap<SlotId, RetryState>,
    /// Requests so far: numbers them, and stamps what they want.
    number: u64,
    /// A load waits for room.
    pub(super) waiting_for_room: bool,
    stats: Stats,
    pub(super) load_times: LoadTimes,
}

/// Sections of a version.
pub(super) struct RequestedSections {
    pub(super) version: Arc<Version>,
    pub(super) sky: Option<Arc<Sky>>,
    pub(super) needed: Vec<SectionRef>,
    /// Their names in the table, in the same order.
    pub(super) ids: Vec<SlotId>,
}

/// What a frame is told once: what it draws, or why it cannot.
pub type SceneCallback = Box<dyn FnOnce(Result<PinnedScene, ResidencyError>) + Send>;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct QueueKey {
    urgency: Urgency,
    request: u64,
    /// Sooner is smaller.
    order: u32,
    id: SlotId,
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

pub(super) struct Request {
    wanted: RequestedSections,
    /// What it may push out.
    requester: Requester,
    /// Only of frames.
    frame: Option<Frame>,
}

struct Frame {
    done: SceneCallback,
    asked: Instant,
    waited_for: usize,
    missing: usize,
}

struct RetryState {
    attempts: u32,
    not_before: Instant,
}

/// What a loader does next.
pub(super) enum NextLoad {
    Load { id: SlotId, needed: SectionRef, version: Arc<Version> },
    Wait(Option<Instant>),
}

/// All that a frame draws.
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

/// Frames to be told, once the lock is open: whoever is told may drop what it gets, which locks.
pub(super) type Notifications = Vec<(SceneCallback, Result<CompleteFrame, ResidencyError>)>;

impl Requests {
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

    /// A frame asks for all that it draws; returns its number.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`].
    pub(super) fn add_frame(
        &mut self,
        wanted: RequestedSections,
        done: SceneCallback,
        notifications: &mut Notifications,
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
            self.table.touch(id, number);
            if self.table.get(id).is_none() {
                missing += 1;
                let urgency = Urgency::Required;
                self.queue.insert(QueueKey { urgency, request: number, order: 0, id }, needed);
            }
        }
        self.stats.hits += (wanted.ids.len() - missing) as u64;
        self.stats.misses += missing as u64;
        let frame = Frame { done, asked: Instant::now(), waited_for: missing, missing };
        let requester = Requester::Frame(number);
        if missing == 0 {
            notifications.push(self.complete(&wanted, frame));
        } else {
            self.stats.waits += 1;
            wanted.ids.iter().for_each(|&id| self.table.add_waiter(id, number));
            self.requests.insert(number, Request { wanted, requester, frame: Some(frame) });
        }
        Ok(number)
    }

    pub(super) fn add_prefetch(
        &mut self,
        before: Option<u64>,
        wanted: RequestedSections,
        urgencies: &[Urgency],
    ) -> u64 {
        self.number += 1;
        let request = self.number;
        let all = wanted.ids.iter().zip(&wanted.needed).zip(urgencies);
        for (order, ((&id, &needed), &urgency)) in (0..).zip(all) {
            self.table.touch(id, request);
            if self.table.get(id).is_none() && self.queue.len() < limits::QUEUED_SECTIONS {
                self.queue.insert(QueueKey { urgency, request, order, id }, needed);
            }
        }
        // What its owner has wanted since its last time stays; for an owner that is new, what any
        // other has.
        let since = |request: &Request| match request.requester {
            Requester::Prefetch(since) => Some(since),
            Requester::Frame(_) => None,
        };
        let others = || self.requests.values().filter_map(since).min();
        let requester = Requester::Prefetch(before.or_else(others).unwrap_or(request));
        self.requests.insert(request, Request { wanted, requester, frame: None });
        request
    }

    pub(super) fn cancel_prefetch(&mut self, number: u64) {
        self.requests.remove(&number);
        self.unqueue(Urgency::Imminent, number);
        self.unqueue(Urgency::Speculative, number);
    }

    /// Sections that were wanted under a number and may still come.
    pub(super) fn pending(&self, number: u64) -> usize {
        let of = |urgency| self.queue.range(places_of(urgency, number));
        let places = of(Urgency::Imminent).chain(of(Urgency::Speculative));
        places.filter(|(place, _)| self.table.get(place.id).is_none()).count()
    }

    /// How many sections a frame still waits for.
    pub(super) fn missing(&self, number: u64) -> usize {
        let frame = self.requests.get(&number).and_then(|request| request.frame.as_ref());
        frame.map_or(0, |frame| frame.missing)
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
        let places = self.queue.range(places_of(urgency, request));
        let places: Vec<QueueKey> = places.map(|(place, _)| *place).collect();
        places.iter().for_each(|place| {
            self.queue.remove(place);
        });
    }

    /// Drops the failures of what nobody wants any more: whoever wants it next has all attempts, and
    /// its name may become another section's. What is wanted and not there stands in the queue.
    pub(super) fn forget_failures(&mut self) {
        if !self.failures.is_empty() {
            let wanted: BTreeSet<SlotId> = self.queue.keys().map(|place| place.id).collect();
            self.failures.retain(|id, _| wanted.contains(id));
        }
    }

    /// Takes a frame from those that wait.
    pub(super) fn cancel_frame(&mut self, number: u64) -> Option<Request> {
        let request = self.requests.remove(&number)?;
        request.wanted.ids.iter().for_each(|&id| self.table.remove_waiter(id, number));
        self.unqueue(Urgency::Required, number);
        let frame = request.frame.as_ref()?;
        self.stats.waits_given_up += 1;
        self.stats.wait_time += frame.asked.elapsed();
        Some(request)
    }

    /// The most urgent section that can be loaded now. Room is taken for it.
    pub(super) fn next(&mut self, now: Instant) -> NextLoad {
        self.waiting_for_room = false;
        let (mut over, mut soonest, mut found) = (Vec::new(), None, None);
        let mut full = None;
        for (place, needed) in &self.queue {
            let QueueKey { urgency, request, id, .. } = *place;
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
            let Some(Request { requester, wanted, .. }) = self.requests.get(&request) else {
                over.push(*place);
                continue;
            };
            match self.table.reserve(id, *requester) {
                Some(dropped) => {
                    let version = wanted.version.clone();
                    found = Some((id, *needed, version, dropped));
                    break;
                }
                // Nobody younger may take the room that it waits for.
                None if urgency == Urgency::Required => {
                    self.waiting_for_room = true;
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
        let Some((id, needed, version, dropped)) = found else { return NextLoad::Wait(soonest) };
        self.stats.evictions += dropped.len() as u64;
        dropped.into_iter().for_each(|dropped| self.requeue_evicted(dropped));
        if self.failures.contains_key(&id) {
            self.stats.retries += 1;
        }
        NextLoad::Load { id, needed, version }
    }

    /// Something was dropped that younger frames wait for: they wait for it to be loaded again.
    fn requeue_evicted(&mut self, id: SlotId) {
        for &number in self.table.waiters(id) {
            let Some(Request { wanted, frame: Some(frame), .. }) = self.requests.get_mut(&number)
            else {
                continue;
            };
            let Some(index) = wanted.ids.iter().position(|&other| other == id) else { continue };
            frame.missing += 1;
            let place = QueueKey { urgency: Urgency::Required, request: number, order: 0, id };
            self.queue.insert(place, wanted.needed[index]);
        }
    }

    /// A section is in memory: frames that have all of theirs are told.
    pub(super) fn loaded(
        &mut self,
        id: SlotId,
        chunk: Arc<Chunk>,
        took: Duration,
    ) -> Notifications {
        self.stats.loads += 1;
        self.load_times.add(took);
        self.failures.remove(&id);
        self.table.loaded(id, chunk, self.number);
        let mut complete = Vec::new();
        for number in self.table.waiters(id) {
            let request = self.requests.get_mut(number);
            if let Some(frame) = request.and_then(|request| request.frame.as_mut()) {
                frame.missing -= 1;
                if frame.missing == 0 {
                    complete.push(*number);
                }
            }
        }
        let mut notifications = Notifications::new();
        for number in complete {
            let Some(Request { wanted, frame, .. }) = self.requests.remove(&number) else {
                continue;
            };
            let Some(frame) = frame else { continue };
            wanted.ids.iter().for_each(|&id| self.table.remove_waiter(id, number));
            self.unqueue(Urgency::Required, number);
            self.stats.wait_time += frame.asked.elapsed();
            notifications.push(self.complete(&wanted, frame));
        }
        notifications
    }

    /// Everything is there: the frame takes hold of it.
    fn complete(
        &self,
        wanted: &RequestedSections,
        frame: Frame,
    ) -> (SceneCallback, Result<CompleteFrame, ResidencyError>) {
        let chunks = wanted.ids.iter().filter_map(|&id| self.table.get(id).cloned());
        let ready = CompleteFrame {
            scene: Scene { chunks: chunks.collect(), sky: wanted.sky.clone() },
            waited_for: frame.waited_for,
            waited: if frame.waited_for == 0 { Duration::ZERO } else { frame.asked.elapsed() },
        };
        (frame.done, Ok(ready))
    }

    /// A load failed: it is tried again after a while, or the frames that wait for it are told.
    pub(super) fn load_failed(&mut self, id: SlotId, failed: &LoadFailure) -> Notifications {
        let mut notifications = Notifications::new();
        let (count, cause) = match failed {
            LoadFailure::Store(error @ StoreError::Damaged { .. }) => {
                (&mut self.stats.failed_damaged, error.to_string())
            }
            LoadFailure::Store(error) => (&mut self.stats.failed_unreadable, error.to_string()),
            LoadFailure::Crashed => {
                let cause = "the program crashed; its log says where".to_owned();
                (&mut self.stats.failed_crashed, cause)
            }
        };
        *count += 1;
        let attempts = self.failures.get(&id).map_or(0, |failure| failure.attempts) + 1;
        if attempts < limits::LOAD_ATTEMPTS {
            let not_before = Instant::now() + limits::LOAD_BACKOFF * 4_u32.pow(attempts - 1);
            self.failures.insert(id, RetryState { attempts, not_before });
            self.forget_failures();
            self.table.load_failed(id);
            return notifications;
        }
        self.failures.remove(&id);
        for number in self.table.waiters(id).to_vec() {
            let Some(request) = self.cancel_frame(number) else { continue };
            let Request { wanted, frame: Some(frame), .. } = request else { continue };
            let index = wanted.ids.iter().position(|&other| other == id).unwrap_or(0);
            let SectionRef { chunk, section } = wanted.needed[index];
            let manifest = &wanted.version.manifest;
            let (chunk, twin) = (&manifest.chunks[chunk], manifest.twin.clone());
            let (section, cell) = (&chunk.sections[section], chunk.cell);
            let (block, level, cause) = (section.block, section.level, cause.clone());
            let error = ResidencyError::Load { twin, cell, block, level, attempts, cause };
            notifications.push((frame.done, Err(error)));
        }
        // Whoever would only have liked to have it, does without.
        self.queue.retain(|place, _| place.id != id);
        self.table.load_failed(id);
        notifications
    }
}

/// Where a request's sections stand in the queue.
fn places_of(urgency: Urgency, request: u64) -> RangeInclusive<QueueKey> {
    let first = QueueKey { urgency, request, order: 0, id: 0 };
    first..=QueueKey { order: u32::MAX, id: SlotId::MAX, ..first }
}
