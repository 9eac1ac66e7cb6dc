//! The folder of a round: samples renamed into place, and a run that continues after them.
//!
//! Each file is written under a temporary name and renamed. When all files of a sample are written,
//! it gets a line in `samples.partial.jsonl`. augment.json is written at the start, without the
//! samples that are still to be rendered, and at the end, with all of them. So the folder of a run
//! that was killed at any time has the settings of this run, and the next run keeps the samples
//! whose files have the recorded hashes.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, TryLockError};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest, Sha256};

use crate::AugmentError;
use crate::limits::RECORD_BYTES;
use crate::record::{CONVENTIONS, FORMAT, Header, Sample, SampleFiles, difference};

const RECORD: &str = "augment.json";
const JOURNAL: &str = "samples.partial.jsonl";
const LOCK: &str = "augment.lock";

/// The folder of a round while it is written. No other run can open it.
#[derive(Debug)]
pub struct Folder {
    dir: PathBuf,
    header: Header,
    samples: BTreeMap<String, Sample>,
    journal: File,
    /// Samples of earlier runs of which a file is missing or differs.
    damaged: usize,
    _lock: Lock,
}

#[derive(Serialize)]
struct Record<'a> {
    format: &'static str,
    complete: bool,
    #[serde(flatten)]
    header: &'a Header,
    conventions: BTreeMap<&'static str, &'static str>,
    samples: Vec<&'a Sample>,
}

#[derive(Deserialize)]
struct ReadRecord {
    #[serde(flatten)]
    header: Header,
    samples: Vec<Sample>,
}

impl Folder {
    /// Opens the folder, which may be missing or hold an unfinished or finished round, and checks
    /// its samples. Calls `progress` with the number of checked samples and the number of all.
    ///
    /// # Errors
    /// It was made with other settings, is not a folder of a round, or another run writes there.
    pub fn open(
        dir: &Path,
        header: Header,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Self, AugmentError> {
        fs::create_dir_all(dir).map_err(AugmentError::file(dir))?;
        let record = dir.join(RECORD);
        let had_record = record.is_file();
        // A folder of something else is not touched, not even by a lock.
        if !had_record && !is_empty(dir)? {
            return Err(AugmentError::NotOurs { dir: dir.to_owned() });
        }
        // Before anything is read: another run may be writing.
        let lock = Lock::take(dir)?;
        let mut found = BTreeMap::new();
        if had_record {
            let read = read_record(&record)?;
            if let Some([field, there, here]) =
                difference(&read.header.made_with, &header.made_with)
            {
                return Err(AugmentError::MadeOtherwise {
                    dir: dir.to_owned(),
                    field,
                    there,
                    here,
                });
            }
            let journal = read_journal(&dir.join(JOURNAL))?;
            // The journal comes last: of two entries of a name the newer one stays.
            let all = read.samples.into_iter().chain(journal);
            found.extend(all.map(|sample| (sample.name.clone(), sample)));
        }
        let total = found.len() as u64;
        let mut samples = BTreeMap::new();
        // From here on only samples whose files are all there with their hashes.
        for (checked, (name, sample)) in (1..).zip(found) {
            if is_sound(dir, &sample)? {
                samples.insert(name, sample);
            }
            progress(checked, total);
        }
        let damaged = total as usize - samples.len();
        let path = dir.join(JOURNAL);
        // Write the samples of the journal to augment.json before the journal is emptied.
        write_record(dir, &header, false, &samples.values().collect::<Vec<_>>())?;
        // Emptied, as its samples are in augment.json now.
        let journal = File::create(&path).map_err(AugmentError::file(&path))?;
        Ok(Self { dir: dir.to_owned(), header, samples, journal, damaged, _lock: lock })
    }

    /// Whether the folder has a sample of this name.
    pub fn has(&self, name: &str) -> bool {
        self.samples.contains_key(name)
    }

    /// Number of samples in the folder.
    pub fn count(&self) -> usize {
        self.samples.len()
    }

    /// Number of samples of earlier runs of which a file is missing or has another hash.
    pub fn damaged(&self) -> usize {
        self.damaged
    }

    /// Writes the files of a sample, and then records it with the hashes of its files.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn put(&mut self, mut sample: Sample, files: &SampleFiles) -> Result<(), AugmentError> {
        // Files first and the line last: a line in the journal means that all files are complete.
        for (path, bytes) in files.named(&sample.name) {
            write(&self.dir.join(&path), bytes)?;
            sample.files.insert(path, hash(bytes));
        }
        // One write for line and line feed, so that a kill leaves at most one cut line.
        let mut line = serde_json::to_vec(&sample).unwrap_or_default();
        line.push(b'\n');
        self.journal.write_all(&line).map_err(AugmentError::file(&self.dir.join(JOURNAL)))?;
        self.samples.insert(sample.name.clone(), sample);
        Ok(())
    }

