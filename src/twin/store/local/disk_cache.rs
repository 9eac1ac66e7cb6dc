//! A cache of parts of remote twins on the local disk, by hash, shared by all processes of a user.
//!
//! ```text
//! <cache>/3f/3f9c...          sections, manifests and tables, named by the BLAKE3 of their bytes
//! <cache>/~<process>.<n>      a part that is being written
//! <cache>/lock                locked by the process that removes parts to free space
//! ```
//!
//! Every part is compared with its hash on every read, which costs less than decoding it. So
//! nothing needs to be synced: a part that a power cut damaged is fetched again. A part's
//! modification time is the time of its last use, to within a minute.

use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use crate::store::StoreError;
use crate::store::layout::{check_hash, is_hash};

use super::RealDisk;
use super::files::{WRITING, create_dirs, entries};
use super::real_disk::LockedFile;

/// A part gets a new modification time when it is used and the old one is older than this.
const TOUCH_AFTER: Duration = Duration::from_secs(60);
/// Age after which an unfinished file counts as left behind by a killed process.
const LEFT_AFTER: Duration = Duration::from_secs(3600);
/// Each process frees space whenever it has written this fraction (1 / `SLACK`) of the limit, so
/// that several processes together stay close to the limit.
const SLACK: u64 = 16;

/// A directory of cached parts.
#[derive(Clone, Debug)]
pub(in crate::store) struct DiskCache {
    dir: PathBuf,
    limit_bytes: u64,
    counts: Arc<Counts>,
}

#[derive(Debug, Default)]
struct Counts {
    hits: AtomicU64,
    misses: AtomicU64,
    /// Number of files begun, which makes their names unique.
    begun: AtomicU64,
    /// Bytes written since space was last freed.
    written: AtomicU64,
}

impl DiskCache {
    /// Uses a directory, created if need be, for at most `limit_bytes`.
    ///
    /// # Errors
    /// It cannot be created or listed.
    pub(in crate::store) fn open(dir: &Path, limit_bytes: u64) -> Result<Self, StoreError> {
        create_dirs(&RealDisk, dir)?;
        let cache = Self { dir: dir.to_owned(), limit_bytes, counts: Arc::default() };
        // The limit may be smaller than at the last start.
        cache.make_room()?;
        Ok(cache)
    }

    /// A part, if it is cached and undamaged.
    pub(in crate::store) fn get(&self, hash: &str) -> Option<Vec<u8>> {
        let path = self.path(hash);
        let bytes = fs::read(&path).ok();
        let sound = bytes.filter(|bytes| {
            let sound = check_hash(bytes, hash).is_ok();
            if !sound {
                // The caller fetches it again and puts it back, so there is nothing to report.
                let _ = fs::remove_file(&path);
            }
            sound
        });
        let counted = if sound.is_some() { &self.counts.hits } else { &self.counts.misses };
        counted.fetch_add(1, Ordering::Relaxed);
        if sound.is_some() {
            touch(&path);
        }
        sound
    }

    /// Caches a part that has this hash. Failures are ignored: without the cache, reading is slow
    /// but correct.
    pub(in crate::store) fn put(&self, hash: &str, bytes: &[u8]) {
        let size = bytes.len() as u64;
        // A larger part would evict too many others, and would break the bound of `make_room`.
        if size > self.limit_bytes / SLACK {
            return;
        }
        let begun = self.counts.begun.fetch_add(1, Ordering::Relaxed);
        let writing = self.dir.join(format!("{WRITING}{}.{begun}", std::process::id()));
        let path = self.path(hash);
        // Written under a name of its own and then renamed, so that other processes see all of it
        // or nothing.
        let kept = fs::create_dir_all(self.dir.join(&hash[..2]))
            .and_then(|()| fs::write(&writing, bytes))
            .and_then(|()| fs::rename(&writing, &path));
        if kept.is_err() {
            let _ = fs::remove_file(&writing);
        }
        let written = self.counts.written.fetch_add(size, Ordering::Relaxed) + size;
        // So a process is at most 1 / `SLACK` of the limit ahead of the last call.
        if written > self.limit_bytes / SLACK {
            self.counts.written.store(0, Ordering::Relaxed);
            let _ = self.make_room();
        }
    }

    pub(in crate::store) fn hits_and_misses(&self) -> (u64, u64) {
        let load = |count: &AtomicU64| count.load(Ordering::Relaxed);
        (load(&self.counts.hits), load(&self.counts.misses))
    }

    fn path(&self, hash: &str) -> PathBuf {
        self.dir.join(&hash[..2]).join(hash)
    }

