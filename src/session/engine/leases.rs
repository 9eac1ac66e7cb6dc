//! Leases of open versions: they prevent garbage collection, in any process, from deleting data in
//! use.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;

use wildcity_twin::residency::Resident;
use wildcity_twin::store::{Catalog, Lease, StoreError};

use crate::limits;

/// Leases of the versions that are open, by twin and number.
#[derive(Debug)]
pub(crate) struct Leases {
    catalog: Catalog,
    /// The holder's name in the log of the store.
    holder: String,
    leased: Mutex<BTreeMap<(String, u64), LeasedVersion>>,
}

/// A lease, and the open version that needs it.
#[derive(Debug)]
struct LeasedVersion {
    resident: Weak<Resident>,
    lease: Lease,
}

impl Leases {
    pub(crate) fn new(catalog: Catalog) -> Self {
        let holder = format!("wildcity serve, process {}", std::process::id());
        Self { catalog, holder, leased: Mutex::default() }
    }

    /// Takes a lease of a version unless there is one already. Blocks.
    ///
    /// A failure is only logged: on a store without write access, the process that collects garbage
    /// must get the versions in use by other means.
    pub(crate) fn take(&self, resident: &Arc<Resident>) {
        let version = &resident.version;
        let name = &version.manifest.twin;
        let number = version.number;
        // Locked while the store writes: two sessions that open one version would otherwise take
        // two leases.
        let mut leased = self.leased.lock();
        if let Some(known) = leased.get_mut(&(name.clone(), number)) {
            // It was closed and opened again; the lease goes on for what is open now.
            known.resident = Arc::downgrade(resident);
            return;
        }
        match self.catalog.lease(name, number, &self.holder, limits::LEASE) {
            Ok(lease) => {
                let resident = Arc::downgrade(resident);
                leased.insert((name.clone(), number), LeasedVersion { resident, lease });
            }
            Err(error) => tracing::warn!(twin = name, version = number, "no lease: {error}"),
        }
    }

    /// Renews the leases of versions that are still open and ends the others. Blocks.
    ///
    /// # Errors
    /// The first lease that cannot be renewed; the others are renewed all the same.
    pub(crate) fn renew(&self) -> Result<(), StoreError> {
        let mut leased = self.leased.lock();
        // A lease ends when it is dropped.
        leased.retain(|_, known| known.resident.strong_count() > 0);
        // All of them before the first error: `collect` into a `Result` at once would stop there.
        let renewed: Vec<_> = leased.values_mut().map(|known| known.lease.renew()).collect();
        renewed.into_iter().collect()
    }
}
