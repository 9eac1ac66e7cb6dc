//! An object store in memory that fails requests, loses answers, and stops the process between two
//! requests.
//!
//! A put is atomic and visible at once, as S3 guarantees. Faults are in the requests: a request
//! fails before or after it took effect, and the last request of a process that is stopped takes
//! effect now, later, or never. "Later" is during the next process, for puts that replace nothing.
//!
//! Requests run on one thread, each with its repetitions in the order in which they start, so that
//! a history follows from its seed.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::Bound;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use bytes::Bytes;
use futures_util::stream::{self, BoxStream};
use futures_util::{FutureExt as _, StreamExt as _};
use object_store::path::Path as Key;
use object_store::{
    Attributes, CopyOptions, Error, GetOptions, GetResult, GetResultPayload, ListResult,
    MultipartUpload, ObjectMeta, ObjectStore, PutMode, PutMultipartOptions, PutOptions, PutPayload,
    PutResult, Result,
};

use wildcity_twin::store::clock::Clock;
use wildcity_twin::store::{Catalog, RetryPolicy, StoreError};

use crate::disk::{Fault, Plant, SimClock};
use crate::medium::Medium;
use crate::random::Random;
use crate::reads::{BadReads, Carries, ReadFault, Reads};

/// Prefix of the twins' keys.
const PREFIX: &str = "twins";

/// The most attempts of a request.
const TRIES: u32 = 3;

/// Writes of a push of three cells, about: fewer than on a disk, where each has a dozen.
const WRITES: u64 = 12;

#[derive(Clone, Debug)]
struct Object {
    bytes: Bytes,
    modified_us: i64,
}

/// A put that has no effect yet.
#[derive(Debug)]
struct DelayedPut {
    key: Key,
    bytes: Bytes,
    mode: PutMode,
    /// Writes of the next process before it.
    writes: u64,
}

#[derive(Debug)]
struct State {
    objects: BTreeMap<Key, Object>,
    /// Writes until the fault, and which.
    fault: Option<(u64, Fault)>,
    /// Of [`Fault::Full`]: how many more writes are refused, and whether they have their effect.
    refusals: Option<(u64, bool)>,
    /// The last put of a process that was stopped.
    last: Option<DelayedPut>,
    /// Puts of earlier processes that are still on their way.
    delayed: Vec<DelayedPut>,
    plant: Option<Plant>,
    /// Objects whose put was answered and is not done ([`Plant::RecordBeforeObjects`]).
    withheld: Vec<(Key, Bytes)>,
    reads: Reads,
    /// Keys that count as absent ([`Plant::FailedReadIsAbsent`]).
    absent: BTreeSet<Key>,
}

/// The store as one process sees it. The handle is dead after the process was stopped.
#[derive(Clone, Debug)]
pub(crate) struct SimBucket {
    state: Arc<Mutex<State>>,
    clock: Arc<SimClock>,
    is_dead: Arc<AtomicBool>,
}

/// Result of a write.
enum Outcome {
    Done,
    /// It has its effect, and the answer is lost.
    AnswerLost,
    Refused,
}

fn refused() -> Error {
    Error::Generic { store: "simulation", source: "the request failed".into() }
}

fn not_found(key: &Key) -> Error {
    Error::NotFound { path: key.to_string(), source: "there is none".into() }
}

fn unsupported(what: &str) -> Error {
    Error::NotSupported { source: what.into() }
}

impl SimBucket {
    pub(crate) fn new(clock: Arc<SimClock>, plant: Option<Plant>) -> Self {
        let state = State {
            objects: BTreeMap::new(),
            fault: None,
            refusals: None,
            last: None,
            delayed: Vec::new(),
            plant,
            withheld: Vec::new(),
            reads: Reads::default(),
            absent: BTreeSet::new(),
        };
        Self { state: Arc::new(Mutex::new(state)), clock, is_dead: Arc::default() }
    }

