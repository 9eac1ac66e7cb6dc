//! Checks a twin: re-reads every object, and finds what is missing, damaged, or left over.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use wildcity_scene::manifest::SkyRef;

use super::backend::ListedObject;
use super::catalog::check_name;
use super::gc::ObjectTotals;
use super::{Catalog, StoreError};

/// The result of checking a twin.
#[derive(Debug)]
pub struct FsckReport {
    /// The objects that versions name.
    pub verified: VerifyReport,
    /// Numbers missing in the log.
    pub gaps: Vec<u64>,
    /// Records that cannot be read.
    pub records: Vec<(u64, StoreError)>,
    /// Versions that garbage collection removed the objects of.
    pub collected: Vec<u64>,
    /// Objects that no version names: garbage, or of a running commit.
    pub unreferenced: ObjectTotals,
    /// Whether there is staging of a running or killed commit.
    pub staging: bool,
}

/// The result of re-reading objects.
#[derive(Debug)]
pub struct VerifyReport {
    /// Number of objects that were compared with their hashes.
    pub objects: usize,
    /// Total size of the chunks, in bytes, according to the manifests.
    pub bytes: u64,
    /// Objects that differ from what was committed.
    pub damaged: Vec<DamagedObject>,
}

/// An object that differs from what was committed.
#[derive(Debug)]
pub struct DamagedObject {
    /// Its name, 64 lower-case hex digits.
    pub object: String,
    /// Its damage: it is missing, unreadable, or has another hash.
    pub error: StoreError,
}

/// A damaged log record that was set aside.
#[derive(Debug)]
pub struct RecordSetAside {
    /// Number of the version that it was the record of.
    pub number: u64,
    pub error: StoreError,
    /// Where it is now.
    pub path: PathBuf,
}

impl FsckReport {
    /// Whether everything that was committed exists. Garbage and running commits do not matter.
    pub fn is_sound(&self) -> bool {
        self.verified.damaged.is_empty() && self.gaps.is_empty() && self.records.is_empty()
    }
}

