//! Garbage collection: removes, in two steps, objects that no kept version and no version in use
//! names.
//!
//! The first run notes them as candidates. A later run, after the grace period, removes the
//! candidates that are still garbage and were not written since. So a process that reads a version
//! at the first run has that long to lease it, and a commit that needs an object again has written
//! it again. A version goes as a whole: as long as its manifest stays, all of its objects do,
//! though some of them may have been noted before, as those of an older version.
//!
//! In a directory, publishing is locked while objects are removed. In an object store there is no
//! lock: if a commit writes an object again in the very seconds in which it is removed, the object
//! is lost. So run garbage collection there only while no push can need an object that has been
//! garbage for a day.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::time::Duration;

use serde::Deserialize;

use crate::limits;

use super::backend::ListedObject;
use super::catalog::check_name;
use super::layout::{COLLECTION, LEASES};
use super::lease::LeaseRecord;
use super::{Catalog, StoreError};

/// Which versions are kept, and how long garbage is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Retention {
    /// Number of latest versions that are kept, at least 1.
    pub versions: usize,
    /// How long an object is kept after it was first found to be garbage, and after it was written.
    pub grace: Duration,
}

/// The result of a garbage collection.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CollectionReport {
    /// Versions that are kept, ascending: the latest ones, and older ones in use.
    pub kept: Vec<u64>,
    /// Objects that were removed.
    pub removed: ObjectTotals,
    /// Objects that are garbage, and may be removed after the grace period.
    pub noted: ObjectTotals,
    /// A version that is not kept, and the damage of its manifest, which hides what the version
    /// needs. No object is removed until the manifest itself is.
    pub blocked_by: Option<(u64, String)>,
}

/// A number of objects, and their total size.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ObjectTotals {
    pub objects: u64,
    /// Their total size, in bytes.
    pub bytes: u64,
}

/// Objects that are garbage, by hash, with the time when they were first found to be, in
/// microseconds since 1970.
type Candidates = BTreeMap<String, i64>;

/// Age of what a stopped process left of a side file, in microseconds: a day, in which every write
/// ends.
const LEFTOVER_AGE_US: i64 = 86_400_000_000;
/// The side file with the candidates.
const CANDIDATES: &str = "gc/candidates";
/// The side file with the versions that were removed.
const COLLECTED: &str = "gc/collected";

/// The decisions of one run.
#[derive(Debug, Default)]
struct CollectionPlan {
    report: CollectionReport,
    candidates: Candidates,
    remove: BTreeSet<String>,
    /// Versions that lose objects.
    gone: BTreeSet<u64>,
}

impl Catalog {
    /// Removes objects that have been garbage for the grace period, and records objects that are
    /// garbage now. With `dry_run`, nothing is removed or recorded.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; a version that is to be kept cannot be read.
    /// Then it is unknown which objects it names, and nothing is removed.
    pub fn collect(
        &self,
        name: &str,
        keep: Retention,
        dry_run: bool,
    ) -> Result<CollectionReport, StoreError> {
        check_name(name)?;
        // One time for the whole run, so that both plans judge ages alike.
        let now_us = self.clock.now_us();
        let before: Candidates = self.read_side_json(name, CANDIDATES)?;
        let mut plan = self.plan(name, keep, &before, now_us)?;
        if dry_run {
            return Ok(plan.report);
        }
        if !plan.remove.is_empty() {
            self.objects.remove_objects(name, &mut || {
                // Versions may have been published or leased since the first plan. This plan is
                // made while publishing is locked; in an object store, just before the removal.
                plan = self.plan(name, keep, &before, now_us)?;
                self.mark_collected(name, &plan.gone, now_us)?;
                Ok(plan.remove.iter().cloned().collect())
            })?;
        }
        // After the removal: if that fails, the old candidates stay, and the next run tries again.
        self.objects.write_side_file(name, CANDIDATES, &self.encode(&plan.candidates)?)?;
        // Leases of processes that ended without dropping them.
        for lease in self.leases(name)? {
            if !self.is_live(name, &lease, now_us)? {
                lease.remove(self, name)?;
            }
        }
        for folder in [LEASES, COLLECTION] {
            let before_us = now_us.saturating_sub(LEFTOVER_AGE_US);
            self.objects.remove_leftovers(name, folder, before_us)?;
        }
        Ok(plan.report)
    }

    /// Records that versions are collected, before their objects are removed: otherwise they would
    /// seem damaged.
    ///
    /// # Errors
    /// [`StoreError::Leased`] if one was leased at this moment. A lease is written first and then
    /// reads this record; here, the record is written first and then the leases are read. So at
    /// least one of the two sees the other.
    pub(super) fn mark_collected(
        &self,
        name: &str,
        gone: &BTreeSet<u64>,
        now_us: i64,
    ) -> Result<(), StoreError> {
        let before = self.collected(name)?;
        let after: BTreeSet<u64> = before.union(gone).copied().collect();
        self.objects.write_side_file(name, COLLECTED, &self.encode(&after)?)?;
        let leases = self.live_leases(name, now_us)?;
        let leased = |lease: &&LeaseRecord| gone.contains(&lease.version);
        let Some(lease) = leases.iter().find(leased) else { return Ok(()) };
        // Nothing was removed yet, so that all versions are whole.
        self.objects.write_side_file(name, COLLECTED, &self.encode(&before)?)?;
        Err(StoreError::Leased { name: name.to_owned(), number: lease.version })
    }

    /// Versions that lost objects to garbage collection.
    pub(super) fn collected(&self, name: &str) -> Result<BTreeSet<u64>, StoreError> {
        self.read_side_json(name, COLLECTED)
    }

