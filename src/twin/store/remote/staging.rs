//! A commit in preparation: objects are uploaded as they come, and the log record is put if absent.

use std::collections::{BTreeSet, VecDeque};
use std::io::{self, ErrorKind};
use std::path::Path;

use object_store::{ObjectStoreExt, PutMode, PutOptions, PutPayload};

use crate::limits;
use crate::store::StoreError;
use crate::store::backend::{Staging, StoredObject, WriteObject};
use crate::store::layout::{object_key, record_key};

use super::client::Remote;
use super::retry::{PendingRequest, RequestCounter};

/// Objects of a commit that no record names yet.
#[derive(Debug)]
pub(super) struct RemoteStaging {
    remote: Remote,
    name: String,
    /// Running uploads, the oldest first.
    uploads: VecDeque<Upload>,
}

#[derive(Debug)]
struct Upload {
    key: String,
    request: PendingRequest<()>,
}

impl RemoteStaging {
    pub(super) fn new(remote: Remote, name: &str) -> Self {
        Self { remote, name: name.to_owned(), uploads: VecDeque::new() }
    }

    /// Waits for all uploads.
    fn wait_for_uploads(&mut self) -> Result<(), StoreError> {
        while !self.uploads.is_empty() {
            self.wait_for_oldest()?;
        }
        Ok(())
    }

    fn wait_for_oldest(&mut self) -> Result<(), StoreError> {
        let Some(Upload { key, request }) = self.uploads.pop_front() else { return Ok(()) };
        request.wait().map_err(StoreError::io("write", &self.remote.root.join(key)))
    }

    fn outcome_unknown(&self, number: u64, cause: io::Error) -> StoreError {
        StoreError::OutcomeUnknown { name: self.name.clone(), number, cause }
    }
}

impl Staging for RemoteStaging {
    /// Begins to upload one object. It is uploaded even if it exists, so that garbage collection
    /// sees it as new.
    ///
    /// # Errors
    /// An earlier upload failed.
    fn put(&mut self, write: WriteObject<'_>) -> Result<StoredObject, StoreError> {
        // In memory, because its key is the hash of all of its bytes.
        let mut object = Vec::new();
        write(&mut object).map_err(StoreError::io("make an object for", &self.remote.root))?;
        let hash = blake3::hash(&object).to_hex().to_string();
        let bytes = object.len() as u64;
        // At most eight objects are in memory, of about 10 MB each.
        while self.uploads.len() >= limits::UPLOADS_AT_ONCE {
            self.wait_for_oldest()?;
        }
        let key = object_key(&self.name, &hash);
        let store = self.remote.store.clone();
        let at = self.remote.key(&key);
        let payload = PutPayload::from(object);
        let request = self.remote.runner.start(self.remote.runner.retry(), move || {
            let store = store.clone();
            let at = at.clone();
            let payload = payload.clone();
            async move { store.put(&at, payload).await.map(|_| ()) }
        });
        self.uploads.push_back(Upload { key, request });
        Ok(StoredObject { hash, bytes })
    }

    /// An object store has no locks: of two commits with one number, the second gets
    /// [`StoreError::Conflict`].
    fn lock_publishing(&mut self) -> Result<(), StoreError> {
        Ok(())
    }

    /// Puts the record, if there is none with its number. If the answer is lost, the record that
    /// exists shows whether it was written, because no two commits write the same record.
    ///
    /// # Errors
    /// [`StoreError::Conflict`]; [`StoreError::OutcomeUnknown`] if the record cannot be read
    /// either.
    fn publish(
        &mut self,
        _hashes: &BTreeSet<&str>,
        number: u64,
        record: &[u8],
    ) -> Result<(), StoreError> {
        // All objects exist before a record names them.
        self.wait_for_uploads()?;
        let key = record_key(&self.name, number);
        let mut backoff = self.remote.runner.retry().backoff;
        let mut tries = 1;
        loop {
            let store = self.remote.store.clone();
            let at = self.remote.key(&key);
            let payload = PutPayload::from(record.to_vec());
            // `once`, because an attempt after a lost answer would take its own record for that of
            // another commit.
            let put = self.remote.runner.once(async move {
                let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
                store.put_opts(&at, payload, options).await.map(|_| ())
            });
            let Err(cause) = put else { return Ok(()) };
            match cause.kind() {
                // The number is taken, or the answer was lost: the existing record shows which.
                ErrorKind::AlreadyExists | ErrorKind::Other | ErrorKind::TimedOut => {}
                _ => return Err(StoreError::io("write", &self.remote.root.join(&key))(cause)),
            }
            match self.remote.get(&key, limits::LOG_RECORD_BYTES) {
                // The record has the id of the commit, so that an equal one is this commit's.
                Ok(found) if found == record => return Ok(()),
                Ok(_) => return Err(StoreError::Conflict { name: self.name.clone(), number }),
                // Nothing was written: the attempt failed before the store acted on it.
                Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => {}
                Err(_) => return Err(self.outcome_unknown(number, cause)),
            }
            if tries >= self.remote.runner.retry().tries {
                self.remote.runner.count(RequestCounter::Failure);
                return Err(self.outcome_unknown(number, cause));
            }
            self.remote.runner.count(RequestCounter::Retry);
            std::thread::sleep(backoff);
            tries += 1;
            backoff = backoff.saturating_mul(2);
        }
    }

    fn place_objects(&mut self, _hashes: &BTreeSet<&str>) -> Result<(), StoreError> {
        self.wait_for_uploads()
    }

    fn restore(&mut self, _hashes: &BTreeSet<&str>, _number: u64) -> Result<(), StoreError> {
        self.wait_for_uploads()
    }

    fn dir(&self) -> &Path {
        &self.remote.root
    }
}
