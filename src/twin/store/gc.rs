//! Garbage collection: objects that no version to be kept names, nor any in use, go in two steps.
//!
//! The first run notes which they are; a later one, after the grace period, removes those that are
//! still garbage and were not written since. So whoever reads a version at the first run has that long
//! to lease it, and whoever commits an object again has written it again. In a directory nobody can
//! publish while objects are removed; in an object store a commit that puts an object again in the very
//! seconds of its removal loses it: collect there while nobody pushes what was garbage for a day.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use serde::Deserialize;

use crate::limits;

use super::catalog::check_name;
use super::lease::LeaseRecord;
use super::log::now_us;
use super::{Catalog, StoreError};

/// What is kept, and for how long.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Retention {
    /// How many of the latest versions are kept, at least 1.
    pub versions: usize,
    /// How long an object stays after it was first found to be garbage, and after it was written.
    pub grace: Duration,
}

/// What a garbage collection found and did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CollectionReport {
    /// Versions whose objects are kept, rising: the latest ones, and older ones in use.
    pub kept: Vec<u64>,
    /// ObjectBackend that were removed.
    pub removed: ObjectTotals,
    /// ObjectBackend that are garbage, and may be removed after the grace period.
    pub noted: ObjectTotals,
}

/// How many objects, and how large they are together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ObjectTotals {
    /// ObjectBackend.
    pub objects: u64,
    /// Their bytes.
    pub bytes: u64,
}

/// ObjectBackend that are garbage, by hash, and when they were first found to be, in microseconds since 1970.
type Candidates = BTreeMap<String, i64>;

/// Where candidates are noted.
const CANDIDATES: &str = "gc/candidates";
/// Where versions are noted that are no more.
const COLLECTED: &str = "gc/collected";

/// What a run would do.
#[derive(Debug, Default)]
struct CollectionPlan {
    collected: CollectionReport,
    candidates: Candidates,
    remove: Vec<String>,
    /// Versions that lose objects.
    gone: BTreeSet<u64>,
}

impl Catalog {
    /// Removes what was garbage for the grace period, and notes what is now. With `dry_run` nothing is
    /// removed and nothing noted.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; a version that is to be kept cannot be read: then
    /// nobody knows what it names, and nothing is removed.
    pub fn collect(
        &self,
        name: &str,
        keep: Retention,
        dry_run: bool,
    ) -> Result<CollectionReport, StoreError> {
        check_name(name)?;
        let now_us = now_us();
        let before: Candidates = self.read_side_json(name, CANDIDATES)?;
        let mut plan = self.plan(name, keep, &before, now_us)?;
        if dry_run {
            return Ok(plan.collected);
        }
        if !plan.remove.is_empty() {
            self.objects.remove(name, &mut || {
                // Somebody may have published or leased since: looked at when nobody can publish, or just
                // before.
                plan = self.plan(name, keep, &before, now_us)?;
                self.mark_collected(name, &plan.gone, now_us)?;
                Ok(plan.remove.clone())
            })?;
        }
        self.objects.write_side_file(name, CANDIDATES, &self.encode(&plan.candidates)?)?;
        for lease in self.leases(name)?.iter().filter(|lease| !lease.is_live(now_us)) {
            lease.remove(self, name)?;
        }
        Ok(plan.collected)
    }

    /// Says that versions are no more, before it is so: one that lost an object without it would be
    /// damaged.
    ///
    /// # Errors
    /// [`StoreError::Leased`] if somebody leased one in this moment. Who leases writes and then looks
    /// here, and this writes and then looks there, so that one of the two sees the other.
    fn mark_collected(
        &self,
        name: &str,
        gone: &BTreeSet<u64>,
        now_us: i64,
    ) -> Result<(), StoreError> {
        let before = self.collected(name)?;
        let after: BTreeSet<u64> = before.union(gone).copied().collect();
        self.objects.write_side_file(name, COLLECTED, &self.encode(&after)?)?;
        let leases = self.leases(name)?;
        let leased = |lease: &&LeaseRecord| lease.is_live(now_us) && gone.contains(&lease.version);
        let Some(lease) = leases.iter().find(leased) else { return Ok(()) };
        self.objects.write_side_file(name, COLLECTED, &self.encode(&before)?)?;
        Err(StoreError::Leased { name: name.to_owned(), number: lease.version })
    }

    /// Versions whose objects were removed.
    pub(super) fn collected(&self, name: &str) -> Result<BTreeSet<u64>, StoreError> {
        self.read_side_json(name, COLLECTED)
    }

    fn plan(
        &self,
        name: &str,
        keep: Retention,
        before: &Candidates,
        now_us: i64,
    ) -> Result<CollectionPlan, StoreError> {
        let numbers = self.numbers(name)?;
        let latest = numbers.len().saturating_sub(keep.versions.max(1));
        let mut kept: BTreeSet<u64> = numbers[latest..].iter().copied().collect();
        let live = self.leases(name)?.into_iter().filter(|lease| lease.is_live(now_us));
        kept.extend(live.map(|lease| lease.version).filter(|number| numbers.contains(number)));
        let gone = self.collected(name)?;
        kept.retain(|number| !gone.contains(number));

        let mut named = BTreeSet::new();
        for &number in &kept {
            named.extend(self.named_by(name, &self.record(name, number)?.manifest)?);
        }
        let grace_us = i64::try_from(keep.grace.as_micros()).unwrap_or(i64::MAX);
        let is_old = |since_us: i64| now_us.saturating_sub(since_us) >= grace_us;
        let mut plan = CollectionPlan::default();
        for object in self.objects.list(name)? {
            if named.contains(&object.hash) {
                continue;
            }
            let noted_us = before.get(&object.hash).copied();
            if noted_us.is_some_and(is_old) && is_old(object.written_us) {
                plan.collected.removed.add(object.bytes);
                plan.remove.push(object.hash);
            } else if plan.candidates.len() < limits::GC_CANDIDATES {
                plan.collected.noted.add(object.bytes);
                plan.candidates.insert(object.hash, noted_us.unwrap_or(now_us));
            }
        }
        // A record that cannot be read names nothing that could be lost.
        for number in numbers.into_iter().filter(|number| !kept.contains(number)) {
            if self.record(name, number).is_ok_and(|record| plan.remove.contains(&record.manifest))
            {
                plan.gone.insert(number);
            }
        }
        plan.collected.kept = kept.into_iter().collect();
        Ok(plan)
    }

    /// Hashes of a manifest and all objects that it names.
    pub(super) fn named_by(&self, name: &str, hash: &str) -> Result<BTreeSet<String>, StoreError> {
        let manifest = self.manifest(name, hash)?;
        let chunks = manifest.chunks.into_iter().map(|chunk| chunk.object);
        let sky = manifest.sky.into_iter().map(|sky| sky.object);
        Ok(chunks.chain(sky).chain([manifest.table.object, hash.to_owned()]).collect())
    }

    /// A note, or an empty one.
    fn read_side_json<T: Default + for<'a> Deserialize<'a>>(
        &self,
        name: &str,
        note: &str,
    ) -> Result<T, StoreError> {
        let Some(bytes) = self.objects.read_side_file(name, note)? else { return Ok(T::default()) };
        serde_json::from_slice(&bytes).map_err(|error| StoreError::Damaged {
            path: self.objects.root().join(name).join(note),
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