    fn lock_state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no test thread panics with it")
    }

    /// The state, unless the process was stopped.
    fn living(&self) -> Result<MutexGuard<'_, State>> {
        if self.is_stopped() { Err(refused()) } else { Ok(self.lock_state()) }
    }

    /// Returns the state for a read, unless it fails, and the error in the bytes that are read.
    fn read(
        &self,
        key: &Key,
        carries: Carries,
    ) -> Result<(MutexGuard<'_, State>, Option<ReadFault>)> {
        let mut state = self.living()?;
        if state.absent.contains(key) {
            return Err(not_found(key));
        }
        let fault = state.reads.next(carries, |us| self.clock.wait(us));
        if fault.is_some() && state.plant == Some(Plant::FailedReadIsAbsent) {
            state.absent.insert(key.clone());
        }
        if fault == Some(ReadFault::Error) {
            return Err(refused());
        }
        Ok((state, fault))
    }

    /// Returns the state for a write, and the result of the write. `put` is the written object.
    fn write(
        &self,
        put: Option<(&Key, &Bytes, &PutMode)>,
    ) -> Result<(MutexGuard<'_, State>, Outcome)> {
        let mut state = self.living()?;
        let now_us = self.clock.now_us();
        state.apply_due_puts(now_us);
        if let Some((left, has_effect)) = state.refusals {
            state.refusals = (left > 1).then_some((left - 1, has_effect));
            return Ok((state, if has_effect { Outcome::AnswerLost } else { Outcome::Refused }));
        }
        match &mut state.fault {
            Some((0, Fault::Full)) => {
                state.fault = None;
                // One refusal is repeated with success, three are not.
                let times = 1 + state.objects.len() as u64 % 3;
                let has_effect = state.objects.len().is_multiple_of(2);
                state.refusals = (times > 1).then_some((times - 1, has_effect));
                Ok((state, if has_effect { Outcome::AnswerLost } else { Outcome::Refused }))
            }
            Some((0, Fault::Kill)) => {
                self.is_dead.store(true, Ordering::Relaxed);
                let has_effect = state.objects.len().is_multiple_of(2);
                Ok((state, if has_effect { Outcome::AnswerLost } else { Outcome::Refused }))
            }
            Some((0, Fault::PowerCut)) => {
                self.is_dead.store(true, Ordering::Relaxed);
                state.last = put.map(|(key, bytes, mode)| DelayedPut {
                    key: key.clone(),
                    bytes: bytes.clone(),
                    mode: mode.clone(),
                    writes: 0,
                });
                Ok((state, Outcome::Refused))
            }
            Some((writes, _)) => {
                *writes -= 1;
                Ok((state, Outcome::Done))
            }
            None => Ok((state, Outcome::Done)),
        }
    }

    fn meta(key: &Key, object: &Object) -> ObjectMeta {
        let since_1970 = Duration::from_micros(object.modified_us.max(0) as u64);
        ObjectMeta {
            location: key.clone(),
            last_modified: (SystemTime::UNIX_EPOCH + since_1970).into(),
            size: object.bytes.len() as u64,
            e_tag: None,
            version: None,
        }
    }

    fn find(&self, prefix: Option<&Key>) -> Result<Vec<ObjectMeta>> {
        let prefix = prefix.cloned().unwrap_or_default();
        let (state, _) = self.read(&prefix, Carries::Names)?;
        let is_below =
            |key: &Key| key.prefix_match(&prefix).is_some_and(|mut rest| rest.next().is_some());
        let found = state.objects.range((Bound::Included(prefix.clone()), Bound::Unbounded));
        Ok(found
            .filter(|(key, _)| is_below(key))
            .map(|(key, object)| Self::meta(key, object))
            .collect())
    }

    fn remove(&self, key: &Key) -> Result<()> {
        let (mut state, outcome) = self.write(None)?;
        let is_lease = key.as_ref().contains("/leases/");
        let is_leaked = state.plant == Some(Plant::LeakedLease) && is_lease;
        if !matches!(outcome, Outcome::Refused) && !is_leaked {
            state.objects.remove(key);
        }
        match outcome {
            Outcome::Done => Ok(()),
            Outcome::AnswerLost | Outcome::Refused => Err(refused()),
        }
    }
}

