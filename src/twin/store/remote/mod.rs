//! Twins in an object store: S3, GCS, Azure. Only this folder names `object_store`, except that a
//! catalog can be opened over a store that is open already.
//!
//! Objects are uploaded to their final keys, under their hashes. No reader sees them before a log
//! record names a manifest that names them. Only garbage collection removes the remains of a killed
//! commit.

mod client;
mod retry;
mod same_host;
mod staging;
mod url;

use std::collections::BTreeSet;
use std::io::ErrorKind;
use std::ops::Range;
use std::path::{Path, PathBuf};

use futures_util::{StreamExt, TryStreamExt};
use object_store::{ObjectMeta, ObjectStoreExt, PutPayload};

use crate::limits;
use wildcity_scene::rig::is_name;

use super::StoreError;
use super::backend::{HashedStart, ListedObject, ObjectBackend, ObjectListing, Staging};
use super::disk::Lock;
use super::layout::{
    COLLECTION, LEASES, LOG, OBJECTS, check_side_file, is_hash, log_numbers, object_key, record_key,
};

pub(super) use client::Remote;
pub use retry::RetryPolicy;

use staging::RemoteStaging;

impl ObjectBackend for Remote {
    fn root(&self) -> &Path {
        &self.root
    }

    fn twin_names(&self) -> Result<Vec<String>, StoreError> {
        let store = self.store.clone();
        let prefix = self.prefix.clone();
        let listed = self.run("list", self.prefix.as_ref(), move || {
            let store = store.clone();
            let prefix = prefix.clone();
            async move { store.list_with_delimiter(Some(&prefix)).await }
        })?;
        // A store has no folders: it returns what keys have in front of the next slash.
        let folders = listed.common_prefixes.iter().filter_map(|key| key.filename());
        // Other folders below the prefix are no twins.
        let mut names: Vec<String> =
            folders.filter(|name| is_name(name)).map(str::to_owned).collect();
        names.sort_unstable();
        // As in a directory, a twin whose log cannot be listed stays in the list.
        names.retain(|name| !self.version_numbers(name).is_ok_and(|numbers| numbers.is_empty()));
        Ok(names)
    }

    fn version_numbers(&self, name: &str) -> Result<Vec<u64>, StoreError> {
        Ok(log_numbers(self.list_side_files(name, LOG)?))
    }

    fn read_record(&self, name: &str, number: u64) -> Result<Vec<u8>, StoreError> {
        self.get(&record_key(name, number), limits::LOG_RECORD_BYTES)
    }

