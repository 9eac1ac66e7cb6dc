//! A twin's log: which manifest each version is, since when, and how it came about.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::{Catalog, StorageOptions, StoreError, Version};

/// One entry of a twin's log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogEntry {
    /// The version's number, from 1.
    pub number: u64,
    /// Hash of its manifest, 64 lower-case hex digits.
    pub hash: String,
    /// When it was committed, in microseconds since 1970.
    pub created_us: i64,
    /// Identity of the commit that made it; none of versions older than commits with one.
    pub commit: Option<String>,
    /// The version that it was made from: what a push changed, or what a rollback restored.
    pub parent: Option<u64>,
    /// How it came about.
    pub kind: CommitKind,
}

/// How a version came about.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CommitKind {
    /// By an import, whole.
    #[default]
    Import,
    /// By a push to a server.
    Push,
    /// As an old version, again.
    Rollback,
}

impl std::fmt::Display for CommitKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Import => "import",
            Self::Push => "push",
            Self::Rollback => "rollback",
        })
    }
}

/// A record of the log, as JSON. What says how a version came about is no part of the manifest, whose
/// hash is of its content alone.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LogRecord {
    pub(super) manifest: String,
    pub(super) created_us: i64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) commit: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) parent: Option<u64>,
    #[serde(default)]
    pub(super) kind: CommitKind,
}

impl LogRecord {
    /// A record of now.
    pub(super) fn new(
        manifest: String,
        commit: &str,
        parent: Option<u64>,
        kind: CommitKind,
    ) -> Self {
        let created_us = now_us();
        Self { manifest, created_us, commit: Some(commit.to_owned()), parent, kind }
    }
}

impl Catalog {
    /// All versions of a twin in order of their numbers, from the log alone.
    ///
    /// # Errors
    /// [`StoreError::Name`] or [`StoreError::NoTwin`] for what was asked; [`StoreError::Damaged`] for
    /// a record that is not one.
    pub fn versions(&self, name: &str) -> Result<Vec<LogEntry>, StoreError> {
        let numbers = self.numbers(name)?.into_iter();
        numbers
            .map(|number| {
                let LogRecord { manifest: hash, created_us, commit, parent, kind } =
                    self.record(name, number)?;
                Ok(LogEntry { number, hash, created_us, commit, parent, kind })
            })
            .collect()
    }

    /// Makes an old version the latest, under a new number: nothing of what came since is lost. The
    /// latest itself stays what it is, and is returned.
    ///
    /// # Errors
    /// As [`Catalog::version`]; the version can still be read in full, or it is not restored. What
    /// could not be written leaves nothing behind, except for [`StoreError::NotSynced`].
    pub fn rollback(&self, name: &str, number: u64) -> Result<Version, StoreError> {
        // Before anything is written for what cannot be; restoring it looks again, and closer.
        self.version(name, Some(number))?;
        self.begin(name, CommitKind::Rollback, StorageOptions::default())?.restore(number)
    }
}

/// Microseconds since 1970.
pub(super) fn now_us() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_micros()).unwrap_or(i64::MAX)
}