impl State {
    fn put(&mut self, key: &Key, bytes: Bytes, mode: &PutMode, now_us: i64) -> Result<()> {
        let replaces =
            self.plant == Some(Plant::RecordReplaced) || !matches!(mode, PutMode::Create);
        if !replaces && self.objects.contains_key(key) {
            return Err(Error::AlreadyExists { path: key.to_string(), source: "it exists".into() });
        }
        self.objects.insert(key.clone(), Object { bytes, modified_us: now_us });
        Ok(())
    }

    /// Lets the puts of earlier processes arrive that are due at this write.
    fn apply_due_puts(&mut self, now_us: i64) {
        for DelayedPut { key, bytes, mode, writes } in std::mem::take(&mut self.delayed) {
            if writes > 0 {
                self.delayed.push(DelayedPut { key, bytes, mode, writes: writes - 1 });
            } else {
                // No process waits for the answer.
                let _ = self.put(&key, bytes, &mode, now_us);
            }
        }
    }

    /// Decides whether the last put of a stopped process takes effect.
    fn end_process(&mut self, random: &mut Random, now_us: i64) {
        self.fault = None;
        self.refusals = None;
        self.reads.planned = None;
        self.withheld.clear();
        self.absent.clear();
        let Some(last) = self.last.take() else { return };
        let replaces_nothing =
            matches!(last.mode, PutMode::Create) || last.key.as_ref().contains("/objects/");
        match random.below(4) {
            0 => {}
            1 | 2 if replaces_nothing => {
                // Before the next commit's record, or after it.
                let writes = random.below(2) * WRITES + random.below(WRITES);
                self.delayed.push(DelayedPut { writes, ..last });
            }
            _ => {
                let _ = self.put(&last.key, last.bytes, &last.mode, now_us);
            }
        }
    }
}

impl Medium for SimBucket {
    fn open(&self, clock: &Arc<SimClock>) -> std::result::Result<Catalog, StoreError> {
        let retry = RetryPolicy {
            tries: TRIES,
            backoff: Duration::ZERO,
            section_tries: TRIES,
            threads: 1,
            ..RetryPolicy::default()
        };
        let catalog = Catalog::over(Arc::new(self.clone()), "sim://bucket", PREFIX, None, retry)?;
        Ok(catalog.with_clock(clock.clone()))
    }

    fn settle(&self, catalog: &Catalog) {
        // Requests are answered in order; whether this one succeeds does not matter.
        let _ = catalog.twins();
    }

    fn fail_after(&self, writes: u64, fault: Fault) {
        self.lock_state().fault = Some((writes % WRITES, fault));
    }

    fn fail_reads(&self, reads: BadReads) {
        self.lock_state().reads.planned = Some(reads);
    }

    fn stop_failing_reads(&self) {
        self.lock_state().reads.planned = None;
    }

    fn take_failed_reads(&self) -> bool {
        // A single request is repeated.
        self.lock_state().reads.take_failed() >= u64::from(TRIES)
    }

    fn stop_failing(&self) {
        let mut state = self.lock_state();
        state.fault = None;
        state.refusals = None;
        state.reads.planned = None;
    }

    fn is_stopped(&self) -> bool {
        self.is_dead.load(Ordering::Relaxed)
    }

    fn stop(&self, _: Fault) {
        self.is_dead.store(true, Ordering::Relaxed);
    }

    fn restarted(&self, random: &mut Random) -> Box<dyn Medium> {
        self.lock_state().end_process(random, self.clock.now_us());
        Box::new(Self {
            state: self.state.clone(),
            clock: self.clock.clone(),
            is_dead: Arc::default(),
        })
    }

    fn apply_delayed_puts(&self) {
        let mut state = self.lock_state();
        state.delayed.iter_mut().for_each(|put| put.writes = 0);
        state.apply_due_puts(self.clock.now_us());
    }

    fn commits_left(&self) -> Vec<String> {
        // Only garbage collection removes the objects of killed commits.
        Vec::new()
    }

    fn leases_left(&self) -> Vec<String> {
        let state = self.lock_state();
        let keys = state.objects.keys().map(Key::to_string);
        keys.filter(|key| key.contains("/leases/")).collect()
    }

    fn has_locks(&self) -> bool {
        false
    }
}

impl fmt::Display for SimBucket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a simulated object store")
    }
}