    /// The samples of these names, in this order, and nothing else: those of the plan.
    pub fn samples(&self, names: &[String]) -> Vec<Sample> {
        names.iter().filter_map(|name| self.samples.get(name)).cloned().collect()
    }

    /// Writes a file of the folder, such as transforms.json.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), AugmentError> {
        write(&self.dir.join(name), bytes)
    }

    /// Writes augment.json with all samples, and marks it complete.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn finish(self, samples: &[Sample]) -> Result<(), AugmentError> {
        // In this order: between the two steps the journal only repeats what the record has.
        write_record(&self.dir, &self.header, true, &samples.iter().collect::<Vec<_>>())?;
        let path = self.dir.join(JOURNAL);
        fs::remove_file(&path).map_err(AugmentError::file(&path))
    }
}

/// SHA-256 in hex, which is available in every language.
fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The lock of a folder for writing: a locked file, which is removed at the end. The system unlocks
/// it if the process ends in another way.
#[derive(Debug)]
struct Lock {
    path: PathBuf,
    file: File,
}

impl Lock {
    fn take(dir: &Path) -> Result<Self, AugmentError> {
        let path = dir.join(LOCK);
        let in_use = || AugmentError::InUse { dir: dir.to_owned() };
        // The file has no content: it may be created by several runs, and one of them gets
        // the lock.
        let file = File::create(&path).map_err(AugmentError::file(&path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(in_use()),
            Err(TryLockError::Error(cause)) => return Err(AugmentError::File { path, cause }),
        }
        // Another run may have removed the file between creation and lock, and a third run may have
        // created a new one.
        let inode = |metadata: fs::Metadata| metadata.ino();
        let own = file.metadata().map(inode).map_err(AugmentError::file(&path))?;
        match fs::metadata(&path).map(inode) {
            Ok(there) if there == own => Ok(Self { path, file }),
            _ => Err(in_use()),
        }
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        // If it cannot be removed, the next run locks it.
        let _ = fs::remove_file(&self.path);
        // A process that another thread is starting may have a copy of the file, which would hold
        // the lock.
        let _ = self.file.unlock();
    }
}

/// Whether the folder has only files of a run that was killed before it wrote augment.json.
fn is_empty(dir: &Path) -> Result<bool, AugmentError> {
    let ours: BTreeSet<String> = [LOCK.to_owned(), temporary_name(RECORD)].into();
    for entry in fs::read_dir(dir).map_err(AugmentError::file(dir))? {
        let entry = entry.map_err(AugmentError::file(dir))?;
        if !entry.file_name().to_str().is_some_and(|name| ours.contains(name)) {
            return Ok(false);
        }
    }
    Ok(true)
}

fn read_record(path: &Path) -> Result<ReadRecord, AugmentError> {
    let damaged = |reason: String| AugmentError::Damaged { path: path.to_owned(), reason };
    let mut text = String::new();
    let file = File::open(path).map_err(AugmentError::file(path))?;
    file.take(RECORD_BYTES).read_to_string(&mut text).map_err(AugmentError::file(path))?;
    let json: Value = serde_json::from_str(&text).map_err(|error| damaged(error.to_string()))?;
    // Before the fields: another version of the format would fail at one of them, with a
    // worse message.
    if json["format"] != FORMAT {
        return Err(damaged(format!("its format is {}, and not {FORMAT:?}", json["format"])));
    }
    serde_json::from_value(json).map_err(|error| damaged(error.to_string()))
}

/// The samples of a run that did not end. Its last line may be cut.
fn read_journal(path: &Path) -> Result<Vec<Sample>, AugmentError> {
    if !path.is_file() {
        return Ok(Vec::new());
    }
    let file = File::open(path).map_err(AugmentError::file(path))?;
    let mut samples = Vec::new();
    for line in BufReader::new(file.take(RECORD_BYTES)).split(b'\n') {
        let line = line.map_err(AugmentError::file(path))?;
        // A sample whose line cannot be read is rendered again.
        samples.extend(serde_json::from_slice::<Sample>(&line).ok());
    }
    Ok(samples)
}

/// Whether the files of a sample exist and have their hashes.
fn is_sound(dir: &Path, sample: &Sample) -> Result<bool, AugmentError> {
    for (name, expected) in &sample.files {
        let path = dir.join(name);
        match fs::read(&path) {
            // A whole file at once: a PNG has some MB.
            Ok(bytes) if hash(&bytes) == *expected => {}
            Ok(_) => return Ok(false),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(false),
            Err(cause) => return Err(AugmentError::File { path, cause }),
        }
    }
    // A sample without files would pass without a test.
    Ok(!sample.files.is_empty())
}

fn write_record(
    dir: &Path,
    header: &Header,
    complete: bool,
    samples: &[&Sample],
) -> Result<(), AugmentError> {
    let record = Record {
        format: FORMAT,
        complete,
        header,
        conventions: CONVENTIONS.into_iter().collect(),
        samples: samples.to_vec(),
    };
    let path = dir.join(RECORD);
    let damaged = |error: serde_json::Error| AugmentError::Damaged {
        path: path.clone(),
        reason: error.to_string(),
    };
    let mut text = serde_json::to_vec_pretty(&record).map_err(damaged)?;
    text.push(b'\n');
    write(&path, &text)
}

fn temporary_name(name: &str) -> String {
    format!("{name}.tmp")
}

/// Writes a file under a temporary name, and renames it. Only one run writes to the folder, so the
/// next run overwrites temporary files of a killed one.
fn write(path: &Path, bytes: &[u8]) -> Result<(), AugmentError> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(AugmentError::file(folder))?;
    }
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    // In the same folder, since a rename is atomic only within a file system.
    let temporary = path.with_file_name(temporary_name(name));
    fs::write(&temporary, bytes).map_err(AugmentError::file(&temporary))?;
    fs::rename(&temporary, path).map_err(AugmentError::file(path))
}

