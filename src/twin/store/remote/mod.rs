//! Twins in an object store: S3, GCS, Azure. Only this folder names `object_store`.
//!
//! ObjectBackend are put where they stay, under their hashes: nobody sees them before a record names a
//! manifest that names them. What a killed commit left is removed by garbage collection alone.

mod retry;
pub(super) mod staging;
mod url;

use std::collections::BTreeSet;
use std::io::{self, ErrorKind};
use std::ops::Range;
use std::path::Path;
use std::path::PathBuf;
use std::sync::Arc;

use futures_util::{StreamExt, TryStreamExt};
use object_store::path::Path as Key;
use object_store::{GetOptions, GetRange, ObjectMeta, ObjectStore, ObjectStoreExt, PutPayload};

use crate::limits;
use wildcity_scene::rig::is_name;

use super::StoreError;
use super::local::disk_cache::DiskCache;
use super::objects::{
    self, ListedObject, ObjectBackend, Staging, is_hash, log_numbers, object_key, record_key,
};

use retry::{RequestCounter, RequestRunner};
pub use retry::{RetryPolicy, Traffic};

/// A place within an object store.
#[derive(Clone, Debug)]
pub(super) struct Remote {
    /// The URL.
    root: PathBuf,
    /// What every key begins with.
    prefix: Key,
    store: Arc<dyn ObjectStore>,
    runner: Arc<RequestRunner>,
    cache: Option<DiskCache>,
}

impl ObjectBackend for Remote {
    fn root(&self) -> &Path {
        &self.root
    }

    fn names(&self) -> Result<Vec<String>, StoreError> {
        let (store, prefix) = (self.store.clone(), self.prefix.clone());
        let listed = self.run("list", self.prefix.as_ref(), move || {
            let (store, prefix) = (store.clone(), prefix.clone());
            async move { store.list_with_delimiter(Some(&prefix)).await }
        })?;
        let folders = listed.common_prefixes.iter().filter_map(|key| key.filename());
        let mut names: Vec<String> =
            folders.filter(|name| is_name(name)).map(str::to_owned).collect();
        names.sort_unstable();
        names.retain(|name| !self.numbers(name).is_ok_and(|numbers| numbers.is_empty()));
        Ok(names)
    }

    fn numbers(&self, name: &str) -> Result<Vec<u64>, StoreError> {
        Ok(log_numbers(self.list_side_files(name, "log")?))
    }

    fn record(&self, name: &str, number: u64) -> Result<Vec<u8>, StoreError> {
        self.get(&record_key(name, number), limits::LOG_RECORD_BYTES)
    }

    fn read_object(&self, name: &str, hash: &str, limit_bytes: u64) -> Result<Vec<u8>, StoreError> {
        if let Some(bytes) = self.cache.as_ref().and_then(|cache| cache.get(hash)) {
            return Ok(bytes);
        }
        let key = object_key(name, hash);
        let bytes = self.read_verified(&key, hash, || self.get(&key, limit_bytes))?;
        if let Some(cache) = &self.cache {
            cache.put(hash, &bytes);
        }
        Ok(bytes)
    }

    fn read_start(&self, name: &str, hash: &str, most_bytes: usize) -> Result<Vec<u8>, StoreError> {
        let key = object_key(name, hash);
        let read = || {
            let (store, at) = (self.store.clone(), self.key(&key));
            self.run("read", &key, move || {
                let (store, at) = (store.clone(), at.clone());
                async move {
                    let mut stream = store.get(&at).await?.into_stream();
                    let (mut start, mut hasher) = (Vec::new(), blake3::Hasher::new());
                    while let Some(bytes) = stream.next().await.transpose()? {
                        hasher.update(&bytes);
                        let more = most_bytes.saturating_sub(start.len()).min(bytes.len());
                        start.extend_from_slice(&bytes[..more]);
                    }
                    Ok((start, hasher.finalize().to_hex()))
                }
            })
        };
        // What was damaged on the way is not damaged there: once more.
        let (mut start, mut found) = read()?;
        if found.as_str() != hash {
            (start, found) = read()?;
        }
        if found.as_str() == hash {
            return Ok(start);
        }
        Err(self.damaged(&key, format!("its bytes hash to {found}")))
    }

    fn read_range(
        &self,
        name: &str,
        object: &str,
        bytes: Range<u64>,
        hash: &[u8; 32],
    ) -> Result<Vec<u8>, StoreError> {
        let hash = blake3::Hash::from_bytes(*hash).to_hex();
        if let Some(bytes) = self.cache.as_ref().and_then(|cache| cache.get(&hash)) {
            return Ok(bytes);
        }
        let key = object_key(name, object);
        let part = self.read_verified(&key, &hash, || self.range(&key, bytes.clone()))?;
        if let Some(cache) = &self.cache {
            cache.put(&hash, &part);
        }
        Ok(part)
    }

