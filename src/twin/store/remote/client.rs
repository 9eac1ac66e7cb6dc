//! Single requests to an object store, with retries and checks.

use std::io::ErrorKind;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

use object_store::path::Path as Key;
use object_store::{GetOptions, GetRange, ObjectMeta, ObjectStore, ObjectStoreExt};

use crate::limits;
use crate::store::StoreError;
use crate::store::layout::check_hash;
use crate::store::local::DiskCache;
use crate::store::object_access::{DiskCacheSettings, Traffic};

use super::retry::{RequestCounter, RequestRunner, RetryPolicy};
use super::url;

/// The twins below a prefix of an object store.
#[derive(Clone, Debug)]
pub(in crate::store) struct Remote {
    pub(super) root: PathBuf,
    /// Prefix of every key.
    pub(super) prefix: Key,
    pub(super) store: Arc<dyn ObjectStore>,
    pub(super) runner: Arc<RequestRunner>,
    pub(super) cache: Option<DiskCache>,
}

impl Remote {
    /// The twins at a URL, as `s3://bucket/twins`, with credentials from the environment.
    ///
    /// # Errors
    /// [`StoreError::Url`] describes the error in the URL or the credentials.
    pub(in crate::store) fn at(
        url: &str,
        cache: Option<&DiskCacheSettings>,
    ) -> Result<Self, StoreError> {
        let (store, prefix) = url::open(url)?;
        Self::over(store, url, prefix.as_ref(), cache, RetryPolicy::default())
    }

    /// The twins within a store that is open already, below a prefix.
    pub(in crate::store) fn over(
        store: Arc<dyn ObjectStore>,
        root: &str,
        prefix: &str,
        cache: Option<&DiskCacheSettings>,
        retry: RetryPolicy,
    ) -> Result<Self, StoreError> {
        let prefix = Key::parse(prefix)
            .map_err(|error| StoreError::Url { url: root.to_owned(), reason: error.to_string() })?;
        let open = |cache: &DiskCacheSettings| DiskCache::open(&cache.dir, cache.limit_bytes);
        let cache = cache.map(open).transpose()?;
        let root = PathBuf::from(root);
        let runner =
            RequestRunner::new(retry).map_err(StoreError::io("start threads for", &root))?;
        Ok(Self { root, prefix, store, runner: Arc::new(runner), cache })
    }

    /// These twins without the disk cache.
    pub(in crate::store) fn uncached(&self) -> Self {
        Self { cache: None, ..self.clone() }
    }

    /// Counts of requests until now, and of their results.
    pub(in crate::store) fn traffic(&self) -> Traffic {
        let mut traffic = self.runner.traffic();
        if let Some(cache) = &self.cache {
            (traffic.cache_hits, traffic.cache_misses) = cache.hits_and_misses();
        }
        traffic
    }

    pub(super) fn key(&self, below: &str) -> Key {
        // Part by part, because `join` would encode a slash.
        below.split('/').fold(self.prefix.clone(), |key, part| key.join(part))
    }

    /// Reads an object of at most `limit_bytes`.
    pub(super) fn get(&self, key: &str, limit_bytes: u64) -> Result<Vec<u8>, StoreError> {
        let store = self.store.clone();
        let at = self.key(key);
        // Each attempt calls the closure again, and needs handles of its own.
        let read = self.run("read", key, move || {
            let store = store.clone();
            let at = at.clone();
            async move {
                let found = store.get(&at).await?;
                let size = found.meta.size;
                if size > limit_bytes {
                    // Within `Ok`, so that it is not tried again: the size stays the same.
                    return Ok(Err(size));
                }
                let bytes = found.bytes().await?;
                // A body that ends early is a failure of the connection, which is tried again.
                if (bytes.len() as u64) < size {
                    let source = format!("it ended after {} of {size} bytes", bytes.len()).into();
                    return Err(object_store::Error::Generic { store: "object store", source });
                }
                Ok(Ok(Vec::from(bytes)))
            }
        })?;
        read.map_err(|size| self.damaged(key, format!("{size} bytes are above {limit_bytes}")))
    }

    /// Reads a range of an object. If the object ends before the range does, the error reports it.
    pub(super) fn range(&self, key: &str, bytes: Range<u64>) -> Result<Vec<u8>, StoreError> {
        let store = self.store.clone();
        let at = self.key(key);
        let wanted = bytes.clone();
        // Steps wait for sections, so that the short time-out applies.
        let retry = self.runner.retry().for_sections();
        let request = move || {
            let store = store.clone();
            let at = at.clone();
            let range = Some(GetRange::Bounded(wanted.clone()));
            async move {
                let options = GetOptions { range, ..GetOptions::default() };
                let found = store.get_opts(&at, options).await?;
                found.bytes().await.map(Vec::from)
            }
        };
        let read = self
            .runner
            .start(retry, request)
            .wait()
            .map_err(StoreError::io("read", &self.root.join(key)));
        let short = match &read {
            Ok(part) => (part.len() as u64) < bytes.end - bytes.start,
            Err(StoreError::Io { cause, .. }) => cause.kind() == ErrorKind::Other,
            // Other kinds, such as a missing object, say enough by themselves.
            Err(_) => false,
        };
        // Stores differ in how they answer a range past the end: with fewer bytes, or with an
        // error.
        if short
            && let Ok(ObjectMeta { size, .. }) = self.head(key)
            && size < bytes.end
        {
            return Err(self.damaged(key, format!("it has {size} bytes; {} are needed", bytes.end)));
        }
        read
    }

    /// Reads until the bytes match their hash, a bounded number of times, because they may have
    /// been damaged in transit and not in the store.
    pub(super) fn read_verified(
        &self,
        key: &str,
        hash: &str,
        read: impl Fn() -> Result<Vec<u8>, StoreError>,
    ) -> Result<Vec<u8>, StoreError> {
        let mut tries = 1;
        loop {
            let bytes = read()?;
            match check_hash(&bytes, hash) {
                Ok(()) => return Ok(bytes),
                Err(_) if tries < limits::VERIFIED_READ_TRIES => {
                    self.runner.count(RequestCounter::Retry);
                    tries += 1;
                }
                Err(reason) => return Err(self.damaged(key, reason)),
            }
        }
    }

    pub(super) fn head(&self, key: &str) -> Result<ObjectMeta, StoreError> {
        let store = self.store.clone();
        let at = self.key(key);
        let retry = self.runner.retry().for_sections();
        let request = move || {
            let store = store.clone();
            let at = at.clone();
            async move { store.head(&at).await }
        };
        let found = self.runner.start(retry, request).wait();
        found.map_err(StoreError::io("find", &self.root.join(key)))
    }

    pub(super) fn delete(&self, key: &str) -> Result<(), StoreError> {
        let store = self.store.clone();
        let at = self.key(key);
        let deleted = self.run("remove", key, move || {
            let store = store.clone();
            let at = at.clone();
            async move { store.delete(&at).await }
        });
        match deleted {
            // An earlier attempt has removed it, and its answer was lost; or another process has.
            Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => Ok(()),
            deleted => deleted,
        }
    }

    /// Runs a request to its end, with retries, on the store's own threads.
    pub(super) fn run<T, F>(
        &self,
        action: &'static str,
        key: &str,
        request: impl Fn() -> F + Send + 'static,
    ) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: Future<Output = object_store::Result<T>> + Send,
    {
        self.runner.run(request).map_err(StoreError::io(action, &self.root.join(key)))
    }

    pub(super) fn damaged(&self, key: &str, reason: String) -> StoreError {
        StoreError::Damaged { path: self.root.join(key), reason }
    }
}