impl Catalog {
    /// Compares every object of every version of a twin with its hash, and finds what is missing
    /// and what is left over. `progress` gets the bytes done and in all.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; the log cannot be listed. Damage is no error,
    /// but part of the result.
    pub fn fsck(
        &self,
        name: &str,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<FsckReport, StoreError> {
        check_name(name)?;
        // Listed first, so that objects committed meanwhile are not reported as left over.
        let listed = self.objects.list_objects(name)?.whole()?;
        let numbers = self.numbers(name)?;
        let present: BTreeSet<u64> = numbers.iter().copied().collect();
        let last = numbers[numbers.len() - 1];
        // Bounded: a damaged log could have any number of gaps.
        let gaps = (1..last).filter(|number| !present.contains(number)).take(numbers.len());
        let mut records = Vec::new();
        let mut readable = Vec::new();
        // Collected versions lost their objects on purpose, so that they are no damage.
        let collected = self.collected(name)?;
        for number in numbers.into_iter().filter(|number| !collected.contains(number)) {
            match self.record(name, number) {
                Ok(_) => readable.push(number),
                Err(error) => records.push((number, error)),
            }
        }
        let (verified, named) = self.reread(name, &readable, progress)?;
        let mut unreferenced = ObjectTotals::default();
        let is_unreferenced =
            |object: &&ListedObject| object.is_file && !named.contains(&object.hash);
        for object in listed.iter().filter(is_unreferenced) {
            unreferenced.add(object.bytes);
        }
        Ok(FsckReport {
            verified,
            gaps: gaps.collect(),
            records,
            collected: collected.into_iter().collect(),
            unreferenced,
            staging: self.objects.unfinished_commits()?.iter().any(|unfinished| unfinished == name),
        })
    }

    /// Sets the newest records of a twin's log aside, as long as the newest cannot be read. The
    /// version before them is the latest again, and the next commit takes their number. Objects
    /// stay: a commit of the same content uses them.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; the log cannot be listed or changed.
    pub fn repair_log(&self, name: &str) -> Result<Vec<RecordSetAside>, StoreError> {
        let mut aside = Vec::new();
        for number in self.numbers(name)?.into_iter().rev() {
            // Not beyond a sound record: to set an older one aside would leave a gap.
            let Err(error) = self.record(name, number) else { break };
            // A file that the system refuses to read may be sound: its permissions or the disk may
            // be at fault.
            let is_refused =
                matches!(&error, StoreError::Io { cause, .. } if cause.raw_os_error().is_some());
            if is_refused {
                return Err(error);
            }
            let path = self.objects.set_record_aside(name, number)?;
            aside.push(RecordSetAside { number, error, path });
        }
        Ok(aside)
    }

    /// Compares every object of every version of a twin with its hash. `progress` gets the bytes
    /// done and in all.
    ///
    /// # Errors
    /// [`StoreError::Name`], [`StoreError::NoTwin`]; the log cannot be read. Damage is no error,
    /// but part of the result.
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

    /// Compares the objects of some versions with their hashes. Also returns the hashes that they
    /// name.
    fn reread(
        &self,
        name: &str,
        numbers: &[u64],
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<(VerifyReport, BTreeSet<String>), StoreError> {
        // The disk cache may have objects that the store has lost.
        let uncached = self.uncached();
        let mut damaged = Vec::new();
        // By hash, because versions share most objects.
        let mut named = BTreeSet::new();
        let mut chunks = BTreeMap::new();
        let mut images = BTreeSet::new();
        for &number in numbers {
            let hash = uncached.record(name, number)?.manifest;
            // After a rollback, two versions have the same manifest.
            if !named.insert(hash.clone()) {
                continue;
            }
            match uncached.manifest(name, &hash) {
                Ok(mut manifest) => {
                    let table = manifest.table.object.clone();
                    named.insert(table.clone());
                    if let Some(SkyRef { object, .. }) = manifest.sky.clone()
                        && named.insert(object.clone())
                        // With 0 bytes to keep, the object is only hashed.
                        && let Err(error) = uncached.objects.read_start(name, &object, 0)
                    {
                        damaged.push(DamagedObject { object, error });
                    }
                    match uncached.view_objects(&manifest) {
                        Ok(objects) => {
                            // Images that several versions name are read once.
                            for object in objects.into_iter().filter(|one| !named.contains(one)) {
                                let read = uncached.objects.read_start(name, &object, 0);
                                if let Err(error) = read {
                                    damaged.push(DamagedObject { object: object.clone(), error });
                                }
                                images.insert(object);
                            }
                            named.append(&mut images);
                        }
                        Err(error) => {
                            // What the table of images names is unknown, so that only the table is
                            // reported.
                            let views = manifest.views.iter().map(|views| views.object.clone());
                            let object = views.collect::<String>();
                            if named.insert(object.clone()) {
                                damaged.push(DamagedObject { object, error });
                            }
                        }
                    }
                    // Without the table, chunks are still compared with their own hashes.
                    if let Err(error) = uncached.fill(&mut manifest) {
                        damaged.push(DamagedObject { object: table, error });
                    }
                    // By hash: a chunk that several versions name is read once.
                    chunks.extend(manifest.chunks.into_iter().map(|c| (c.object.clone(), c)));
                }
                Err(error) => damaged.push(DamagedObject { object: hash, error }),
            }
        }
        let total = chunks.values().map(|chunk| chunk.bytes).sum();
        // No object counts twice: `named` has no chunks yet.
        let objects = chunks.len() + named.len();
        let mut done = 0;
        for (object, chunk) in chunks {
            // A damaged table leaves the sections unknown, with which the chunk could be compared.
            let checked = if chunk.sections.is_empty() {
                uncached.objects.read_start(name, &object, 0).map(|_| ())
            } else {
                uncached.check_chunk(name, &chunk)
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
