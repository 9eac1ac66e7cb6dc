//! What a run says while it works.

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use wildcity_train::run::Line;

/// The file of `--lines`.
pub(super) struct LinesFile {
    path: PathBuf,
    file: fs::File,
}

impl LinesFile {
    /// Begins the file anew, or goes on at its end.
    pub(super) fn open(path: &Path, goes_on: bool) -> anyhow::Result<Self> {
        let cannot = || format!("cannot write {}", path.display());
        let mut options = OpenOptions::new();
        options.create(true).write(true).append(goes_on).truncate(!goes_on);
        Ok(Self { path: path.to_owned(), file: options.open(path).with_context(cannot)? })
    }

    pub(super) fn write(&mut self, line: &Line) -> anyhow::Result<()> {
        let text = serde_json::to_string(line)?;
        let cannot = || format!("cannot write {}", self.path.display());
        writeln!(self.file, "{text}").with_context(cannot)
    }
}

/// A line for a log, which has no bar.
pub(super) fn log(line: &Line) -> io::Result<()> {
    let Line { step, l1, gaussians, seconds, .. } = line;
    let db = line.held_out_db.map_or(String::new(), |db| format!(", {db:.2} dB"));
    writeln!(io::stderr(), "step {step}: l1 {l1:.4}, {gaussians} Gaussians, {seconds:.0} s{db}")
}
