//! One simulated machine with one twin, and the promises to its users.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, RecordFormat};
use wildcity_twin::store::{
    Catalog, Commit, CommitKind, Lease, NewVersion, Retention, StorageOptions, StoreError, Version,
    VersionChange,
};

use crate::disk::{Fault, Plant, SimClock};
use crate::history::{Operation, Step};
use crate::medium::{Kind, Medium};
use crate::random::Random;

const TWIN: &str = "city";

/// How long a lease is valid without renewal.
const LEASE: Duration = Duration::from_secs(900);

/// The content of a version: the number of Gaussians in each cell.
type Cells = BTreeMap<[i32; 2], u64>;

/// A session that has a version open.
struct Session {
    number: u64,
    cells: Cells,
    lease: Lease,
}

/// A push that is not published yet.
struct Prepared {
    commit: Commit,
    base: u64,
    cells: Cells,
    /// Whether an upload may have failed, which an object store reports when the push is published.
    may_fail: bool,
}

/// The machine, and the promises.
pub(crate) struct World {
    clock: Arc<SimClock>,
    medium: Box<dyn Medium>,
    /// That of the process which carries out the operation.
    catalog: Catalog,
    /// That of the other process, which knows nothing of the first.
    other: Catalog,
    process: u8,
    sessions: Vec<Session>,
    prepared: Option<Prepared>,
    /// Versions that were acknowledged to a client: they must stay, until garbage collection may
    /// remove them.
    acknowledged: BTreeMap<u64, Cells>,
    /// Possible contents of versions of interrupted pushes, which were not acknowledged.
    possible: BTreeMap<u64, Vec<Cells>>,
    /// Versions that garbage collection may have removed.
    collectable: BTreeSet<u64>,
    /// How often the process was stopped.
    restarts: u64,
}

type Promise = Result<(), String>;

/// Why an operation did not end well.
enum Failed {
    Refused(StoreError),
    /// A promise is broken.
    Broken(String),
}

impl From<StoreError> for Failed {
    fn from(error: StoreError) -> Self {
        Self::Refused(error)
    }
}

fn storage() -> StorageOptions {
    StorageOptions { record: RecordFormat::F32, levels: false }
}

fn provenance() -> Provenance {
    Provenance::new("simulation".to_owned())
}

/// The cells of a bit mask, of a content.
fn masked_cells(mask: u8, content: u64) -> Cells {
    (0..3).filter(|cell| mask & (1 << cell) != 0).map(|cell| ([cell, 0], content)).collect()
}

/// As many Gaussians in each cell as it is to have.
fn gaussians(cells: &Cells) -> Gaussians {
    let mut gaussians = Gaussians::default();
    for (cell, count) in cells {
        for index in 0..*count {
            gaussians.means_m.push([64.0 * f64::from(cell[0]), index as f64, *count as f64]);
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([-1.0; 3]);
            gaussians.logit_opacities.push(0.0);
            gaussians.sh.extend([0.0; 3]);
        }
    }
    gaussians
}

fn version_cells(version: &Version) -> Cells {
    version.manifest.chunks.iter().map(|chunk| (chunk.cell, chunk.count)).collect()
}

fn merged(below: &Cells, above: &Cells) -> Cells {
    let mut cells = below.clone();
    cells.extend(above);
    cells
}

impl World {
    pub(crate) fn new(kind: Kind, plant: Option<Plant>) -> Result<Self, String> {
        let clock = Arc::new(SimClock::new());
        let medium = kind.empty(&clock, plant);
        let [catalog, other] = [open(&*medium, &clock)?, open(&*medium, &clock)?];
        Ok(Self {
            clock,
            medium,
            catalog,
            other,
            process: 0,
            sessions: Vec::new(),
            prepared: None,
            acknowledged: BTreeMap::new(),
            possible: BTreeMap::new(),
            collectable: BTreeSet::new(),
            restarts: 0,
        })
    }