    /// Removes the least recently used parts until there is space for everything that is written
    /// before the next call. One process at a time does this; concurrent callers return at once.
    fn make_room(&self) -> Result<(), StoreError> {
        let path = self.dir.join("lock");
        let lock = File::options()
            .create(true)
            .append(true)
            .open(&path)
            .map_err(StoreError::io("create", &path))?;
        // Another process or thread is freeing space.
        if lock.try_lock().is_err() {
            return Ok(());
        }
        let _lock = LockedFile(lock);
        let mut parts = Vec::new();
        for folder in entries(&RealDisk, &self.dir)? {
            let path = self.dir.join(&folder);
            if folder.starts_with(WRITING) {
                if age(&path).is_some_and(|age| age > LEFT_AFTER) {
                    let _ = fs::remove_file(&path);
                }
                continue;
            }
            for part in entries(&RealDisk, &path)?.into_iter().filter(|part| is_hash(part)) {
                let path = path.join(part);
                // Another process may have removed it because it was damaged.
                if let Ok(found) = fs::metadata(&path)
                    && let Ok(used) = found.modified()
                {
                    parts.push((used, path, found.len()));
                }
            }
        }
        // Tuples are compared by their first field: the least recently used part is first.
        parts.sort_unstable();
        let mut bytes: u64 = parts.iter().map(|(_, _, bytes)| bytes).sum();
        for (_, path, size) in parts {
            // The rest of the limit is for what is written until the next call.
            if bytes <= self.limit_bytes - self.limit_bytes / SLACK {
                break;
            }
            match fs::remove_file(&path) {
                // Another process has removed it.
                Err(error) if error.kind() != ErrorKind::NotFound => {
                    return Err(StoreError::io("remove", &path)(error));
                }
                _ => bytes -= size,
            }
        }
        Ok(())
    }
}

/// Marks a part as used. If that fails, the part is only removed earlier than it should be.
fn touch(path: &Path) {
    if age(path).is_some_and(|age| age > TOUCH_AFTER)
        && let Ok(file) = File::options().append(true).open(path)
    {
        let _ = file.set_modified(SystemTime::now());
    }
}

fn age(path: &Path) -> Option<Duration> {
    fs::metadata(path).and_then(|found| found.modified()).ok()?.elapsed().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hash(bytes: &[u8]) -> String {
        blake3::hash(bytes).to_hex().to_string()
    }

    fn part(number: u8) -> Vec<u8> {
        vec![number; 1_000]
    }

    fn sizes(dir: &Path) -> u64 {
        let folders = fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path());
        let files = folders.filter(|path| path.is_dir()).flat_map(|dir| fs::read_dir(dir).unwrap());
        files.map(|entry| entry.unwrap().metadata().unwrap().len()).sum()
    }

    #[test]
    fn parts_are_shared_by_processes_until_there_is_no_room() {
        let dir = tempfile::tempdir().unwrap();
        // 1 / `SLACK` of 32,000 bytes is 2000, two parts of 1000 bytes.
        let [one, two] = [(); 2].map(|()| DiskCache::open(dir.path(), 32_000).unwrap());
        for number in 0..100 {
            one.put(&hash(&part(number)), &part(number));
            // The first part stays in use.
            let path = one.path(&hash(&part(0)));
            let old = SystemTime::now() - 2 * TOUCH_AFTER;
            File::options().append(true).open(&path).unwrap().set_modified(old).unwrap();
            assert_eq!(two.get(&hash(&part(0))), Some(part(0)), "after {number}");
            assert!(sizes(dir.path()) <= 32_000 + 2_000, "{} after {number}", sizes(dir.path()));
        }
        assert!(sizes(dir.path()) > 20_000);
        assert_eq!(two.get(&hash(&part(99))), Some(part(99)));
        assert_eq!(two.get(&hash(&part(1))), None);
        // 100 hits of part 0 and one of part 99, and the miss of part 1.
        assert_eq!(two.hits_and_misses(), (101, 1));
        // Larger than a part may be.
        one.put(&hash(&[7; 3_000]), &[7; 3_000]);
        assert_eq!(one.get(&hash(&[7; 3_000])), None);
    }

    #[test]
    fn a_damaged_part_is_not_returned() {
        let dir = tempfile::tempdir().unwrap();
        let cache = DiskCache::open(dir.path(), 1 << 20).unwrap();
        let name = hash(&part(1));
        cache.put(&name, &part(1));
        // As a power cut leaves them: half of a part, or nothing.
        for torn in [&part(1)[..500], &[]] {
            fs::write(cache.path(&name), torn).unwrap();
            assert_eq!(cache.get(&name), None);
            assert!(!cache.path(&name).exists());
            cache.put(&name, &part(1));
            assert_eq!(cache.get(&name), Some(part(1)));
        }
        // Unfinished files of a killed process are removed after a while.
        let [old, new] = ["~1.0", "~1.1"].map(|name| dir.path().join(name));
        for path in [&old, &new] {
            fs::write(path, "half").unwrap();
        }
        let long_ago = SystemTime::now() - 2 * LEFT_AFTER;
        File::options().append(true).open(&old).unwrap().set_modified(long_ago).unwrap();
        DiskCache::open(dir.path(), 1 << 20).unwrap();
        assert!(!old.exists() && new.exists());
    }
}
