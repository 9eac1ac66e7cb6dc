//! The list of twins that a client gets before it opens one.

use std::collections::BTreeMap;
use std::sync::Arc;

use parking_lot::Mutex;

use wildcity_scene::Trajectory;
use wildcity_twin::store::{Catalog, StoreError, TwinList, Version};

/// The latest version of a twin, summarized.
#[derive(Clone, Debug, PartialEq)]
pub struct TwinSummary {
    /// Name of the twin.
    pub name: String,
    /// Number of the version.
    pub number: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub hash: String,
    pub gaussians: u64,
    pub sh_degree: u8,
    pub trajectories: Vec<TrajectorySummary>,
}

/// The twins of a catalog, summarized.
#[derive(Clone, Debug, Default)]
pub struct TwinSummaries {
    /// Twins that can be opened, in order of name.
    pub twins: Vec<Arc<TwinSummary>>,
    /// Twins whose latest version is damaged, in order of name.
    pub damaged: Vec<DamagedSummary>,
}

/// A twin that cannot be opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DamagedSummary {
    /// Name of the twin.
    pub name: String,
    pub reason: String,
}

/// A recorded trajectory, summarized.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectorySummary {
    /// Name of the trajectory.
    pub name: String,
    pub length_m: f64,
    pub keyframes: u64,
}

/// Summaries of the twins of a catalog. A manifest may have megabytes and never changes, so each is
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

    /// The latest version of every twin, or the version that `pinned` returns for a twin; and the
    /// damaged twins, which do not hide the others.
    ///
    /// # Errors
    /// The directory of twins cannot be read.
    pub(crate) fn read(
        &self,
        pinned: &dyn Fn(&str) -> Option<u64>,
    ) -> Result<TwinSummaries, StoreError> {
        let TwinList { twins: listed, damaged } = self.catalog.twins()?;
        let mut damaged: Vec<DamagedSummary> = damaged
            .into_iter()
            .map(|twin| DamagedSummary::from_error(twin.name, &twin.error))
            .collect();
        // The lock is held while manifests are read, so that simultaneous requests read each one
        // once.
        let mut known = self.known.lock();
        // Only twins that still exist are carried over, so that `known` does not grow.
        let mut fresh = BTreeMap::new();
        for listing in listed {
            // Looked up after the log is read: a push pins the latest version before it commits.
            let pinned = pinned(&listing.name);
            let number = pinned.unwrap_or(listing.number);
            // `listing.hash` is that of the latest version, so a pinned version is compared only by
            // number: numbers only rise while a version is pinned.
            let is_current = |summary: &Arc<TwinSummary>| {
                summary.number == number && (pinned.is_some() || summary.hash == listing.hash)
            };
            let summary = match known.remove(&listing.name).filter(is_current) {
                Some(summary) => summary,
                None => match self.catalog.version(&listing.name, Some(number)) {
                    Ok(version) => Arc::new(TwinSummary::from_version(version)),
                    Err(error) => {
                        damaged.push(DamagedSummary::from_error(listing.name, &error));
                        continue;
                    }
                },
            };
            fresh.insert(listing.name, summary);
        }
        *known = fresh;
        damaged.sort_by(|a, b| a.name.cmp(&b.name));
        for DamagedSummary { name, reason } in &damaged {
            tracing::warn!(twin = name, "damaged: {reason}");
        }
        Ok(TwinSummaries { twins: known.values().cloned().collect(), damaged })
    }

    /// Checks that the directory of twins can be read.
    ///
    /// # Errors
    /// It cannot.
    pub(crate) fn check(&self) -> Result<(), StoreError> {
        self.catalog.twins().map(|_| ())
    }
}

impl DamagedSummary {
    fn from_error(name: String, error: &StoreError) -> Self {
        Self { name, reason: error.to_string() }
    }
}

impl TwinSummary {
    fn from_version(version: Version) -> Self {
        let Version { number, hash, manifest, .. } = version;
        Self {
            gaussians: manifest.gaussians(),
            sh_degree: manifest.sh_degree,
            trajectories: manifest
                .trajectories
                .iter()
                .map(TrajectorySummary::from_trajectory)
                .collect(),
            name: manifest.twin,
            number,
            hash,
        }
    }
}

impl TrajectorySummary {
    /// The summary of a trajectory.
    pub fn from_trajectory(trajectory: &Trajectory) -> Self {
        Self {
            name: trajectory.name.clone(),
            length_m: trajectory.length_m(),
            keyframes: trajectory.keyframes.len() as u64,
        }
    }
}