    /// How often the process was stopped, and another one started.
    pub(crate) fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Carries out one step. If it stops the process, starts the next one and checks the promises.
    pub(crate) fn run(&mut self, step: &Step) -> Promise {
        if let Some((writes, fault)) = step.fault {
            self.medium.fail_after(writes, fault);
        }
        if let Some(reads) = step.bad_reads {
            self.medium.fail_reads(reads);
        }
        if step.process != self.process {
            std::mem::swap(&mut self.catalog, &mut self.other);
            self.process = step.process;
        }
        let is_full = matches!(step.fault, Some((_, Fault::Full)));
        let done = self.carry_out(step.operation);
        self.medium.settle(&self.catalog);
        let prepares = matches!(step.operation, Operation::Prepare { .. });
        if let Some(prepared) = self.prepared.as_mut().filter(|_| prepares) {
            prepared.may_fail = is_full && !self.medium.has_locks();
        }
        if self.medium.is_stopped() {
            return self.restart(step.seed);
        }
        let has_failed_reads = self.medium.take_failed_reads();
        self.medium.stop_failing();
        match done {
            Ok(()) => {}
            Err(Failed::Broken(promise)) => return Err(promise),
            // A full disk or store refuses the write; without a fault every operation succeeds.
            Err(Failed::Refused(_)) if is_full => {}
            // A read that fails is an error of the file, and never means that the file does not
            // exist.
            Err(Failed::Refused(StoreError::Io { .. } | StoreError::Damaged { .. }))
                if has_failed_reads => {}
            Err(Failed::Refused(error)) => return Err(format!("{error} without a fault")),
        }
        // After reads that failed the same reads succeed, and nothing is lost.
        if has_failed_reads { self.check() } else { self.check_sessions() }
    }

    fn carry_out(&mut self, operation: Operation) -> Result<(), Failed> {
        match operation {
            Operation::Read { back } => return self.read(back),
            Operation::Push { cells, content } => self.push(&masked_cells(cells, content)),
            Operation::Prepare { cells, content } => self.prepare(masked_cells(cells, content)),
            Operation::PublishPrepared => self.publish_prepared(),
            Operation::Rollback { back } => self.rollback(back),
            Operation::Open { back } => self.open_session(back),
            Operation::Renew => {
                self.sessions.iter_mut().try_for_each(|session| session.lease.renew())
            }
            Operation::Close => {
                if !self.sessions.is_empty() {
                    self.sessions.remove(0);
                }
                Ok(())
            }
            Operation::Collect { keep, grace_s } => {
                self.collect(Retention { versions: keep, grace: Duration::from_secs(grace_s) })
            }
            Operation::Jump { seconds } => self.jump(seconds),
            Operation::Stop(fault) => {
                self.medium.stop(fault);
                Ok(())
            }
        }?;
        Ok(())
    }

