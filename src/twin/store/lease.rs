//! Leases: a process that uses a version records it with an expiry time, and garbage collection
//! keeps the version until then.
//!
//! In a directory, the process also keeps a file locked. Then the version is kept as long as the
//! process lives, even if the clock jumps beyond the expiry time. An object store has no such lock.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::disk::Lock;
use super::layout::{LEASES, LOCK_ENDING};
use super::{Catalog, StoreError};

/// A version in use. The lease ends when it is dropped; or when it was not renewed for its
/// duration, except in a directory, as long as its process lives.
#[derive(Debug)]
pub struct Lease {
    catalog: Catalog,
    name: String,
    duration: Duration,
    record: LeaseRecord,
    /// Where the backend has locks.
    _lock: Option<Lock>,
}

/// A lease as stored, in JSON.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LeaseRecord {
    pub(super) version: u64,
    holder: String,
    id: String,
    until_us: i64,
}

impl Catalog {
    /// Records that a version of a twin is in use by `holder` (a text for people), until the
    /// duration has passed since this call or the last [`Lease::renew`].
    ///
    /// # Errors
    /// As [`Catalog::version`] for a version that does not exist; the lease cannot be written.
    pub fn lease(
        &self,
        name: &str,
        version: u64,
        holder: &str,
        duration: Duration,
    ) -> Result<Lease, StoreError> {
        let numbers = self.numbers(name)?;
        if !numbers.contains(&version) {
            let latest = numbers[numbers.len() - 1];
            return Err(StoreError::NoVersion { name: name.to_owned(), number: version, latest });
        }
        let id = uuid::Uuid::now_v7().as_simple().to_string();
        let record = LeaseRecord { version, holder: holder.to_owned(), id, until_us: 0 };
        self.check_not_collected(name, version)?;
        // Locked before the lease is written: from its first moment on it counts as live.
        let lock = self.objects.hold(name, &record.lock_file())?;
        let catalog = self.clone();
        let mut lease = Lease { catalog, name: name.to_owned(), duration, record, _lock: lock };
        lease.renew()?;
        Ok(lease)
    }

    /// Checks that garbage collection has not removed a version's objects.
    pub(super) fn check_not_collected(&self, name: &str, number: u64) -> Result<(), StoreError> {
        if self.collected(name)?.contains(&number) {
            return Err(StoreError::GarbageCollected { name: name.to_owned(), number });
        }
        Ok(())
    }

    /// All leases of a twin, including expired ones.
    pub(super) fn leases(&self, name: &str) -> Result<Vec<LeaseRecord>, StoreError> {
        let mut leases = Vec::new();
        let files = self.objects.list_side_files(name, LEASES)?;
        for id in files.into_iter().filter(|file| !file.ends_with(LOCK_ENDING)) {
            let read = self.objects.read_side_file(name, &format!("{LEASES}/{id}"))?;
            // A missing file is a lease that ended meanwhile. The version of a
            // damaged one is unknown.
            let record =
                read.and_then(|record| serde_json::from_slice::<LeaseRecord>(&record).ok());
            // A file under another name is a copy. The lock of its id says nothing about it.
            leases.extend(record.filter(|record| record.id == id));
        }
        Ok(leases)
    }

    /// The leases of versions that are in use.
    pub(super) fn live_leases(
        &self,
        name: &str,
        now_us: i64,
    ) -> Result<Vec<LeaseRecord>, StoreError> {
        let mut live = Vec::new();
        for lease in self.leases(name)? {
            if self.is_live(name, &lease, now_us)? {
                live.push(lease);
            }
        }
        Ok(live)
    }

    /// Whether a lease has not expired, or its process lives.
    pub(super) fn is_live(
        &self,
        name: &str,
        lease: &LeaseRecord,
        now_us: i64,
    ) -> Result<bool, StoreError> {
        // The lock is asked only after the expiry time, because that opens a file.
        Ok(lease.until_us > now_us || self.objects.is_held(name, &lease.lock_file())?)
    }
}

impl Lease {
    /// Restarts the duration.
    ///
    /// # Errors
    /// It cannot be written; then it keeps its previous expiry time.
    /// [`StoreError::GarbageCollected`] if it had ended, and the version's objects were removed.
    pub fn renew(&mut self) -> Result<(), StoreError> {
        let for_us = i64::try_from(self.duration.as_micros()).unwrap_or(i64::MAX);
        self.record.until_us = self.catalog.clock.now_us().saturating_add(for_us);
        let record = self.catalog.encode(&self.record)?;
        self.catalog.objects.write_side_file(&self.name, &self.record.file(), &record)?;
        // Garbage collection first records what it removes, and then reads the leases. Here it is
        // the other way around, so that at least one of the two sees the other.
        self.catalog.check_not_collected(&self.name, self.record.version)
    }
}

impl Drop for Lease {
    /// A lease that cannot be removed expires by itself.
    fn drop(&mut self) {
        let _ = self.record.remove(&self.catalog, &self.name);
    }
}

impl LeaseRecord {
    pub(super) fn remove(&self, catalog: &Catalog, name: &str) -> Result<(), StoreError> {
        // The lease goes first: a lock without a lease is a leftover, and keeps no version.
        catalog.objects.remove_side_file(name, &self.file())?;
        catalog.objects.remove_side_file(name, &self.lock_file())
    }

    fn lock_file(&self) -> String {
        format!("{LEASES}/{}{LOCK_ENDING}", self.id)
    }

    fn file(&self) -> String {
        format!("{LEASES}/{}", self.id)
    }
}
