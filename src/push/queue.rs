//! The pushes of a server: those that wait, the one that runs, and those that ended not long ago.
//!
//! One push runs at a time, since each takes the memory of its files and all cores.

use std::collections::BTreeMap;
use std::sync::Arc;

use parking_lot::Mutex;
use tokio::sync::{Semaphore, SemaphorePermit};

use crate::error::PushError;
use crate::limits;
use crate::request::PushRequest;
use crate::source::SourceFile;
use crate::status::{Push, State};

/// The pushes of a server.
pub struct PushQueue {
    entries: Mutex<Entries>,
    /// One push runs at a time: each takes the memory of its files, and all cores.
    turn: Semaphore,
    /// How many may wait or run.
    limit: usize,
}

#[derive(Default)]
struct Entries {
    /// By twin and id.
    pushes: BTreeMap<(String, String), Arc<Push>>,
    /// Number of pushes ever begun.
    begun: u64,
}

/// The answer to a request.
pub enum Begun {
    /// The request is that of a push that is already known.
    Known(Arc<Push>),
    /// A new push, which the caller must now run.
    New {
        /// The push.
        push: Arc<Push>,
        /// Its files.
        files: Vec<SourceFile>,
    },
}

impl PushQueue {
    /// An empty queue, of which at most `limit` pushes may wait or run at a time.
    pub fn new(limit: usize) -> Self {
        Self { entries: Mutex::default(), turn: Semaphore::new(1), limit }
    }

    /// Number of pushes that wait or run.
    pub fn open_count(&self) -> usize {
        self.entries.lock().open_count()
    }

    /// The push of an id: a known one, or a new one with the files that `files` returns. A known push that
    /// failed is begun again. `files` is only called for a new push, because the uploads of a known one may
    /// have been removed.
    ///
    /// # Errors
    /// The id belongs to a push that asked for something else, too many pushes are open, or `files`
    /// found a file missing.
    pub fn begin<E: From<PushError>>(
        &self,
        request: &PushRequest,
        id: &str,
        files: impl FnOnce() -> Result<Vec<SourceFile>, E>,
    ) -> Result<Begun, E> {
        let mut entries = self.entries.lock();
        let key = (request.twin.clone(), id.to_owned());
        if let Some(push) = entries.pushes.get(&key) {
            if push.request_hash() != request.request_hash {
                let must = format!("{id:?}, the id of a push that asked for something else");
                return Err(PushError::OutOfRange { field: "id".to_owned(), must }.into());
            }
            if push.status().state != State::Failed {
                return Ok(Begun::Known(push.clone()));
            }
        }
        if entries.open_count() >= self.limit {
            return Err(PushError::Busy { limit: self.limit }.into());
        }
        let files = files()?;
        entries.begun += 1;
        let push = Arc::new(Push::new(request.request_hash, entries.begun));
        entries.pushes.insert(key, push.clone());
        entries.forget_oldest();
        Ok(Begun::New { push, files })
    }

    /// A push that was begun.
    ///
    /// # Errors
    /// [`PushError::UnknownPush`].
    pub fn get(&self, twin: &str, id: &str) -> Result<Arc<Push>, PushError> {
        let found = self.entries.lock().pushes.get(&(twin.to_owned(), id.to_owned())).cloned();
        found.ok_or_else(|| PushError::UnknownPush { id: id.to_owned(), twin: twin.to_owned() })
    }

    /// Waits for the turn of one push. Dropping the permit gives the turn to the next.
    pub(crate) async fn turn(&self) -> Result<SemaphorePermit<'_>, PushError> {
        // The semaphore is never closed while the process runs.
        self.turn.acquire().await.map_err(|_| PushError::ShuttingDown)
    }
}

impl Entries {
    fn open_count(&self) -> usize {
        self.pushes.values().filter(|push| push.is_open()).count()
    }

    /// Forgets the oldest pushes that ended while there are too many.
    fn forget_oldest(&mut self) {
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
    use crate::request::CellSelection;
    use crate::status::PushedVersion;

    fn request(content: &str) -> PushRequest {
        PushRequest {
            id: None,
            twin: "city".to_owned(),
            request_hash: blake3::hash(content.as_bytes()),
            files: Vec::new(),
            base: None,
            cells: CellSelection::Touched,
            record: None,
            levels: true,
            profile: Vec::new(),
            note: None,
            preview_poses: None,
            min_psnr_db: None,
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
        let queue = PushQueue::new(2);
        let push = new(begin(&queue, "a", "x"));
        assert!(matches!(begin(&queue, "a", "x"), Ok(Begun::Known(_))));
        assert!(matches!(begin(&queue, "b", "x"), Err(PushError::OutOfRange { .. })));
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
        let queue = PushQueue::new(1);
        let missing = || Err(PushError::Unreadable { name: "a".into(), reason: "gone".into() });
        assert!(queue.begin(&request("a"), "x", missing).is_err());
        assert_eq!(queue.open_count(), 0);
        // A known push needs its files no more.
        new(begin(&queue, "a", "x"));
        assert!(matches!(queue.begin(&request("a"), "x", missing), Ok(Begun::Known(_))));
    }

    #[test]
    fn open_pushes_and_remembered_ones_have_a_maximum() {
        let queue = PushQueue::new(1);
        let first = new(begin(&queue, "a", "first"));
        assert!(matches!(begin(&queue, "a", "x"), Err(PushError::Busy { limit: 1 })));
        let version = PushedVersion { number: 1, hash: String::new() };
        first.end(Ok(version.clone()));
        for number in 0..limits::REMEMBERED_PUSHES {
            new(begin(&queue, "a", &format!("p{number}"))).end(Ok(version.clone()));
        }
        assert!(queue.get("city", "first").is_err(), "the oldest is forgotten");
        assert!(queue.get("city", "p0").is_ok());
    }
}
