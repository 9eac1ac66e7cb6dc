//! The pushes of a server: waiting, running, and recently ended ones.
//!
//! The pushes of one twin run one after the other, in the order of their requests. Pushes of
//! different twins wait for each other only while memory is short.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::{Mutex as AsyncMutex, OwnedMutexGuard, OwnedSemaphorePermit, Semaphore};

use crate::error::PushError;
use crate::limits;
use crate::request::PushRequest;
use crate::source::SourceFile;
use crate::status::{Push, State};

/// The pushes of a server.
pub struct PushQueue {
    entries: Mutex<Entries>,
    /// One lock per twin with a push that waits or runs.
    twins: Mutex<BTreeMap<String, Arc<AsyncMutex<()>>>>,
    /// Memory of running pushes, in units of [`limits::MEMORY_UNIT_BYTES`].
    memory: Arc<Semaphore>,
    limits: QueueLimits,
}

/// Limits of the pushes of a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueueLimits {
    /// How many may wait or run.
    pub open: usize,
    /// Bytes of memory that running pushes may take together.
    pub memory_bytes: u64,
    /// How long reading and checking one push may take.
    pub check_timeout: Duration,
}

/// The right of a push to run: its share of the memory and the lock of its twin, which are released
/// when all clones are dropped. Blocking threads hold a clone, because they may still run for a
/// moment after their push was cancelled.
#[derive(Clone, Debug)]
pub(crate) struct PushPermit(Arc<PermitParts>);

#[derive(Debug)]
struct PermitParts {
    /// Bytes that the push may unpack.
    memory_bytes: u64,
    _memory: OwnedSemaphorePermit,
    _twin: OwnedMutexGuard<()>,
}

#[derive(Default)]
struct Entries {
    /// By twin and id.
    pushes: BTreeMap<(String, String), Arc<Push>>,
    /// Pushes of assets, which have no id, as long as their callers keep them.
    actors: Vec<Weak<Push>>,
    /// Number of pushes ever begun.
    begun: u64,
}

/// The answer to a request.
pub enum Begun {
    /// The request is that of a push that is already known.
    Known(Arc<Push>),
    /// A new push, which the caller must now run.
    New { push: Arc<Push>, files: Vec<SourceFile> },
}

impl PushQueue {
    /// An empty queue with the given limits; its permits are shared by all pushes of the server.
    pub fn new(limits: QueueLimits) -> Self {
        // Rounding up gives the smallest limit one unit at least, so that a push can always run.
        let memory = Arc::new(Semaphore::new(memory_units(limits.memory_bytes) as usize));
        Self { entries: Mutex::default(), twins: Mutex::default(), memory, limits }
    }

    /// How long reading and checking one push may take.
    pub(crate) fn check_timeout(&self) -> Duration {
        self.limits.check_timeout
    }

    /// Number of pushes that wait or run.
    pub fn open_count(&self) -> usize {
        self.entries.lock().open_count()
    }

    /// A value that changes whenever a push begins or ends.
    pub fn changes(&self) -> (u64, usize) {
        let entries = self.entries.lock();
        (entries.begun, entries.open_count())
    }

