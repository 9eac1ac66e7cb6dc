//! What a client is told of each twin before it opens one.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use wildcity_scene::Trajectory;
use wildcity_twin::store::{Catalog, StoreError, Version};

/// The latest version of a twin, in a few numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct TwinSummary {
    /// Name.
    pub name: String,
    /// The version.
    pub number: u64,
    /// BLAKE3 of its manifest, in hex.
    pub hash: String,
    /// Gaussians in it.
    pub gaussians: u64,
    /// Spherical-harmonic degree.
    pub sh_degree: u8,
    /// Its recorded trajectories.
    pub trajectories: Vec<TrajectorySummary>,
}

/// A recorded trajectory, in a few numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectorySummary {
    /// Name.
    pub name: String,
    /// Length, in metres.
    pub length_m: f64,
    /// Keyframes.
    pub keyframes: u64,
}

/// Summaries of the twins of a catalog. A manifest can have megabytes and never changes, so each is
/// read once.
#[derive(Debug)]
pub(crate) struct SummaryCache {
    catalog: Catalog,
    known: Mutex<BTreeMap<String, Arc<TwinSummary>>>,
}

impl SummaryCache {
    pub(crate) fn new(catalog: Catalog) -> Self {
        Self { catalog, known: Mutex::default() }
    }

    /// The latest version of every twin, in order of name, or the one that is `held` in its place. A
    /// damaged one is logged and left out, so that it does not hide the others.
    ///
    /// # Errors
    /// The directory of twins cannot be read.
    pub(crate) fn read(
        &self,
        held: &dyn Fn(&str) -> Option<u64>,
    ) -> Result<Vec<Arc<TwinSummary>>, StoreError> {
        let listed = self.catalog.twins()?;
        // Held while reading, so that clients that come together read each manifest once.
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let mut fresh = BTreeMap::new();
        for listing in listed {
            // Asked for after the log is read: a push holds the latest before it commits.
            let held = held(&listing.name);
            let number = held.unwrap_or(listing.number);
            // The hash of one that is held is not listed: numbers go up while it is.
            let is_this = |summary: &Arc<TwinSummary>| {
                summary.number == number && (held.is_some() || summary.hash == listing.hash)
            };
            let summary = match known.remove(&listing.name).filter(is_this) {
                Some(summary) => summary,
                None => match self.catalog.version(&listing.name, Some(number)) {
                    Ok(version) => Arc::new(TwinSummary::of(version)),
                    Err(error) => {
                        tracing::warn!(twin = listing.name, "not listed: {error}");
                        continue;
                    }
                },
            };
            fresh.insert(listing.name, summary);
        }
        *known = fresh;
        Ok(known.values().cloned().collect())
    }

    /// Whether the directory of twins can be read.
    ///
    /// # Errors
    /// It cannot.
    pub(crate) fn check(&self) -> Result<(), StoreError> {
        self.catalog.twins().map(|_| ())
    }
}

impl TwinSummary {
    fn of(version: Version) -> Self {
        let Version { number, hash, manifest, .. } = version;
        Self {
            gaussians: manifest.gaussians(),
            sh_degree: manifest.sh_degree,
            trajectories: manifest.trajectories.iter().map(TrajectorySummary::of).collect(),
            name: manifest.twin,
            number,
            hash,
        }
    }
}

impl TrajectorySummary {
    /// Of a trajectory.
    pub fn of(log: &Trajectory) -> Self {
        let (length_m, keyframes) = (log.length_m(), log.keyframes.len() as u64);
        Self { name: log.name.clone(), length_m, keyframes }
    }
}