#[cfg(test)]
mod tests {
    use wildcity_scene::geometry::Pose;

    use super::*;
    use crate::record::tests::{header, model};

    fn sample(at: u32) -> Sample {
        Sample {
            name: format!("front/{at}.png"),
            trajectory: "log".to_owned(),
            station_m: at.into(),
            offset_m: 0.5,
            camera: "front".to_owned(),
            world_from_camera: Pose::IDENTITY,
            trust: 0.5,
            weight: 0.15,
            counted: 1.0,
            repair: None,
            files: BTreeMap::new(),
        }
    }

    fn files(at: u32) -> SampleFiles {
        let file = |kind: u8| vec![kind, at as u8];
        SampleFiles { image: file(1), rendered: Some(file(2)), mask: file(3), depth: file(4) }
    }

    fn open(dir: &Path) -> Result<Folder, AugmentError> {
        Folder::open(dir, header(), &mut |_, _| {})
    }

    fn names(count: u32) -> Vec<String> {
        (0..count).map(|at| sample(at).name).collect()
    }

    /// A finished folder of three samples.
    fn finished(dir: &Path) -> Vec<u8> {
        let mut folder = open(dir).unwrap();
        for at in 0..3 {
            folder.put(sample(at), &files(at)).unwrap();
        }
        let samples = folder.samples(&names(3));
        folder.finish(&samples).unwrap();
        fs::read(dir.join(RECORD)).unwrap()
    }

