//! Storage of a simulated twin.

use std::fmt::Debug;
use std::path::Path;
use std::sync::Arc;

use wildcity_twin::store::{Catalog, StoreError};

use crate::bucket::SimBucket;
use crate::disk::{Fault, Plant, ROOT, SimClock, SimDisk};
use crate::random::Random;
use crate::reads::BadReads;

/// The media that a history can run on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A directory on a disk.
    Disk,
    /// A prefix of an object store.
    Bucket,
}

/// A medium as one process sees it.
pub(crate) trait Medium: Debug {
    /// Starts a process.
    fn open(&self, clock: &Arc<SimClock>) -> Result<Catalog, StoreError>;

    /// Waits until the process has made all requests that it began. Returns at once on a disk.
    fn settle(&self, catalog: &Catalog);

    /// Sets the fault that happens after a number of writes.
    fn fail_after(&self, writes: u64, fault: Fault);

    /// Lets some reads fail.
    fn fail_reads(&self, reads: BadReads);

    /// Takes back reads that have not failed.
    fn stop_failing_reads(&self);

    /// Whether reads failed since this was last called, so often that an operation may fail.
    fn take_failed_reads(&self) -> bool;

    /// Takes back faults that have not happened.
    fn stop_failing(&self);

    /// Whether the process was stopped.
    fn is_stopped(&self) -> bool;

    /// Stops the process between two writes.
    fn stop(&self, fault: Fault);

    /// The medium for the next process, after this one was stopped.
    fn restarted(&self, random: &mut Random) -> Box<dyn Medium>;

    /// Lets the writes of stopped processes that are on their way have their effect.
    fn apply_delayed_puts(&self);

    /// The files of commits that are neither published nor removed.
    fn commits_left(&self) -> Vec<String>;

    /// The files of leases.
    fn leases_left(&self) -> Vec<String>;

    /// Whether a lock keeps the version of a session and the objects of a commit in preparation. An
    /// object store has no locks: a session renews its lease in time, and garbage is not collected
    /// while commits are in preparation.
    fn has_locks(&self) -> bool;
}

impl Kind {
    /// A medium without twins.
    pub(crate) fn empty(self, clock: &Arc<SimClock>, plant: Option<Plant>) -> Box<dyn Medium> {
        match self {
            Self::Disk => Box::new(SimDisk::new(clock.clone(), plant)),
            Self::Bucket => Box::new(SimBucket::new(clock.clone(), plant)),
        }
    }
}

impl Medium for SimDisk {
    fn open(&self, clock: &Arc<SimClock>) -> Result<Catalog, StoreError> {
        Catalog::on(Path::new(ROOT), Arc::new(self.clone()), clock.clone())
    }

    fn settle(&self, _: &Catalog) {}

    fn fail_after(&self, writes: u64, fault: Fault) {
        self.set_fault(Some((writes, fault)));
    }

    fn fail_reads(&self, reads: BadReads) {
        self.set_bad_reads(Some(reads));
    }

    fn stop_failing_reads(&self) {
        self.set_bad_reads(None);
    }

    fn take_failed_reads(&self) -> bool {
        Self::take_failed_reads(self) > 0
    }

    fn stop_failing(&self) {
        self.set_fault(None);
        self.set_bad_reads(None);
    }

    fn is_stopped(&self) -> bool {
        Self::is_stopped(self)
    }

    fn stop(&self, fault: Fault) {
        Self::stop(self, fault);
    }

    fn restarted(&self, random: &mut Random) -> Box<dyn Medium> {
        Box::new(Self::restarted(self, random))
    }

    fn apply_delayed_puts(&self) {}

    fn commits_left(&self) -> Vec<String> {
        let staging = Path::new(ROOT).join(".staging");
        let files = self.files_below(".staging").into_iter();
        // Files of the folder itself are locks.
        let left = files.filter(|(path, _)| path.parent() != Some(&staging));
        left.map(|(path, _)| path.display().to_string()).collect()
    }

    fn leases_left(&self) -> Vec<String> {
        let files = self.files_below("city/leases").into_iter();
        files.map(|(path, _)| path.display().to_string()).collect()
    }

    fn has_locks(&self) -> bool {
        true
    }
}
