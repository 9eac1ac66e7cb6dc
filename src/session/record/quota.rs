//! How many bytes records may have: of one owner, and of all.
//!
//! The bytes are counted before they are written. What is on the disk is looked up when the counts
//! say that there is no room, since an operator removes records while the server runs.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use wildcity_episode::{RecordHead, mcap_path, record_bytes};

/// Time between two looks at the disk: each opens every record.
const LOOK_PERIOD: Duration = Duration::from_secs(10);

/// The most bytes of records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecordLimits {
    /// Of the records of all owners together.
    pub bytes: u64,
    /// Of the records of one owner.
    pub owner_bytes: u64,
}

/// Counts the bytes of records.
#[derive(Debug)]
pub(crate) struct RecordQuota {
    dir: PathBuf,
    limits: Mutex<RecordLimits>,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    bytes: u64,
    by_owner: BTreeMap<String, u64>,
    /// When the disk was last looked at.
    looked: Option<Instant>,
}

impl Default for RecordLimits {
    fn default() -> Self {
        Self { bytes: u64::MAX, owner_bytes: u64::MAX }
    }
}

impl RecordQuota {
    /// The quota of a directory, without limits.
    pub(crate) fn new(dir: PathBuf) -> Self {
        Self { dir, limits: Mutex::default(), held: Mutex::default() }
    }

    pub(crate) fn limit(&self, limits: RecordLimits) {
        *self.limits.lock() = limits;
    }

    /// Counts bytes that an owner is about to write. Blocks.
    ///
    /// # Errors
    /// There is no room for them.
    pub(crate) fn take(&self, owner: &str, bytes: u64) -> io::Result<()> {
        let limits = *self.limits.lock();
        // Without limits nothing is looked up.
        if limits == RecordLimits::default() {
            return Ok(());
        }
        let mut held = self.held.lock();
        let is_old = held.looked.is_none_or(|looked| looked.elapsed() >= LOOK_PERIOD);
        // The first look is made in any case, so that records of earlier runs count.
        if held.looked.is_none() || (is_old && refusal(&held, limits, owner, bytes).is_some()) {
            *held = Held::look(&self.dir)?;
        }
        if let Some(reason) = refusal(&held, limits, owner, bytes) {
            return Err(io::Error::new(io::ErrorKind::QuotaExceeded, reason));
        }
        held.bytes += bytes;
        *held.by_owner.entry(owner.to_owned()).or_default() += bytes;
        Ok(())
    }

    /// Gives back bytes that were not written.
    pub(crate) fn give_back(&self, owner: &str, bytes: u64) {
        let mut held = self.held.lock();
        // Saturating, because a look at the disk in between may not have counted them.
        held.bytes = held.bytes.saturating_sub(bytes);
        if let Some(own) = held.by_owner.get_mut(owner) {
            *own = own.saturating_sub(bytes);
        }
    }
}

/// Why an owner may not write so many bytes, if it may not.
fn refusal(held: &Held, limits: RecordLimits, owner: &str, bytes: u64) -> Option<String> {
    let own = held.by_owner.get(owner).copied().unwrap_or_default();
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    if own.saturating_add(bytes) > limits.owner_bytes {
        let most = gib(limits.owner_bytes);
        return Some(format!(
            "the records of this token have {:.3} GiB of {most:.3}: ask the operator to remove some \
             (--token-records-gib)",
            gib(own)
        ));
    }
    if held.bytes.saturating_add(bytes) > limits.bytes {
        let most = gib(limits.bytes);
        return Some(format!(
            "all records have {:.3} GiB of {most:.3}: ask the operator to remove some (--records-gib)",
            gib(held.bytes)
        ));
    }
    None
}

impl Held {
    /// What is on the disk.
    fn look(dir: &Path) -> io::Result<Self> {
        let mut held = Self { looked: Some(Instant::now()), ..Self::default() };
        let entries = match std::fs::read_dir(dir) {
            Ok(entries) => entries,
            // Without the directory there are no records.
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(held),
            Err(error) => return Err(error),
        };
        for entry in entries {
            let path = entry?.path();
            if path.extension().is_none_or(|extension| extension != "jsonl") {
                continue;
            }
            // What is no record counts for all, and for no token.
            let owner = RecordHead::read(&path).map(|head| head.owner).unwrap_or_default();
            let bytes = record_bytes(&path) + record_bytes(&mcap_path(&path));
            held.bytes += bytes;
            *held.by_owner.entry(owner).or_default() += bytes;
        }
        Ok(held)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(dir: &Path, name: &str, owner: &str, bytes: usize) {
        let head = format!(
            r#"{{"kind":"episode","format":0,"owner":"{owner}","twin":"t","version":1,"rig":""#
        );
        let text = format!("{head}{}\"}}\n", "x".repeat(bytes - head.len() - 3));
        std::fs::write(dir.join(name), text).unwrap();
    }

    #[test]
    fn an_owner_and_all_have_limits_of_their_own() {
        let dir = tempfile::tempdir().unwrap();
        record(dir.path(), "a-1.jsonl", "ann", 500);
        record(dir.path(), "b-1.jsonl", "bob", 300);
        let quota = RecordQuota::new(dir.path().to_owned());
        quota.take("ann", u64::MAX / 2).unwrap();
        quota.limit(RecordLimits { bytes: 1000, owner_bytes: 600 });
        quota.take("ann", 100).unwrap();
        let refused = quota.take("ann", 1).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::QuotaExceeded);
        assert!(refused.to_string().contains("--token-records-gib"), "{refused}");
        quota.take("bob", 100).unwrap();
        let refused = quota.take("eve", 1).unwrap_err();
        assert!(refused.to_string().contains("--records-gib"), "{refused}");
        quota.give_back("ann", 100);
        quota.take("bob", 100).unwrap();
    }

    #[test]
    fn what_the_operator_removes_makes_room() {
        let dir = tempfile::tempdir().unwrap();
        record(dir.path(), "a-1.jsonl", "ann", 500);
        let quota = RecordQuota::new(dir.path().to_owned());
        quota.limit(RecordLimits { bytes: 600, owner_bytes: 600 });
        assert!(quota.take("ann", 200).is_err());
        std::fs::remove_file(dir.path().join("a-1.jsonl")).unwrap();
        // It was looked at a moment ago.
        assert!(quota.take("ann", 200).is_err());
        quota.held.lock().looked = Instant::now().checked_sub(LOOK_PERIOD);
        quota.take("ann", 200).unwrap();
    }
}