    #[test]
    fn a_run_that_was_killed_is_continued_to_the_same_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let whole = finished(&dir.path().join("whole"));
        let cut = dir.path().join("cut");
        let mut folder = open(&cut).unwrap();
        folder.put(sample(0), &files(0)).unwrap();
        folder.put(sample(1), &files(1)).unwrap();
        // As kill -9 leaves it, within a line and between two files.
        // The lock is gone with the process; the journal stays.
        drop(folder);
        let journal = fs::read(cut.join(JOURNAL)).unwrap();
        fs::write(cut.join(JOURNAL), &journal[..journal.len() - 20]).unwrap();
        fs::write(cut.join("images/front/2.png"), b"half").unwrap();
        fs::write(cut.join("masks/front/2.png.tmp"), b"half").unwrap();

        let mut folder = open(&cut).unwrap();
        assert_eq!((folder.has("front/0.png"), folder.has("front/1.png")), (true, false));
        // The cut line is no sample, so that nothing counts as damaged.
        assert_eq!((folder.count(), folder.damaged()), (1, 0));
        let mut again = open(&cut);
        assert!(matches!(again, Err(AugmentError::InUse { .. })), "{again:?}");
        for at in 1..3 {
            folder.put(sample(at), &files(at)).unwrap();
        }
        let samples = folder.samples(&names(3));
        folder.finish(&samples).unwrap();
        assert_eq!(fs::read(cut.join(RECORD)).unwrap(), whole);
        again = open(&cut);
        assert_eq!(again.unwrap().count(), 3);
    }

    #[test]
    fn a_sample_with_a_missing_or_changed_file_is_not_trusted() {
        let dir = tempfile::tempdir().unwrap();
        finished(dir.path());
        fs::remove_file(dir.path().join("depth/front/0.png")).unwrap();
        fs::write(dir.path().join("rendered/front/2.png"), [2, 3]).unwrap();
        let folder = open(dir.path()).unwrap();
        // One sample has lost its depth, another has other bytes.
        assert_eq!((folder.count(), folder.damaged()), (1, 2));
        assert!(folder.has("front/1.png"));
        let text = fs::read_to_string(dir.path().join(RECORD)).unwrap();
        assert!(text.contains("\"complete\": false"), "{text}");
    }

    #[test]
    fn a_folder_of_something_else_is_refused_and_untouched() {
        let dir = tempfile::tempdir().unwrap();
        let before = finished(dir.path());
        let refused = |change: &dyn Fn(&mut Header)| {
            let mut other = header();
            change(&mut other);
            Folder::open(dir.path(), other, &mut |_, _| {}).unwrap_err().to_string()
        };
        let said = refused(&|header| header.made_with.version_hash = "12".repeat(32));
        assert!(said.contains("another version_hash: \"abab"), "{said}");
        let said = refused(&|header| header.made_with.repair = Some(model()));
        assert!(said.contains("another repair: none there, \"net\" here"), "{said}");
        let said = refused(&|header| header.made_with.options.every_m = 3.0);
        assert!(said.contains("another options.every_m: 2.0 there, 3.0 here"), "{said}");
        assert_eq!(fs::read(dir.path().join(RECORD)).unwrap(), before);
        assert!(!dir.path().join(LOCK).exists() && !dir.path().join(JOURNAL).exists());
        // The number of a version is not its content.
        let mut same = header();
        same.version = 9;
        assert_eq!(Folder::open(dir.path(), same, &mut |_, _| {}).unwrap().count(), 3);

        let foreign = tempfile::tempdir().unwrap();
        fs::write(foreign.path().join("photo.png"), b"mine").unwrap();
        let said = open(foreign.path()).unwrap_err().to_string();
        assert!(said.contains("has files, but no augment.json"), "{said}");
        fs::write(foreign.path().join(RECORD), b"{}").unwrap();
        let said = open(foreign.path()).unwrap_err().to_string();
        assert!(said.contains("its format is null"), "{said}");
    }
}