    /// The push of an id: a known one, or a new one with the files that `files` returns. A known
    /// push that failed is begun again. `files` is only called for a new push, because the uploads
    /// of a known one may have been removed.
    ///
    /// # Errors
    /// The id belongs to a push with a different request, too many pushes are open, or `files`
    /// found a file missing.
    pub fn begin<E: From<PushError>>(
        &self,
        request: &PushRequest,
        id: &str,
        files: impl FnOnce() -> Result<Vec<SourceFile>, E>,
    ) -> Result<Begun, E> {
        // The lock is held from the lookup to the insertion, so that two equal requests make one
        // push.
        let mut entries = self.entries.lock();
        let key = (request.twin.clone(), id.to_owned());
        if let Some(push) = entries.pushes.get(&key) {
            if push.request_hash() != request.request_hash {
                let must = format!("{id:?}, the id of a push that asked for something else");
                return Err(PushError::OutOfRange { field: "id".to_owned(), must }.into());
            }
            // A refused push stays known: the same content would be refused again. A failed one may
            // be tried again under its id.
            if push.status().state != State::Failed {
                return Ok(Begun::Known(push.clone()));
            }
        }
        let limit = self.limits.open;
        if entries.open_count() >= limit {
            return Err(PushError::Busy { limit }.into());
        }
        // The files come last: a request that is refused for another reason pins no upload.
        let files = files()?;
        entries.begun += 1;
        let push = Arc::new(Push::new(request.request_hash, entries.begun));
        entries.pushes.insert(key, push.clone());
        // The inserted push is open, so that it is never the one that is forgotten.
        entries.forget_oldest();
        Ok(Begun::New { push, files })
    }

    /// A new push of an asset. It counts among the open ones until it has ended.
    ///
    /// # Errors
    /// [`PushError::Busy`].
    pub fn begin_actor(&self) -> Result<Arc<Push>, PushError> {
        let mut entries = self.entries.lock();
        let limit = self.limits.open;
        if entries.open_count() >= limit {
            return Err(PushError::Busy { limit });
        }
        entries.begun += 1;
        // No other request is this push, so that its hash is never compared.
        let push = Arc::new(Push::new(blake3::hash(&[]), entries.begun));
        // An asset's push has no id by which it could be found, so a weak reference is enough to
        // count it.
        entries.actors.retain(|actor| actor.strong_count() > 0);
        entries.actors.push(Arc::downgrade(&push));
        Ok(push)
    }

    /// A push that was begun.
    ///
    /// # Errors
    /// [`PushError::UnknownPush`].
    pub fn get(&self, twin: &str, id: &str) -> Result<Arc<Push>, PushError> {
        let found = self.entries.lock().pushes.get(&(twin.to_owned(), id.to_owned())).cloned();
        found.ok_or_else(|| PushError::UnknownPush { id: id.to_owned(), twin: twin.to_owned() })
    }

    /// Waits for the permit of a push whose files have `file_bytes` bytes.
    pub(crate) async fn permit(
        &self,
        twin: &str,
        file_bytes: u64,
    ) -> Result<PushPermit, PushError> {
        self.permit_with(twin, limits::push_memory_bytes(file_bytes)).await
    }

    /// Waits for the permit of a push that may use `memory_bytes` bytes of memory.
    pub(crate) async fn permit_with(
        &self,
        twin: &str,
        memory_bytes: u64,
    ) -> Result<PushPermit, PushError> {
        let lock = {
            let mut twins = self.twins.lock();
            // Remove locks that no push holds or waits for.
            twins.retain(|_, lock| Arc::strong_count(lock) > 1);
            twins.entry(twin.to_owned()).or_default().clone()
        };
        // Lock the twin first, so that a push that waits for its twin reserves no memory, which
        // pushes of other twins may need.
        let twin = lock.lock_owned().await;
        // More than there is would wait for ever. A push that is capped runs alone, and its reader
        // refuses files that unpack to more.
        let needed = memory_bytes.min(self.limits.memory_bytes);
        let memory = self
            .memory
            .clone()
            .acquire_many_owned(memory_units(needed))
            .await
            // The semaphore is never closed while the process runs.
            .map_err(|_| PushError::ShuttingDown)?;
        let parts = PermitParts { memory_bytes: needed, _memory: memory, _twin: twin };
        Ok(PushPermit(Arc::new(parts)))
    }
}

impl PushPermit {
    /// Bytes that the push may unpack.
    pub(crate) fn memory_bytes(&self) -> u64 {
        self.0.memory_bytes
    }
}

/// Bytes as permits of the semaphore, rounded up.
fn memory_units(bytes: u64) -> u32 {
    // u32::MAX units of 1 MiB are 4 PiB.
    u32::try_from(bytes.div_ceil(limits::MEMORY_UNIT_BYTES)).unwrap_or(u32::MAX)
}