    /// The latest version, if there is one.
    fn latest(&self) -> Result<Option<Version>, StoreError> {
        match self.catalog.version(TWIN, None) {
            Ok(version) => Ok(Some(version)),
            Err(StoreError::NoTwin { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The number of the version that is `back` versions before the latest.
    fn number_before_latest(&self, back: u64) -> Result<Option<u64>, StoreError> {
        let latest = self.latest()?.map(|version| version.number);
        Ok(latest.map(|latest| latest.saturating_sub(back).max(1)))
    }

    /// Carries out a commit upon the version `before`, and notes the answer to its client.
    /// `content` maps the content of a version to that after the commit. The record of a stopped
    /// process may arrive meanwhile and be the version below.
    fn commit(
        &mut self,
        before: u64,
        base: &Cells,
        content: impl Fn(&Cells) -> Cells,
        commit: impl FnOnce(&mut Self) -> Result<Version, StoreError>,
    ) -> Result<(), StoreError> {
        // Until the answer arrives, the version may or may not exist.
        let below = self.possible.get(&(before + 1)).cloned().unwrap_or_default();
        let mut candidates = vec![(before + 1, content(base))];
        candidates.extend(below.iter().map(|cells| (before + 2, content(cells))));
        for (number, cells) in &candidates {
            self.possible.entry(*number).or_default().push(cells.clone());
        }
        let result = commit(self);
        let is_unknown = self.medium.is_stopped()
            || matches!(
                result,
                Err(StoreError::NotSynced { .. } | StoreError::OutcomeUnknown { .. })
            );
        if !is_unknown {
            for (number, _) in candidates {
                self.possible.entry(number).or_default().pop();
            }
        }
        // The following reads are not part of the commit.
        self.medium.stop_failing_reads();
        let version = match result {
            Err(StoreError::NotSynced { .. } | StoreError::OutcomeUnknown { .. }) => return Ok(()),
            Err(StoreError::Overlap { latest, .. }) if latest > before => return Ok(()),
            result => result?,
        };
        if !self.medium.is_stopped() {
            let found = version_cells(&version);
            // The version of a stopped process may have arrived, and have what the commit makes
            // already.
            let has_all = |cells: &Cells| *cells == found && content(cells) == found;
            let cells = match version.number {
                _ if below.iter().any(has_all) => found,
                number if number <= before + 1 => content(base),
                number => content(&version_cells(&self.catalog.version(TWIN, Some(number - 1))?)),
            };
            self.acknowledged.insert(version.number, cells);
        }
        Ok(())
    }

    fn push(&mut self, cells: &Cells) -> Result<(), StoreError> {
        let latest = self.latest()?;
        let before = latest.as_ref().map_or(0, |version| version.number);
        let base = latest.as_ref().map(version_cells).unwrap_or_default();
        let gaussians = gaussians(cells);
        // A new twin replaces what another process has made of that name meanwhile.
        let content =
            |below: &Cells| if before == 0 { cells.clone() } else { merged(below, cells) };
        self.commit(before, &base, content, |world| {
            if before == 0 {
                let new = NewVersion {
                    storage: storage(),
                    ..NewVersion::from_gaussians(TWIN, &gaussians, provenance())
                };
                return world.catalog.commit(new, &mut |_, _| {});
            }
            let mut commit = world.catalog.begin(TWIN, CommitKind::Push, storage())?;
            commit.put(&gaussians, None, &mut |_, _| {})?;
            commit.change(before, cells_alone())
        })
    }

    fn prepare(&mut self, cells: Cells) -> Result<(), StoreError> {
        let Some(latest) = self.latest()? else { return Ok(()) };
        let mut commit = self.catalog.begin(TWIN, CommitKind::Push, storage())?;
        commit.put(&gaussians(&cells), None, &mut |_, _| {})?;
        self.prepared = Some(Prepared { commit, base: latest.number, cells, may_fail: false });
        Ok(())
    }

    fn publish_prepared(&mut self) -> Result<(), StoreError> {
        let Some(prepared) = self.prepared.take() else { return Ok(()) };
        let Prepared { commit, base, cells, may_fail } = prepared;
        let Some(latest) = self.latest()? else { return Ok(()) };
        let published = self.commit(
            latest.number,
            &version_cells(&latest),
            |below| merged(below, &cells),
            |_| commit.change(base, cells_alone()),
        );
        match published {
            // Others changed the same cells, or the base is gone.
            Err(StoreError::Overlap { .. }) if latest.number != base => Ok(()),
            Err(StoreError::Io { .. }) if may_fail => Ok(()),
            Err(StoreError::GarbageCollected { .. }) if self.collectable.contains(&base) => Ok(()),
            published => published,
        }
    }

    fn rollback(&mut self, back: u64) -> Result<(), StoreError> {
        let Some(number) = self.number_before_latest(back)? else { return Ok(()) };
        let latest = self.catalog.latest(TWIN)?;
        let content = match self.catalog.version(TWIN, Some(number)) {
            Ok(version) => version_cells(&version),
            Err(StoreError::GarbageCollected { .. }) if self.collectable.contains(&number) => {
                return Ok(());
            }
            Err(error) => return Err(error),
        };
        let restored = |_: &Cells| content.clone();
        self.commit(latest, &content, restored, |world| world.catalog.rollback(TWIN, number))
    }

    fn open_session(&mut self, back: u64) -> Result<(), StoreError> {
        let Some(number) = self.number_before_latest(back)? else { return Ok(()) };
        let lease = match self.catalog.lease(TWIN, number, "simulation", LEASE) {
            Ok(lease) => lease,
            Err(StoreError::GarbageCollected { .. }) if self.collectable.contains(&number) => {
                return Ok(());
            }
            Err(error) => return Err(error),
        };
        let cells = version_cells(&self.catalog.version(TWIN, Some(number))?);
        self.sessions.push(Session { number, cells, lease });
        Ok(())
    }

    /// Reads a version without a lease.
    fn read(&self, back: u64) -> Result<(), Failed> {
        let Some(number) = self.number_before_latest(back)? else { return Ok(()) };
        let version = match self.catalog.version(TWIN, Some(number)) {
            Err(StoreError::GarbageCollected { .. }) if self.collectable.contains(&number) => {
                return Ok(());
            }
            version => version?,
        };
        self.read_all(&version)
    }

    /// Reads all sections of a version, and compares them with what was pushed.
    fn read_all(&self, version: &Version) -> Result<(), Failed> {
        for chunk in &version.manifest.chunks {
            // By their bits: a wrong bit may be worth a micrometre.
            let bits = |mean_m: [f64; 3]| mean_m.map(|m| (m + 0.0).to_bits());
            let mut read = BTreeSet::new();
            for section in &chunk.sections {
                let gaussians = self.catalog.section(version, chunk, section)?.to_gaussians();
                read.extend(gaussians.means_m.into_iter().map(bits));
            }
            let count = chunk.count;
            let x_m = 64.0 * f64::from(chunk.cell[0]);
            let pushed = (0..count).map(|index| bits([x_m, index as f64, count as f64]));
            let pushed: BTreeSet<[u64; 3]> = pushed.collect();
            if read != pushed {
                let promise =
                    format!("version {} has {read:?} in place of {pushed:?}", version.number);
                return Err(Failed::Broken(promise));
            }
        }
        Ok(())
    }

    /// Lets the clock jump. If only a lease protects a session's version, a running process renews
    /// it in time.
    fn jump(&mut self, seconds: i64) -> Result<(), StoreError> {
        self.medium.apply_delayed_puts();
        self.clock.jump(seconds * 1_000_000);
        if self.medium.has_locks() {
            return Ok(());
        }
        let mut renewed = Ok(());
        for mut session in std::mem::take(&mut self.sessions) {
            match session.lease.renew() {
                Ok(()) => self.sessions.push(session),
                // The session ends.
                Err(error) => renewed = Err(error),
            }
        }
        renewed
    }

    fn collect(&mut self, keep: Retention) -> Result<(), StoreError> {
        self.medium.apply_delayed_puts();
        // Without locks, garbage must not be collected while a commit is in preparation.
        if !self.medium.has_locks() {
            self.prepared = None;
        }
        let latest = match self.catalog.latest(TWIN) {
            Ok(latest) => latest,
            Err(StoreError::NoTwin { .. }) => return Ok(()),
            Err(error) => return Err(error),
        };
        let leased: BTreeSet<u64> = self.sessions.iter().map(|session| session.number).collect();
        let old = (1..=latest.saturating_sub(keep.versions as u64))
            .filter(|number| !leased.contains(number));
        self.collectable.extend(old);
        self.catalog.collect(TWIN, keep, false).map(|_| ())
    }

    /// Starts the next process, as after a kill or a power cut.
    fn restart(&mut self, seed: u64) -> Promise {
        self.restarts += 1;
        // The sessions and the commits of the stopped process write nothing any more.
        self.sessions.clear();
        self.prepared = None;
        self.medium = self.medium.restarted(&mut Random::new(seed));
        self.catalog = open(&*self.medium, &self.clock)?;
        self.other = open(&*self.medium, &self.clock)?;
        let left = self.medium.commits_left();
        if !left.is_empty() {
            return Err(format!("the start left {left:?}"));
        }
        self.check()
    }

    /// Checks that each session can read its version, as it was.
    fn check_sessions(&self) -> Promise {
        for Session { number, cells, .. } in &self.sessions {
            let version = self.catalog.version(TWIN, Some(*number));
            let version = version.map_err(|e| format!("a session's version {number}: {e}"))?;
            self.read_all(&version).map_err(|failed| match failed {
                Failed::Refused(error) => format!("a session's version {number}: {error}"),
                Failed::Broken(promise) => promise,
            })?;
            if version_cells(&version) != *cells {
                return Err(format!("a session's version {number} changed"));
            }
        }
        Ok(())
    }

    /// Checks all promises.
    fn check(&self) -> Promise {
        let entries = match self.catalog.versions(TWIN) {
            Err(StoreError::NoTwin { .. }) if self.acknowledged.is_empty() => return Ok(()),
            entries => entries.map_err(|e| e.to_string())?,
        };
        let numbers: Vec<u64> = entries.iter().map(|entry| entry.number).collect();
        if numbers != (1..=numbers.len() as u64).collect::<Vec<_>>() {
            return Err(format!("the log has the versions {numbers:?}"));
        }
        if let Some(lost) = self.acknowledged.keys().find(|number| !numbers.contains(number)) {
            return Err(format!("version {lost} was acknowledged and is lost"));
        }
        for number in numbers {
            let version = match self.catalog.version(TWIN, Some(number)) {
                Err(StoreError::GarbageCollected { .. }) if self.collectable.contains(&number) => {
                    continue;
                }
                version => version.map_err(|e| format!("version {number}: {e}"))?,
            };
            let content = version_cells(&version);
            let is_possible = match self.acknowledged.get(&number) {
                Some(told) => *told == content,
                None => self
                    .possible
                    .get(&number)
                    .is_some_and(|candidates| candidates.contains(&content)),
            };
            if !is_possible {
                return Err(format!("version {number} has {content:?}, which no push made"));
            }
        }
        let checked = self.catalog.fsck(TWIN, &mut |_, _| {}).map_err(|e| e.to_string())?;
        if checked.is_sound() { self.check_sessions() } else { Err(format!("fsck: {:?}", checked)) }
    }

    /// Checks that the store still works, and that no unneeded object is left.
    pub(crate) fn finish(mut self) -> Promise {
        self.check()?;
        self.sessions.clear();
        self.prepared = None;
        let failed = |what: &'static str| move |e: StoreError| format!("{what}: {e}");
        self.push(&masked_cells(7, 9)).map_err(failed("a push"))?;
        let left = self.medium.leases_left();
        // The leases of processes that were stopped expire; those of sessions that ended are gone.
        let keep = Retention { versions: 1, grace: Duration::from_secs(60) };
        for _ in 0..2 {
            self.clock.jump(30 * 86_400_000_000);
            self.collect(keep).map_err(failed("a garbage collection"))?;
        }
        let expired = self.medium.leases_left();
        if !expired.is_empty() {
            return Err(format!("of the leases {left:?}, {expired:?} do not end"));
        }
        let checked = self.catalog.fsck(TWIN, &mut |_, _| {}).map_err(failed("fsck"))?;
        if checked.unreferenced.objects > 0 {
            return Err(format!("{} objects stay for ever", checked.unreferenced.objects));
        }
        self.check()
    }
}

fn open(medium: &dyn Medium, clock: &Arc<SimClock>) -> Result<Catalog, String> {
    medium.open(clock).map_err(|error| format!("the store does not open: {error}"))
}

fn cells_alone() -> VersionChange {
    let provenance = provenance();
    VersionChange::new(provenance)
}
