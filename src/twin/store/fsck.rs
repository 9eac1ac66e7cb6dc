//! Looking after a twin: every object re-read, and everything that does not belong together.

use std::collections::{BTreeMap, BTreeSet};

use wildcity_scene::manifest::SkyRef;

use super::catalog::check_name;
use super::gc::ObjectTotals;
use super::{Catalog, StoreError};

/// What was found of a twin.
#[derive(Debug)]
pub struct FsckReport {
    /// The objects that versions name.
    pub verified: VerifyReport,
    /// Numbers that the log leaves out.
    pub gaps: Vec<u64>,
    /// Records that cannot be read.
    pub records: Vec<(u64, StoreError)>,
    /// Versions whose objects garbage collection removed.
    pub collected: Vec<u64>,
    /// ObjectBackend that no version names: garbage, or of a commit that runs.
    pub unreferenced: ObjectTotals,
    /// Whether there is staging of a commit that runs or was killed.
    pub staging: bool,
}

/// What was re-read.
#[derive(Debug)]
pub struct VerifyReport {
    /// ObjectBackend that were compared with their hashes.
    pub objects: usize,
    /// Size of the chunks together, in bytes, as the manifests say.
    pub bytes: u64,
    /// The ones that are not what was committed.
    pub damaged: Vec<DamagedObject>,
}

/// An object that is not what was committed.
#[derive(Debug)]
pub struct DamagedObject {
    /// Its name, 64 lower-case hex digits.
    pub object: String,
    /// What is wrong with it: missing, unreadable, or of another hash.
    pub error: StoreError,
}

impl FsckReport {
    /// Whether everything that was committed is there. Garbage and what is being made is no loss.
    pub fn is_sound(&self) -> bool {
        self.verified.damaged.is_empty() && self.gaps.is_empty() && self.records.is_empty()
    }
}

impl Catalog {
    /// Compares every object of every version of a twin with its hash, and looks for what is missing
    /// and what is left over. `progress` gets bytes done and bytes in all.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; the log cannot be listed. DamagedObject is no error: it
    /// is the answer.
    pub fn fsck(
        &self,
        name: &str,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<FsckReport, StoreError> {
        check_name(name)?;
        // ListedObject first, so that what is committed meanwhile is not taken for left over.
        let listed = self.objects.list(name)?;
        let numbers = self.numbers(name)?;
        let present: BTreeSet<u64> = numbers.iter().copied().collect();
        let last = numbers[numbers.len() - 1];
        // However many there are, no more than the log has records are named.
        let gaps = (1..last).filter(|number| !present.contains(number)).take(numbers.len());
        let (mut records, mut readable) = (Vec::new(), Vec::new());
        let collected = self.collected(name)?;
        for number in numbers.into_iter().filter(|number| !collected.contains(number)) {
            match self.record(name, number) {
                Ok(_) => readable.push(number),
                Err(error) => records.push((number, error)),
            }
        }
        let (verified, named) = self.reread(name, &readable, progress)?;
        let mut unreferenced = ObjectTotals::default();
        for object in listed.iter().filter(|object| !named.contains(&object.hash)) {
            unreferenced.add(object.bytes);
        }
        Ok(FsckReport {
            verified,
            gaps: gaps.collect(),
            records,
            collected: collected.into_iter().collect(),
            unreferenced,
            staging: self.objects.unfinished_commits()?.iter().any(|begun| begun == name),
        })
    }

    /// Compares every object of every version of a twin with its hash. `progress` gets bytes done
    /// and bytes in all.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; the log cannot be read. DamagedObject is no error: it is the answer.
    pub fn verify(
        &self,
        name: &str,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<VerifyReport, StoreError> {
        check_name(name)?;
        let collected = self.collected(name)?;
        let mut numbers = self.numbers(name)?;
        numbers.retain(|number| !collected.contains(number));
        self.reread(name, &numbers, progress).map(|(verified, _)| verified)
    }

    /// Compares the objects of some versions with their hashes. Returns the hashes that they name,
    /// too.
    fn reread(
        &self,
        name: &str,
        numbers: &[u64],
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<(VerifyReport, BTreeSet<String>), StoreError> {
        // What the disk cache keeps may be lost where the twin is.
        let there = self.uncached();
        let mut damaged = Vec::new();
        // By hash: versions share objects, and are often alike.
        let (mut named, mut chunks) = (BTreeSet::new(), BTreeMap::new());
        for &number in numbers {
            let hash = there.record(name, number)?.manifest;
            if !named.insert(hash.clone()) {
                continue;
            }
            match there.manifest(name, &hash) {
                Ok(mut manifest) => {
                    let table = manifest.table.object.clone();
                    named.insert(table.clone());
                    if let Some(SkyRef { object, .. }) = manifest.sky.clone()
                        && named.insert(object.clone())
                        && let Err(error) = there.objects.read_start(name, &object, 0)
                    {
                        damaged.push(DamagedObject { object, error });
                    }
                    // Without their table, chunks are still compared with their own hashes.
                    if let Err(error) = there.fill(&mut manifest) {
                        damaged.push(DamagedObject { object: table, error });
                    }
                    chunks.extend(manifest.chunks.into_iter().map(|c| (c.object.clone(), c)));
                }
                Err(error) => damaged.push(DamagedObject { object: hash, error }),
            }
        }
        let total = chunks.values().map(|chunk| chunk.bytes).sum();
        let objects = chunks.len() + named.len();
        let mut done = 0;
        for (object, chunk) in chunks {
            let checked = if chunk.sections.is_empty() {
                there.objects.read_start(name, &object, 0).map(|_| ())
            } else {
                there.check_chunk(name, &chunk)
            };
            if let Err(error) = checked {
                damaged.push(DamagedObject { object: object.clone(), error });
            }
            named.insert(object);
            done += chunk.bytes;
            progress(done, total);
        }
        Ok((VerifyReport { objects, bytes: total, damaged }, named))
    }
}
