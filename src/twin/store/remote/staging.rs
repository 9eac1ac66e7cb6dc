//! A commit in the making: objects are uploaded as they come, and the record is put if absent.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Write};
use std::path::Path;

use object_store::{ObjectStoreExt, PutMode, PutOptions, PutPayload};

use crate::limits;
use crate::store::StoreError;
use crate::store::objects::{ObjectBackend as _, StoredObject, object_key, record_key};

use super::Remote;
use super::retry::{PendingRequest, RequestCounter};

/// ObjectBackend of a commit that no record names yet.
#[derive(Debug)]
pub(in crate::store) struct Staging {
    remote: Remote,
    name: String,
    /// Uploads that run, oldest first, and their keys.
    uploads: VecDeque<(String, PendingRequest<()>)>,
}

impl Staging {
    pub(super) fn new(remote: Remote, name: &str) -> Self {
        Self { remote, name: name.to_owned(), uploads: VecDeque::new() }
    }

    pub(in crate::store) fn root(&self) -> &Path {
        self.remote.root()
    }

    /// Begins to upload one object, named by its hash; it is put even if it is there, so that garbage
    /// collection takes it for new.
    ///
    /// # Errors
    /// An earlier upload failed.
    pub(in crate::store) fn put(
        &mut self,
        write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<StoredObject, StoreError> {
        let mut object = Vec::new();
        write(&mut object).map_err(StoreError::io("make an object for", self.root()))?;
        let (hash, bytes) = (blake3::hash(&object).to_hex().to_string(), object.len() as u64);
        while self.uploads.len() >= limits::UPLOADS_AT_ONCE {
            self.settle_oldest()?;
        }
        let key = object_key(&self.name, &hash);
        let (store, at) = (self.remote.store.clone(), self.remote.key(&key));
        let payload = PutPayload::from(object);
        let upload = self.remote.runner.start(self.remote.runner.retry(), move || {
            let (store, at, payload) = (store.clone(), at.clone(), payload.clone());
            async move { store.put(&at, payload).await.map(|_| ()) }
        });
        self.uploads.push_back((key, upload));
        Ok(StoredObject { hash, bytes })
    }

    /// Waits for all uploads.
    pub(in crate::store) fn settle(&mut self) -> Result<(), StoreError> {
        while !self.uploads.is_empty() {
            self.settle_oldest()?;
        }
        Ok(())
    }

    fn settle_oldest(&mut self) -> Result<(), StoreError> {
        let Some((key, upload)) = self.uploads.pop_front() else { return Ok(()) };
        upload.wait().map_err(StoreError::io("write", &self.root().join(key)))
    }

    /// Puts the record, if there is none of its number. An answer that was lost is asked for again:
    /// no two commits have the same record.
    ///
    /// # Errors
    /// [`StoreError::Conflict`]; [`StoreError::OutcomeUnknown`] if nobody can say what became of it.
    pub(in crate::store) fn publish(
        &mut self,
        number: u64,
        record: &[u8],
    ) -> Result<(), StoreError> {
        self.settle()?;
        let key = record_key(&self.name, number);
        let mut backoff = self.remote.runner.retry().backoff;
        let mut tries = 1;
        loop {
            let (store, at) = (self.remote.store.clone(), self.remote.key(&key));
            let payload = PutPayload::from(record.to_vec());
            let put = self.remote.runner.once(async move {
                let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
                store.put_opts(&at, payload, options).await.map(|_| ())
            });
            let Err(cause) = put else { return Ok(()) };
            match cause.kind() {
                // It was taken, or nobody knows: what is there tells.
                ErrorKind::AlreadyExists | ErrorKind::Other | ErrorKind::TimedOut => {}
                _ => return Err(StoreError::io("write", &self.root().join(&key))(cause)),
            }
            match self.remote.record(&self.name, number) {
                Ok(found) if found == record => return Ok(()),
                Ok(_) => return Err(StoreError::Conflict { name: self.name.clone(), number }),
                Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => {}
                Err(_) => return Err(self.unsettled(number, cause)),
            }
            if tries >= self.remote.runner.retry().tries {
                self.remote.runner.count(RequestCounter::Failure);
                return Err(self.unsettled(number, cause));
            }
            self.remote.runner.count(RequestCounter::Retry);
            std::thread::sleep(backoff);
            (tries, backoff) = (tries + 1, backoff.saturating_mul(2));
        }
    }

    fn unsettled(&self, number: u64, cause: io::Error) -> StoreError {
        StoreError::OutcomeUnknown { name: self.name.clone(), number, cause }
    }
}
