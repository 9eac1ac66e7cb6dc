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
use super::pager::Pinned;
use super::table::{Asker, Id, Table};
use super::{Needed, ResidencyError, Stats};

/// All requests, and the table of sections that answers them.
pub(super) struct Requests {
    pub(super) table: Table,
    /// What is to be loaded, the most urgent first. A section may stand here for several, and stays
    /// until it is there.
    queue: BTreeMap<Place, Needed>,
    requests: BTreeMap<u64, Request>,
    /// Sections whose last load failed.
    failures: BTreeMap<Id, Failure>,
    /// Requests so far: numbers them, and stamps what they want.
    number: u64,
    /// A load waits for room.
    pub(super) starving: bool,
    stats: Stats,
    pub(super) load_times: LoadTimes,
}

/// Sections of a version.
pub(super) struct Wanted {
    pub(super) version: Arc<Version>,
    pub(super) sky: Option<Arc<Sky>>,
    pub(super) needed: Vec<Needed>,
    /// Their names in the table, in the same order.
    pub(super) ids: Vec<Id>,
}

/// What a frame is told once: what it draws, or why it cannot.
pub type Done = Box<dyn FnOnce(Result<Pinned, ResidencyError>) + Send>;

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

pub(super) struct Request {
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
pub(super) enum Next {
    Load { id: Id, needed: Needed, version: Arc<Version> },
    Wait(Option<Instant>),
}

/// All that a frame draws.
pub(super) struct Ready {
    pub(super) scene: Scene,
    pub(super) waited_for: usize,
    pub(super) waited: Duration,
}

/// Why a load failed.
pub(super) enum Failed {
    Store(StoreError),
    Crashed,
}

/// Frames to be told, once the lock is open: whoever is told may drop what it gets, which locks.
pub(super) type Tellings = Vec<(Done, Result<Ready, ResidencyError>)>;

impl Requests {
    pub(super) fn new(table: Table) -> Self {
        Self {
            table,
            queue: BTreeMap::new(),
            requests: BTreeMap::new(),
            failures: BTreeMap::new(),
            number: 0,
            starving: false,
            stats: Stats::default(),
            load_times: LoadTimes::default(),
        }
    }

    /// A frame asks for all that it draws; returns its number.
    ///
    /// # Errors
    /// [`ResidencyError::TooLarge`].
    pub(super) fn ask(
        &mut self,
        wanted: Wanted,
        done: Done,
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
            tellings.push(self.complete(&wanted, frame));
        } else {
            self.stats.waits += 1;
            wanted.ids.iter().for_each(|&id| self.table.wait(id, number));
            self.requests.insert(number, Request { wanted, asker, frame: Some(frame) });
        }
        Ok(number)
    }

    pub(super) fn prefetch(
        &mut self,
        before: Option<u64>,
        wanted: Wanted,
        urgencies: &[Urgency],
    ) -> u64 {
        self.number += 1;
        let request = self.number;
        let all = wanted.ids.iter().zip(&wanted.needed).zip(urgencies);
        for (order, ((&id, &needed), &urgency)) in (0..).zip(all) {
            self.table.want(id, request);
            if self.table.get(id).is_none() && self.queue.len() < limits::QUEUED_SECTIONS {
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

    pub(super) fn withdraw_prefetch(&mut self, number: u64) {
        self.requests.remove(&number);
        self.unqueue(Urgency::Imminent, number);
        self.unqueue(Urgency::Speculative, number);
    }

    /// Sections that were wanted under a number and may still come.
    pub(super) fn coming(&self, number: u64) -> usize {
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
        let places: Vec<Place> = places.map(|(place, _)| *place).collect();
        places.iter().for_each(|place| {
            self.queue.remove(place);
        });
    }

    /// Drops the failures of what nobody wants any more: whoever wants it next has all attempts, and
    /// its name may become another section's. What is wanted and not there stands in the queue.
    pub(super) fn forget_failures(&mut self) {
        if !self.failures.is_empty() {
            let wanted: BTreeSet<Id> = self.queue.keys().map(|place| place.id).collect();
            self.failures.retain(|id, _| wanted.contains(id));
        }
    }

    /// Takes a frame from those that wait.
    pub(super) fn give_up(&mut self, number: u64) -> Option<Request> {
        let request = self.requests.remove(&number)?;
        request.wanted.ids.iter().for_each(|&id| self.table.unwait(id, number));
        self.unqueue(Urgency::Required, number);
        let frame = request.frame.as_ref()?;
        self.stats.waits_given_up += 1;
        self.stats.wait_time += frame.asked.elapsed();
        Some(request)
    }

    /// The most urgent section that can be loaded now. Room is taken for it.
    pub(super) fn next(&mut self, now: Instant) -> Next {
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

    /// A section is in memory: frames that have all of theirs are told.
    pub(super) fn arrived(&mut self, id: Id, chunk: Arc<Chunk>, took: Duration) -> Tellings {
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
        let mut tellings = Tellings::new();
        for number in complete {
            let Some(Request { wanted, frame, .. }) = self.requests.remove(&number) else {
                continue;
            };
            let Some(frame) = frame else { continue };
            wanted.ids.iter().for_each(|&id| self.table.unwait(id, number));
            self.unqueue(Urgency::Required, number);
            self.stats.wait_time += frame.asked.elapsed();
            tellings.push(self.complete(&wanted, frame));
        }
        tellings
    }

    /// Everything is there: the frame takes hold of it.
    fn complete(&self, wanted: &Wanted, frame: Frame) -> (Done, Result<Ready, ResidencyError>) {
        let chunks = wanted.ids.iter().filter_map(|&id| self.table.get(id).cloned());
        let ready = Ready {
            scene: Scene { chunks: chunks.collect(), sky: wanted.sky.clone() },
            waited_for: frame.waited_for,
            waited: if frame.waited_for == 0 { Duration::ZERO } else { frame.asked.elapsed() },
        };
        (frame.done, Ok(ready))
    }

    /// A load failed: it is tried again after a while, or the frames that wait for it are told.
    pub(super) fn failed(&mut self, id: Id, failed: &Failed) -> Tellings {
        let mut tellings = Tellings::new();
        let (count, cause) = match failed {
            Failed::Store(error @ StoreError::Damaged { .. }) => {
                (&mut self.stats.failed_damaged, error.to_string())
            }
            Failed::Store(error) => (&mut self.stats.failed_unreadable, error.to_string()),
            Failed::Crashed => {
                let cause = "the program crashed; its log says where".to_owned();
                (&mut self.stats.failed_crashed, cause)
            }
        };
        *count += 1;
        let attempts = self.failures.get(&id).map_or(0, |failure| failure.attempts) + 1;
        if attempts < limits::LOAD_ATTEMPTS {
            let not_before = Instant::now() + limits::LOAD_BACKOFF * 4_u32.pow(attempts - 1);
            self.failures.insert(id, Failure { attempts, not_before });
            self.forget_failures();
            self.table.fail(id);
            return tellings;
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
            let (block, level, cause) = (section.block, section.level, cause.clone());
            let error = ResidencyError::Load { twin, cell, block, level, attempts, cause };
            tellings.push((frame.done, Err(error)));
        }
        // Whoever would only have liked to have it, does without.
        self.queue.retain(|place, _| place.id != id);
        self.table.fail(id);
        tellings
    }
}

/// Where a request's sections stand in the queue.
fn places_of(urgency: Urgency, request: u64) -> RangeInclusive<Place> {
    let first = Place { urgency, request, order: 0, id: 0 };
    first..=Place { order: u32::MAX, id: Id::MAX, ..first }
}