    fn read_and_discard(&self, name: &str, hash: &str) -> Result<u64, StoreError> {
        let key = object_key(name, hash);
        let (store, at) = (self.store.clone(), self.key(&key));
        self.run("read", &key, move || {
            let (store, at) = (store.clone(), at.clone());
            async move {
                let mut stream = store.get(&at).await?.into_stream();
                let mut bytes = 0;
                while let Some(more) = stream.next().await.transpose()? {
                    bytes += more.len() as u64;
                }
                Ok(bytes)
            }
        })
    }

    fn check_present(&self, name: &str, hash: &str, bytes: u64) -> Result<(), StoreError> {
        let key = object_key(name, hash);
        let found = self.head(&key)?.size;
        if found == bytes {
            return Ok(());
        }
        Err(self.damaged(&key, format!("it has {found} bytes, not {bytes}")))
    }

    fn stage(&self, name: &str, _commit: &str) -> Result<Staging, StoreError> {
        Ok(Staging::Remote(staging::Staging::new(self.clone(), name)))
    }

    fn unfinished_commits(&self) -> Result<Vec<String>, StoreError> {
        Ok(Vec::new())
    }

    fn remove_abandoned(
        &self,
        _name: &str,
        _named: &dyn Fn() -> Option<BTreeSet<String>>,
    ) -> Result<(), StoreError> {
        Ok(())
    }

    fn list(&self, name: &str) -> Result<Vec<ListedObject>, StoreError> {
        let key = format!("{name}/objects");
        let (store, at) = (self.store.clone(), self.key(&key));
        let found: Vec<ObjectMeta> = self.run("list", &key, move || {
            let (store, at) = (store.clone(), at.clone());
            async move { store.list(Some(&at)).try_collect().await }
        })?;
        let listed = found.into_iter().filter_map(|found| {
            let hash = found.location.filename().filter(|name| is_hash(name))?.to_owned();
            let written_us = found.last_modified.timestamp_micros();
            Some(ListedObject { hash, bytes: found.size, written_us })
        });
        let mut listed: Vec<ListedObject> = listed.collect();
        listed.sort_unstable_by(|a, b| a.hash.cmp(&b.hash));
        Ok(listed)
    }

    fn remove(
        &self,
        name: &str,
        which: &mut dyn FnMut() -> Result<Vec<String>, StoreError>,
    ) -> Result<(), StoreError> {
        which()?.iter().try_for_each(|hash| self.delete(&object_key(name, hash)))
    }

    fn list_side_files(&self, name: &str, folder: &str) -> Result<Vec<String>, StoreError> {
        let key = format!("{name}/{folder}");
        let (store, at) = (self.store.clone(), self.key(&key));
        let listed = self.run("list", &key, move || {
            let (store, at) = (store.clone(), at.clone());
            async move { store.list_with_delimiter(Some(&at)).await }
        })?;
        let names = listed.objects.iter().filter_map(|found| found.location.filename());
        let mut names: Vec<String> = names.map(str::to_owned).collect();
        names.sort_unstable();
        Ok(names)
    }

    fn read_side_file(&self, name: &str, note: &str) -> Result<Option<Vec<u8>>, StoreError> {
        match self.get(&format!("{name}/{note}"), limits::SIDE_FILE_BYTES) {
            Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => Ok(None),
            read => read.map(Some),
        }
    }

    fn write_side_file(&self, name: &str, note: &str, bytes: &[u8]) -> Result<(), StoreError> {
        let key = format!("{name}/{note}");
        objects::check_side_file(self.root.join(&key), bytes)?;
        let (store, at, payload) =
            (self.store.clone(), self.key(&key), PutPayload::from(bytes.to_vec()));
        self.run("write", &key, move || {
            let (store, at, payload) = (store.clone(), at.clone(), payload.clone());
            async move { store.put(&at, payload).await.map(|_| ()) }
        })
    }

    fn remove_side_file(&self, name: &str, note: &str) -> Result<(), StoreError> {
        self.delete(&format!("{name}/{note}"))
    }
}

impl Remote {
    /// The place that a URL names, as `s3://bucket/twins`, with credentials from the environment.
    ///
    /// # Errors
    /// Says what is wrong with the URL or the credentials.
    pub(super) fn at(url: &str, cache: Option<DiskCache>) -> Result<Self, StoreError> {
        let (store, prefix) = url::open(url)?;
        Self::over(store, url, prefix.as_ref(), cache, RetryPolicy::default())
    }

    /// A place within a store that is open already.
    pub(super) fn over(
        store: Arc<dyn ObjectStore>,
        root: &str,
        prefix: &str,
        cache: Option<DiskCache>,
        retry: RetryPolicy,
    ) -> Result<Self, StoreError> {
        let prefix = Key::parse(prefix)
            .map_err(|error| StoreError::Url { url: root.to_owned(), reason: error.to_string() })?;
        let root = PathBuf::from(root);
        let runner =
            RequestRunner::new(retry).map_err(StoreError::io("start threads for", &root))?;
        Ok(Self { root, prefix, store, runner: Arc::new(runner), cache })
    }