    fn read_object(&self, name: &str, hash: &str, limit_bytes: u64) -> Result<Vec<u8>, StoreError> {
        // The cache compares the bytes with the hash.
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

    fn read_and_hash(
        &self,
        name: &str,
        hash: &str,
        most_bytes: usize,
    ) -> Result<HashedStart, StoreError> {
        let key = object_key(name, hash);
        let read = || {
            let store = self.store.clone();
            let at = self.key(&key);
            self.run("read", &key, move || {
                let store = store.clone();
                let at = at.clone();
                async move {
                    // As a stream: an object may have any size.
                    let mut stream = store.get(&at).await?.into_stream();
                    let mut start = Vec::new();
                    let mut hasher = blake3::Hasher::new();
                    while let Some(bytes) = stream.next().await.transpose()? {
                        hasher.update(&bytes);
                        let more = most_bytes.saturating_sub(start.len()).min(bytes.len());
                        start.extend_from_slice(&bytes[..more]);
                    }
                    Ok(HashedStart { start, hash: hasher.finalize().to_hex().to_string() })
                }
            })
        };
        // The bytes may have been damaged in transit and not in the store: read once more.
        let first = read()?;
        if first.hash == hash { Ok(first) } else { read() }
    }

    fn read_range(
        &self,
        name: &str,
        object: &str,
        bytes: Range<u64>,
        hash: &[u8; 32],
    ) -> Result<Vec<u8>, StoreError> {
        // A section is cached under the hash of its own bytes, which several chunks may contain.
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
        let store = self.store.clone();
        let at = self.key(&key);
        self.run("read", &key, move || {
            let store = store.clone();
            let at = at.clone();
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

    fn set_record_aside(&self, name: &str, number: u64) -> Result<PathBuf, StoreError> {
        let path = self.record_path(name, number);
        let reason =
            "an object store has no rename; move the object away with the store's own tools";
        Err(StoreError::io("set aside", &path)(std::io::Error::new(ErrorKind::Unsupported, reason)))
    }

    fn remove_leftovers(&self, _: &str, _: &str, _: i64) -> Result<(), StoreError> {
        // A put is all or nothing, and there are no locks.
        Ok(())
    }

    fn hold(&self, _: &str, _: &str) -> Result<Option<Lock>, StoreError> {
        Ok(None)
    }

    fn is_held(&self, _: &str, _: &str) -> Result<bool, StoreError> {
        Ok(false)
    }

    fn check_present(&self, name: &str, hash: &str, bytes: u64) -> Result<(), StoreError> {
        let key = object_key(name, hash);
        let found = self.head(&key)?.size;
        if found == bytes {
            return Ok(());
        }
        Err(self.damaged(&key, format!("it has {found} bytes, not {bytes}")))
    }

    fn begin_staging(&self, name: &str, _commit: &str) -> Result<Box<dyn Staging>, StoreError> {
        Ok(Box::new(RemoteStaging::new(self.clone(), name)))
    }

    fn unfinished_commits(&self) -> Result<Vec<String>, StoreError> {
        // Commits upload to the final keys, so that there is no staging that could be left.
        Ok(Vec::new())
    }

    fn remove_abandoned(
        &self,
        _name: &str,
        _named: &dyn Fn() -> Option<BTreeSet<String>>,
    ) -> Result<(), StoreError> {
        // Only garbage collection finds what a killed commit has uploaded.
        Ok(())
    }

    fn list_objects(&self, name: &str) -> Result<ObjectListing, StoreError> {
        let key = format!("{name}/{OBJECTS}");
        let store = self.store.clone();
        let at = self.key(&key);
        let found: Vec<ObjectMeta> = self.run("list", &key, move || {
            let store = store.clone();
            let at = at.clone();
            async move { store.list(Some(&at)).try_collect().await }
        })?;
        let listed = found.into_iter().filter_map(|found| {
            let hash = found.location.filename().filter(|name| is_hash(name))?.to_owned();
            let written_us = found.last_modified.timestamp_micros();
            Some(ListedObject { hash, bytes: found.size, is_file: true, written_us })
        });
        let mut objects: Vec<ListedObject> = listed.collect();
        // The order of a listing depends on the store.
        objects.sort_unstable_by(|a, b| a.hash.cmp(&b.hash));
        Ok(ObjectListing { objects, unlisted: Vec::new() })
    }

    fn remove_objects(
        &self,
        name: &str,
        which: &mut dyn FnMut() -> Result<Vec<String>, StoreError>,
    ) -> Result<(), StoreError> {
        // An object that is missing is no error, so that a run that was stopped can be repeated.
        which()?.iter().try_for_each(|hash| self.delete(&object_key(name, hash)))
    }

    fn remove_twin(
        &self,
        name: &str,
        mark: &mut dyn FnMut() -> Result<(), StoreError>,
    ) -> Result<(), StoreError> {
        mark()?;
        for object in self.list_objects(name)?.whole()? {
            self.delete(&object_key(name, &object.hash))?;
        }
        for folder in [LEASES, COLLECTION] {
            for file in self.list_side_files(name, folder)? {
                self.delete(&format!("{name}/{folder}/{file}"))?;
            }
        }
        // The oldest last: as long as there is a record, the removal can be repeated.
        for number in self.version_numbers(name)?.into_iter().rev() {
            self.delete(&record_key(name, number))?;
        }
        Ok(())
    }

    fn list_side_files(&self, name: &str, folder: &str) -> Result<Vec<String>, StoreError> {
        let key = format!("{name}/{folder}");
        let store = self.store.clone();
        let at = self.key(&key);
        let listed = self.run("list", &key, move || {
            let store = store.clone();
            let at = at.clone();
            async move { store.list_with_delimiter(Some(&at)).await }
        })?;
        let names = listed.objects.iter().filter_map(|found| found.location.filename());
        let mut names: Vec<String> = names.map(str::to_owned).collect();
        names.sort_unstable();
        Ok(names)
    }

    fn read_side_file(&self, name: &str, file: &str) -> Result<Option<Vec<u8>>, StoreError> {
        match self.get(&format!("{name}/{file}"), limits::SIDE_FILE_BYTES) {
            Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => Ok(None),
            read => read.map(Some),
        }
    }

    fn write_side_file(&self, name: &str, file: &str, bytes: &[u8]) -> Result<(), StoreError> {
        let key = format!("{name}/{file}");
        check_side_file(self.root.join(&key), bytes)?;
        let store = self.store.clone();
        let at = self.key(&key);
        let payload = PutPayload::from(bytes.to_vec());
        self.run("write", &key, move || {
            let store = store.clone();
            let at = at.clone();
            let payload = payload.clone();
            async move { store.put(&at, payload).await.map(|_| ()) }
        })
    }

    fn remove_side_file(&self, name: &str, file: &str) -> Result<(), StoreError> {
        self.delete(&format!("{name}/{file}"))
    }
}