impl Entries {
    fn open_count(&self) -> usize {
        // At most 64 remembered and some open ones, so counting is cheaper than a counter that must
        // agree with every way in which a push ends.
        let actors = self.actors.iter().filter_map(Weak::upgrade).filter(|push| push.is_open());
        self.pushes.values().filter(|push| push.is_open()).count() + actors.count()
    }

    /// Removes the oldest ended pushes while there are too many.
    fn forget_oldest(&mut self) {
        // One iteration, as a rule: each begun push adds one entry. An open push is never removed.
        while self.pushes.len() > limits::REMEMBERED_PUSHES {
            let ended = self.pushes.iter().filter(|(_, push)| !push.is_open());
            let Some(oldest) = ended.min_by_key(|(_, push)| push.number()) else { return };
            let key = oldest.0.clone();
            self.pushes.remove(&key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Frame;
    use crate::request::CellSelection;
    use crate::status::PushedVersion;

    const TIMEOUT: Duration = Duration::from_secs(60);

    fn queue(open: usize) -> PushQueue {
        PushQueue::new(QueueLimits { open, memory_bytes: 1 << 30, check_timeout: TIMEOUT })
    }

    fn request(content: &str) -> PushRequest {
        PushRequest {
            id: None,
            twin: "city".to_owned(),
            request_hash: blake3::hash(content.as_bytes()),
            files: Vec::new(),
            base: None,
            cells: CellSelection::Touched,
            frame: Frame::Twin,
            record: None,
            levels: true,
            profile: Vec::new(),
            note: None,
            preview_poses: None,
            min_psnr_db: None,
            drop_bad: false,
        }
    }

    fn begin(queue: &PushQueue, content: &str, id: &str) -> Result<Begun, PushError> {
        queue.begin(&request(content), id, || Ok(Vec::new()))
    }

    fn new(begun: Result<Begun, PushError>) -> Arc<Push> {
        match begun {
            Ok(Begun::New { push, .. }) => push,
            Ok(Begun::Known(_)) => panic!("a known push"),
            Err(error) => panic!("{error}"),
        }
    }

    #[test]
    fn an_id_is_one_push_until_it_failed() {
        let queue = queue(2);
        let push = new(begin(&queue, "a", "x"));
        assert!(matches!(begin(&queue, "a", "x"), Ok(Begun::Known(_))));
        assert!(matches!(begin(&queue, "b", "x"), Err(PushError::OutOfRange { .. })));
        // A crash is a failure: the id begins a second push. A refusal below keeps it.
        assert_eq!(push.end(Err(PushError::Crashed)), State::Failed);
        let again = new(begin(&queue, "a", "x"));
        assert!(Arc::ptr_eq(&again, &queue.get("city", "x").unwrap()));
        let refused = PushError::Content { reason: "bad".to_owned(), cells: Vec::new() };
        assert_eq!(again.end(Err(refused)), State::Refused);
        assert!(matches!(begin(&queue, "a", "x"), Ok(Begun::Known(_))));
        assert!(matches!(queue.get("city", "y"), Err(PushError::UnknownPush { .. })));
    }

    #[test]
    fn a_push_without_its_files_is_not_begun() {
        let queue = queue(1);
        let missing = || Err(PushError::Unreadable { name: "a".into(), reason: "gone".into() });
        assert!(queue.begin(&request("a"), "x", missing).is_err());
        assert_eq!(queue.open_count(), 0);
        // A known push no longer needs its files.
        new(begin(&queue, "a", "x"));
        assert!(matches!(queue.begin(&request("a"), "x", missing), Ok(Begun::Known(_))));
    }

    #[test]
    fn open_pushes_and_remembered_ones_have_a_maximum() {
        let queue = queue(1);
        let first = new(begin(&queue, "a", "first"));
        assert!(matches!(begin(&queue, "a", "x"), Err(PushError::Busy { limit: 1 })));
        let version = PushedVersion { number: 1, hash: String::new() };
        first.end(Ok(version.clone()));
        // With the first one this is one more than are remembered.
        for number in 0..limits::REMEMBERED_PUSHES {
            new(begin(&queue, "a", &format!("p{number}"))).end(Ok(version.clone()));
        }
        assert!(queue.get("city", "first").is_err(), "the oldest is forgotten");
        assert!(queue.get("city", "p0").is_ok());
    }

    #[test]
    fn a_push_of_an_asset_counts_until_it_ends_or_is_dropped() {
        let queue = queue(1);
        let actor = queue.begin_actor().unwrap();
        assert!(matches!(queue.begin_actor(), Err(PushError::Busy { limit: 1 })));
        assert!(matches!(begin(&queue, "a", "x"), Err(PushError::Busy { limit: 1 })));
        actor.close(Ok(()));
        drop(queue.begin_actor().unwrap());
        let push = new(begin(&queue, "a", "x"));
        assert!(matches!(queue.begin_actor(), Err(PushError::Busy { limit: 1 })));
        push.end(Err(PushError::Crashed));
        assert!(queue.begin_actor().is_ok());
    }

    /// The permit, if it is granted within 50 ms.
    async fn comes(queue: &PushQueue, twin: &str, file_bytes: u64) -> Option<PushPermit> {
        let permit = queue.permit(twin, file_bytes);
        tokio::time::timeout(Duration::from_millis(50), permit).await.ok().map(Result::unwrap)
    }

    #[tokio::test]
    async fn pushes_of_different_twins_wait_for_memory_only() {
        let queue = queue(8);
        // The queue has 1 GiB, and a push of 1000 bytes takes the base of 256 MiB: four fit.
        let first = comes(&queue, "city", 1000).await.expect("nothing runs");
        assert!(comes(&queue, "city", 1000).await.is_none(), "one push of a twin at a time");
        let other = comes(&queue, "street", 1000).await.expect("another twin");
        // A large push waits until all of the memory is free, and is not overtaken by later ones.
        assert!(comes(&queue, "avenue", 1 << 40).await.is_none());
        drop(other);
        let held = first.clone();
        drop(first);
        assert!(comes(&queue, "city", 1000).await.is_none(), "a thread of the first still runs");
        drop(held);
        let large = comes(&queue, "avenue", 1 << 40).await.expect("nothing runs");
        assert_eq!(large.memory_bytes(), 1 << 30);
        assert!(comes(&queue, "street", 1000).await.is_none(), "no memory is left");
        drop(large);
        assert!(comes(&queue, "street", 1000).await.is_some());
        assert_eq!(queue.twins.lock().len(), 1, "the locks of idle twins are forgotten");
    }

    #[test]
    fn a_cancelled_push_stays_cancelled_until_it_is_sent_again() {
        let queue = queue(2);
        let push = new(begin(&queue, "a", "x"));
        push.enter(State::Ingesting).unwrap();
        assert!(matches!(push.cause(PushError::Crashed), PushError::Crashed));
        push.cancel().unwrap();
        let ended = push.cause(PushError::Crashed);
        assert!(matches!(ended, PushError::Cancelled), "not by how its reading ended: {ended}");
        assert!(matches!(push.enter(State::Committing), Err(PushError::Cancelled)));
        let version = PushedVersion { number: 1, hash: String::new() };
        assert_eq!(push.end(Ok(version)), State::Failed);
        assert!(matches!(push.status().error.as_deref(), Some(PushError::Cancelled)));
        assert!(push.cancel().is_err(), "it has ended");
        assert_eq!(queue.open_count(), 0);
        let again = new(begin(&queue, "a", "x"));
        again.enter(State::Committing).unwrap();
        assert_eq!(again.cancel(), Err("is being published"));
    }
}