#[async_trait]
impl ObjectStore for SimBucket {
    async fn put_opts(
        &self,
        key: &Key,
        payload: PutPayload,
        options: PutOptions,
    ) -> Result<PutResult> {
        let bytes = Bytes::from(payload);
        let PutOptions { mode, .. } = options;
        let (mut state, outcome) = self.write(Some((key, &bytes, &mode)))?;
        let now_us = self.clock.now_us();
        if !matches!(outcome, Outcome::Refused) {
            let is_object = key.as_ref().contains("/objects/");
            if state.plant == Some(Plant::RecordBeforeObjects) && is_object {
                state.withheld.push((key.clone(), bytes));
            } else {
                state.put(key, bytes, &mode, now_us)?;
            }
        }
        if state.plant == Some(Plant::RecordBeforeObjects) && key.as_ref().contains("/log/") {
            drop(state);
            // The process may be stopped between the record and the objects.
            let (mut state, _) = self.write(None)?;
            if self.is_stopped() {
                return Err(refused());
            }
            for (key, bytes) in std::mem::take(&mut state.withheld) {
                state.put(&key, bytes, &PutMode::Overwrite, now_us)?;
            }
        }
        match outcome {
            Outcome::Done => {
                Ok(PutResult { e_tag: None, version: None, extensions: Default::default() })
            }
            Outcome::AnswerLost | Outcome::Refused => Err(refused()),
        }
    }

    async fn put_multipart_opts(
        &self,
        _: &Key,
        _: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        Err(unsupported("uploads in parts"))
    }

    async fn get_opts(&self, key: &Key, options: GetOptions) -> Result<GetResult> {
        let carries = match key.as_ref().contains("/objects/") {
            _ if options.head => Carries::Names,
            true => Carries::Digested,
            false => Carries::Content,
        };
        let (state, fault) = self.read(key, carries)?;
        let object = state.objects.get(key).ok_or_else(|| not_found(key))?;
        let meta = Self::meta(key, object);
        let range = match &options.range {
            Some(range) => range.as_range(meta.size).map_err(|_| refused())?,
            None => 0..meta.size,
        };
        let bytes = object.bytes.slice(range.start as usize..range.end as usize);
        let bytes = fault.map_or(bytes.clone(), |fault| fault.damaged(bytes.into()).into());
        Ok(GetResult {
            payload: GetResultPayload::Stream(stream::once(async { Ok(bytes) }).boxed()),
            meta,
            range,
            attributes: Attributes::default(),
            extensions: Default::default(),
        })
    }

    fn delete_stream(
        &self,
        keys: BoxStream<'static, Result<Key>>,
    ) -> BoxStream<'static, Result<Key>> {
        let bucket = self.clone();
        keys.map(move |key| {
            let key = key?;
            bucket.remove(&key)?;
            Ok(key)
        })
        .boxed()
    }

    fn list(&self, prefix: Option<&Key>) -> BoxStream<'static, Result<ObjectMeta>> {
        match self.find(prefix) {
            Ok(found) => stream::iter(found.into_iter().map(Ok)).boxed(),
            Err(error) => async { Err(error) }.into_stream().boxed(),
        }
    }

    async fn list_with_delimiter(&self, prefix: Option<&Key>) -> Result<ListResult> {
        let root = prefix.cloned().unwrap_or_default();
        let mut objects = Vec::new();
        let mut common_prefixes = Vec::new();
        for meta in self.find(prefix)? {
            let rest: Vec<String> = match meta.location.prefix_match(&root) {
                Some(parts) => parts.map(|part| part.as_ref().to_owned()).collect(),
                None => continue,
            };
            match &rest[..] {
                [_] => objects.push(meta),
                [folder, ..] => {
                    let folder = root.clone().join(folder.as_str());
                    if common_prefixes.last() != Some(&folder) {
                        common_prefixes.push(folder);
                    }
                }
                [] => {}
            }
        }
        Ok(ListResult { objects, common_prefixes, extensions: Default::default() })
    }

    async fn copy_opts(&self, _: &Key, _: &Key, _: CopyOptions) -> Result<()> {
        Err(unsupported("copies"))
    }
}