    /// Decides what to keep, to note, and to remove. `before` are the candidates of the last run.
    fn plan(
        &self,
        name: &str,
        keep: Retention,
        before: &Candidates,
        now_us: i64,
    ) -> Result<CollectionPlan, StoreError> {
        // Versions to keep: the latest ones, and those in use.
        let numbers = self.numbers(name)?;
        // The latest version stays in any case.
        let latest = numbers.len().saturating_sub(keep.versions.max(1));
        let mut kept: BTreeSet<u64> = numbers[latest..].iter().copied().collect();
        let live = self.live_leases(name, now_us)?.into_iter();
        kept.extend(live.map(|lease| lease.version).filter(|number| numbers.contains(number)));
        let gone = self.collected(name)?;
        // A collected version has no objects that could be kept.
        kept.retain(|number| !gone.contains(number));

        // Their objects are needed; all others are garbage.
        let mut named = BTreeSet::new();
        for &number in &kept {
            named.extend(self.named_by(name, &self.record(name, number)?.manifest)?);
        }
        // A grace period beyond this range never ends.
        let grace_us = i64::try_from(keep.grace.as_micros()).unwrap_or(i64::MAX);
        // If the clock jumped back, an age is negative, and the object is not old.
        let is_old = |since_us: i64| now_us.saturating_sub(since_us) >= grace_us;
        let mut found = self.objects.list_objects(name)?.whole()?;
        // An entry that is no file is no object, and is left where it is.
        found.retain(|object| object.is_file && !named.contains(&object.hash));
        let is_removable = |object: &&ListedObject| {
            let noted_us = before.get(&object.hash).copied();
            // Noted long ago, and not written again by a commit since.
            noted_us.is_some_and(is_old) && is_old(object.written_us)
        };
        let removable = found.iter().filter(is_removable).map(|object| object.hash.clone());
        let mut plan = CollectionPlan { remove: removable.collect(), ..CollectionPlan::default() };
        let others =
            numbers.into_iter().filter(|number| !kept.contains(number) && !gone.contains(number));
        self.keep_whole_versions(name, others.collect(), &is_old, &mut plan)?;
        for object in &found {
            let noted_us = before.get(&object.hash).copied();
            if plan.remove.contains(&object.hash) {
                plan.report.removed.add(object.bytes);
            } else if plan.candidates.len() < limits::GC_CANDIDATES {
                // What does not fit is noted by a later run, after others are gone.
                plan.report.noted.add(object.bytes);
                plan.candidates.insert(object.hash.clone(), noted_us.unwrap_or(now_us));
            }
        }
        plan.report.kept = kept.into_iter().collect();
        Ok(plan)
    }

    /// Decides which of the `others`, the versions that are not kept and not gone, go now: those
    /// that lose their manifest. Objects that another of them needs stay until that one goes.
    fn keep_whole_versions(
        &self,
        name: &str,
        others: Vec<u64>,
        is_old: &dyn Fn(i64) -> bool,
        plan: &mut CollectionPlan,
    ) -> Result<(), StoreError> {
        if plan.remove.is_empty() {
            return Ok(());
        }
        // Invariant: `needed` has what the versions seen so far name, as far as they stay.
        let mut manifests = Vec::new();
        let mut needed = BTreeSet::new();
        for number in others {
            // A damaged record names no object that could be removed. One that the disk fails to
            // read may: its version would seem damaged if it lost objects and were not marked.
            let record = match self.record(name, number) {
                Err(StoreError::Damaged { .. }) => continue,
                record => record?,
            };
            // A young version stays even if its manifest was noted as that of an older one, as
            // after a rollback.
            let stays = !plan.remove.contains(&record.manifest) || !is_old(record.created_us);
            // Versions that share a manifest, as after a rollback, are read once.
            if stays && !needed.contains(&record.manifest) {
                match self.named_by(name, &record.manifest) {
                    Ok(named) => needed.extend(named),
                    // A lost manifest can no longer be read.
                    Err(StoreError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => {}
                    Err(error @ StoreError::Io { .. }) => return Err(error),
                    // It is unknown what a damaged manifest names, until it goes itself.
                    Err(damage) => {
                        plan.report.blocked_by = Some((number, damage.to_string()));
                        plan.remove.clear();
                        return Ok(());
                    }
                }
            }
            manifests.push((number, record.manifest));
        }
        plan.remove.retain(|object| !needed.contains(object));
        let lost = manifests.into_iter().filter(|(_, hash)| plan.remove.contains(hash));
        plan.gone = lost.map(|(number, _)| number).collect();
        Ok(())
    }

    /// Hashes of a manifest and all objects that it names.
    pub(super) fn named_by(&self, name: &str, hash: &str) -> Result<BTreeSet<String>, StoreError> {
        let manifest = self.manifest(name, hash)?;
        let views = self.view_objects(&manifest)?;
        let chunks = manifest.chunks.into_iter().map(|chunk| chunk.object);
        let sky = manifest.sky.into_iter().map(|sky| sky.object);
        Ok(chunks.chain(sky).chain(views).chain([manifest.table.object, hash.to_owned()]).collect())
    }

    /// A side file's JSON, or the default if it does not exist.
    fn read_side_json<T: Default + for<'a> Deserialize<'a>>(
        &self,
        name: &str,
        file: &str,
    ) -> Result<T, StoreError> {
        let Some(bytes) = self.objects.read_side_file(name, file)? else { return Ok(T::default()) };
        serde_json::from_slice(&bytes).map_err(|error| StoreError::Damaged {
            path: self.objects.root().join(name).join(file),
            reason: error.to_string(),
        })
    }
}

impl ObjectTotals {
    pub(super) fn add(&mut self, bytes: u64) {
        self.objects += 1;
        self.bytes += bytes;
    }
}
