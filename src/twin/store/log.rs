//! A twin's log: for each version the hash of its manifest, the time of its commit, and how it was
//! made.

use serde::{Deserialize, Serialize};

/// One entry of a twin's log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogEntry {
    /// The version's number, from 1.
    pub number: u64,
    /// Hash of its manifest, 64 lower-case hex digits.
    pub hash: String,
    /// When it was committed, in microseconds since 1970.
    pub created_us: i64,
    /// Identity of the commit that made it; `None` for versions from before commits had one.
    pub commit: Option<String>,
    /// The version that it was made from: the base of a push or an edit, or the version that a
    /// rollback restored.
    pub parent: Option<u64>,
    /// How it was made.
    pub kind: CommitKind,
}

impl LogEntry {
    /// Whether it is an edit of another version, such as an alignment. An import of files has no
    /// parent.
    pub fn is_edit(&self) -> bool {
        self.kind == CommitKind::Import && self.parent.is_some()
    }

    /// The name of how it was made: `import`, `edit`, `push` or `rollback`.
    pub fn kind_name(&self) -> &'static str {
        match self.kind {
            // First, because an edit is stored as an import with a parent.
            _ if self.is_edit() => "edit",
            CommitKind::Import => "import",
            CommitKind::Push => "push",
            CommitKind::Rollback => "rollback",
        }
    }
}

/// How a version was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CommitKind {
    /// By an import of a whole scene, or by an edit.
    #[default]
    Import,
    /// By a push to a server.
    Push,
    /// By restoring an old version.
    Rollback,
}

/// A record of the log, stored as JSON. How a version was made is stored here and not in the
/// manifest, so that the hash of a manifest depends only on the content of the version.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LogRecord {
    pub(super) manifest: String,
    pub(super) created_us: i64,
    // Versions from before commits had an identity lack it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) commit: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) parent: Option<u64>,
    #[serde(default)]
    pub(super) kind: CommitKind,
}
