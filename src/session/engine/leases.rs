//! What is open is in use: the store is told so, and garbage collection leaves it alone, wherever it
//! runs.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use crate::limits;
use wildcity_twin::residency::Resident;
use wildcity_twin::store::{Catalog, Lease, StoreError};

/// Leases of the versions that are open, by twin and number.
#[derive(Debug)]
pub(crate) struct Leases {
    catalog: Catalog,
    /// Who reads the logs of a store finds this there.
    holder: String,
    held: Mutex<BTreeMap<(String, u64), LeasedVersion>>,
}

/// A lease, and for whom.
#[derive(Debug)]
struct LeasedVersion {
    resident: Weak<Resident>,
    lease: Lease,
}

impl Leases {
    pub(crate) fn new(catalog: Catalog) -> Self {
        let holder = format!("wildcity serve, process {}", std::process::id());
        Self { catalog, holder, held: Mutex::default() }
    }

    /// Takes a lease of a version, unless there is one. Blocks. Where nothing may be written, it is
    /// logged: whoever collects garbage there must know what is in use.
    pub(crate) fn hold(&self, resident: &Arc<Resident>) {
        let version = &resident.version;
        let (name, number) = (&version.manifest.twin, version.number);
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(held) = held.get_mut(&(name.clone(), number)) {
            held.resident = Arc::downgrade(resident);
            return;
        }
        match self.catalog.lease(name, number, &self.holder, limits::LEASE) {
            Ok(lease) => {
                let resident = Arc::downgrade(resident);
                held.insert((name.clone(), number), LeasedVersion { resident, lease });
            }
            Err(error) => tracing::warn!(twin = name, version = number, "no lease: {error}"),
        }
    }

    /// Renews the leases of what is still open and ends the others. Blocks.
    ///
    /// # Errors
    /// The first that cannot be renewed; the others are.
    pub(crate) fn renew(&self) -> Result<(), StoreError> {
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        held.retain(|_, held| held.resident.strong_count() > 0);
        let renewed: Vec<_> = held.values_mut().map(|held| held.lease.renew()).collect();
        renewed.into_iter().collect()
    }
}