    /// The same place without the disk cache.
    pub(super) fn uncached(&self) -> Self {
        Self { cache: None, ..self.clone() }
    }

    /// What was asked of the store so far, and how it went.
    pub(super) fn traffic(&self) -> Traffic {
        let mut traffic = self.runner.traffic();
        if let Some(cache) = &self.cache {
            (traffic.cache_hits, traffic.cache_misses) = cache.hits_and_misses();
        }
        traffic
    }

    fn key(&self, below: &str) -> Key {
        below.split('/').fold(self.prefix.clone(), |key, part| key.join(part))
    }

    /// Reads an object of at most so many bytes.
    fn get(&self, key: &str, limit_bytes: u64) -> Result<Vec<u8>, StoreError> {
        let (store, at) = (self.store.clone(), self.key(key));
        let read = self.run("read", key, move || {
            let (store, at) = (store.clone(), at.clone());
            async move {
                let found = store.get(&at).await?;
                let size = found.meta.size;
                if size > limit_bytes {
                    return Ok(Err(size));
                }
                found.bytes().await.map(|bytes| Ok(Vec::from(bytes)))
            }
        })?;
        read.map_err(|size| self.damaged(key, format!("{size} bytes are above {limit_bytes}")))
    }

    /// Reads a part of an object. A part that is shorter than asked for is said to be so.
    fn range(&self, key: &str, bytes: Range<u64>) -> Result<Vec<u8>, StoreError> {
        let (store, at, wanted) = (self.store.clone(), self.key(key), bytes.clone());
        let retry = self.runner.retry().for_sections();
        let request = move || {
            let (store, at) = (store.clone(), at.clone());
            let range = Some(GetRange::Bounded(wanted.clone()));
            async move {
                let options = GetOptions { range, ..GetOptions::default() };
                let found = store.get_opts(&at, options).await?;
                found.bytes().await.map(Vec::from)
            }
        };
        let read = self.runner.start(retry, request).wait();
        let read = read.map_err(StoreError::io("read", &self.root.join(key)));
        let short = match &read {
            Ok(part) => (part.len() as u64) < bytes.end - bytes.start,
            Err(StoreError::Io { cause, .. }) => cause.kind() == ErrorKind::Other,
            Err(_) => false,
        };
        // Stores answer a range past the end as they like.
        if short
            && let Ok(ObjectMeta { size, .. }) = self.head(key)
            && size < bytes.end
        {
            return Err(self.damaged(key, format!("it has {size} bytes; {} are needed", bytes.end)));
        }
        read
    }

    /// Reads until the bytes have their hash: what was damaged on the way is not damaged there.
    fn read_verified(
        &self,
        key: &str,
        hash: &str,
        read: impl Fn() -> Result<Vec<u8>, StoreError>,
    ) -> Result<Vec<u8>, StoreError> {
        let mut tries = 1;
        loop {
            let bytes = read()?;
            match objects::check_hash(&bytes, hash) {
                Ok(()) => return Ok(bytes),
                Err(_) if tries < limits::SOUND_TRIES => {
                    self.runner.count(RequestCounter::Retry);
                    tries += 1;
                }
                Err(reason) => return Err(self.damaged(key, reason)),
            }
        }
    }

    fn head(&self, key: &str) -> Result<ObjectMeta, StoreError> {
        let (store, at) = (self.store.clone(), self.key(key));
        let retry = self.runner.retry().for_sections();
        let request = move || {
            let (store, at) = (store.clone(), at.clone());
            async move { store.head(&at).await }
        };
        let found = self.runner.start(retry, request).wait();
        found.map_err(StoreError::io("find", &self.root.join(key)))
    }

    fn delete(&self, key: &str) -> Result<(), StoreError> {
        let (store, at) = (self.store.clone(), self.key(key));
        let deleted = self.run("remove", key, move || {
            let (store, at) = (store.clone(), at.clone());
            async move { store.delete(&at).await }
        });
        match deleted {
            Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => Ok(()),
            deleted => deleted,
        }
    }

    /// Runs a request to its end, again if need be, on threads of the store's own.
    fn run<T, F>(
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

    fn damaged(&self, key: &str, reason: String) -> StoreError {
        StoreError::Damaged { path: self.root.join(key), reason }
    }
}

/// What an error of a store is among those of the operating system.
fn to_io(error: &object_store::Error) -> io::Error {
    use object_store::Error;
    let kind = match error {
        Error::NotFound { .. } => ErrorKind::NotFound,
        Error::AlreadyExists { .. } | Error::Precondition { .. } => ErrorKind::AlreadyExists,
        Error::PermissionDenied { .. } | Error::Unauthenticated { .. } => {
            ErrorKind::PermissionDenied
        }
        _ => ErrorKind::Other,
    };
    io::Error::new(kind, error.to_string())
}
