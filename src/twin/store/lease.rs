//! Leases: a process that uses a version records it with an expiry time, and garbage collection
//! keeps the version until then.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::log::now_us;
use super::{Catalog, StoreError};

/// A version in use. The lease ends when it is dropped, or when it was not renewed for its
/// duration.
#[derive(Debug)]
pub struct Lease {
    catalog: Catalog,
    name: String,
    duration: Duration,
    record: LeaseRecord,
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

const FOLDER: &str = "leases";

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
        let mut lease = Lease { catalog: self.clone(), name: name.to_owned(), duration, record };
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
        for id in self.objects.list_side_files(name, FOLDER)? {
            let read = self.objects.read_side_file(name, &format!("{FOLDER}/{id}"))?;
            // A missing file is a lease that ended meanwhile. A damaged one cannot say which
            // version it holds.
            let record =
                read.and_then(|record| serde_json::from_slice::<LeaseRecord>(&record).ok());
            leases.extend(record.filter(|record| record.id == id));
        }
        Ok(leases)
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
        self.record.until_us = now_us().saturating_add(for_us);
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
    pub(super) fn is_live(&self, now_us: i64) -> bool {
        self.until_us > now_us
    }

    pub(super) fn remove(&self, catalog: &Catalog, name: &str) -> Result<(), StoreError> {
        catalog.objects.remove_side_file(name, &self.file())
    }

    fn file(&self) -> String {
        format!("{FOLDER}/{}", self.id)
    }
}
