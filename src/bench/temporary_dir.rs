//! A directory for the episodes that a measurement records.

use std::fs;
use std::path::{Path, PathBuf};

use wildcity::cli::output;

/// A temporary directory, which is removed at the end.
pub(super) struct TemporaryDir(PathBuf);

impl TemporaryDir {
    pub(super) fn new() -> anyhow::Result<Self> {
        let dir = std::env::temp_dir().join(format!("wildcity-bench-{}", std::process::id()));
        output::create_dir(&dir)?;
        Ok(Self(dir))
    }

    pub(super) fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TemporaryDir {
    fn drop(&mut self) {
        // If it cannot be removed, the system's cleaning of temporary files removes it.
        let _ = fs::remove_dir_all(&self.0);
    }
}
