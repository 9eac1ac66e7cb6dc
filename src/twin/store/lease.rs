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
    terms: Terms,
}

/// What a lease says.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Terms {
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
        let terms = Terms { version, holder: holder.to_owned(), id, until_us: 0 };
        let (catalog, name) = (self.clone(), name.to_owned());
        catalog.check_not_collected(&name, version)?;
        let mut lease = Lease { catalog, name, duration, terms };
        lease.renew()?;
        Ok(lease)
    }

    /// Whether a version's objects are not known to be removed.
    pub(super) fn check_not_collected(&self, name: &str, number: u64) -> Result<(), StoreError> {
        if self.collected(name)?.contains(&number) {
            return Err(StoreError::Collected { name: name.to_owned(), number });
        }
        Ok(())
    }

    /// All leases of a twin, live or not.
    pub(super) fn leases(&self, name: &str) -> Result<Vec<Terms>, StoreError> {
        let mut leases = Vec::new();
        for note in self.objects.notes(name, FOLDER)? {
            let read = self.objects.note(name, &format!("{FOLDER}/{note}"))?;
            // It ended meanwhile; or it is damaged, and holds nothing that anybody knows of.
            let terms = read.and_then(|terms| serde_json::from_slice::<Terms>(&terms).ok());
            leases.extend(terms.filter(|terms| terms.id == note));
        }
        Ok(leases)
    }
}

impl Lease {
    /// Begins the duration again.
    ///
    /// # Errors
    /// It cannot be written; it holds as long as it held before. [`StoreError::Collected`] if it had
    /// ended, and the version's objects were removed.
    pub fn renew(&mut self) -> Result<(), StoreError> {
        let for_us = i64::try_from(self.duration.as_micros()).unwrap_or(i64::MAX);
        self.terms.until_us = now_us().saturating_add(for_us);
        let terms = self.catalog.encode(&self.terms)?;
        self.catalog.objects.put_note(&self.name, &self.terms.note(), &terms)?;
        // Garbage collection says what it removes and looks for leases then; here it is the other way
        // around, so that one of the two sees the other.
        self.catalog.check_not_collected(&self.name, self.terms.version)
    }
}

impl Drop for Lease {
    /// What cannot be removed ends by itself.
    fn drop(&mut self) {
        let _ = self.terms.remove(&self.catalog, &self.name);
    }
}

impl Terms {
    pub(super) fn is_live(&self, now_us: i64) -> bool {
        self.until_us > now_us
    }

    pub(super) fn remove(&self, catalog: &Catalog, name: &str) -> Result<(), StoreError> {
        catalog.objects.remove_note(name, &self.note())
    }

    fn note(&self) -> String {
        format!("{FOLDER}/{}", self.id)
    }
}
