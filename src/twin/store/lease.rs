//! Leases: who uses a version says so, and garbage collection leaves it alone until then.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::log::now_us;
use super::{Catalog, StoreError};

/// A version in use. It ends when it is dropped, or when it was not renewed for its duration.
#[derive(Debug)]
pub struct Lease {
    catalog: Catalog,
    name: String,
    duration: Duration,
    record: LeaseRecord,
}

/// What a lease says.
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
    /// Says that a version of a twin is in use by `holder`, for people to read, until the duration has
    /// passed since this call or the last [`Lease::renew`].
    ///
    /// # Errors
    /// As [`Catalog::version`] for what is not there; the lease cannot be written.
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
        let (catalog, name) = (self.clone(), name.to_owned());
        catalog.check_not_collected(&name, version)?;
        let mut lease = Lease { catalog, name, duration, record };
        lease.renew()?;
        Ok(lease)
    }

    /// Whether a version's objects are not known to be removed.
    pub(super) fn check_not_collected(&self, name: &str, number: u64) -> Result<(), StoreError> {
        if self.collected(name)?.contains(&number) {
            return Err(StoreError::GarbageCollected { name: name.to_owned(), number });
        }
        Ok(())
    }

    /// All leases of a twin, live or not.
    pub(super) fn leases(&self, name: &str) -> Result<Vec<LeaseRecord>, StoreError> {
        let mut leases = Vec::new();
        for note in self.objects.list_side_files(name, FOLDER)? {
            let read = self.objects.read_side_file(name, &format!("{FOLDER}/{note}"))?;
            // It ended meanwhile; or it is damaged, and holds nothing that anybody knows of.
            let record =
                read.and_then(|record| serde_json::from_slice::<LeaseRecord>(&record).ok());
            leases.extend(record.filter(|record| record.id == note));
        }
        Ok(leases)
    }
}

impl Lease {
    /// Begins the duration again.
    ///
    /// # Errors
    /// It cannot be written; it holds as long as it held before. [`StoreError::GarbageCollected`] if it had
    /// ended, and the version's objects were removed.
    pub fn renew(&mut self) -> Result<(), StoreError> {
        let for_us = i64::try_from(self.duration.as_micros()).unwrap_or(i64::MAX);
        self.record.until_us = now_us().saturating_add(for_us);
        let record = self.catalog.encode(&self.record)?;
        self.catalog.objects.write_side_file(&self.name, &self.record.note(), &record)?;
        // Garbage collection says what it removes and looks for leases then; here it is the other way
        // around, so that one of the two sees the other.
        self.catalog.check_not_collected(&self.name, self.record.version)
    }
}

impl Drop for Lease {
    /// What cannot be removed ends by itself.
    fn drop(&mut self) {
        let _ = self.record.remove(&self.catalog, &self.name);
    }
}

impl LeaseRecord {
    pub(super) fn is_live(&self, now_us: i64) -> bool {
        self.until_us > now_us
    }

    pub(super) fn remove(&self, catalog: &Catalog, name: &str) -> Result<(), StoreError> {
        catalog.objects.remove_side_file(name, &self.note())
    }

    fn note(&self) -> String {
        format!("{FOLDER}/{}", self.id)
    }
}
