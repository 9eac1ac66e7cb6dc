//! What a run says while it works.

use std::fs::{self, OpenOptions};
use std::io::{self, BufRead, BufReader, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use wildcity_train::run::Line;

/// The file of `--lines`.
pub(super) struct LinesFile {
    path: PathBuf,
    file: fs::File,
}

impl LinesFile {
    /// Begins the file anew, or goes on after the line of a step: lines after the checkpoint of a
    /// run that was killed are written again.
    pub(super) fn open(path: &Path, done: usize) -> anyhow::Result<Self> {
        let cannot = || format!("cannot write {}", path.display());
        let mut options = OpenOptions::new();
        options.create(true).write(true).read(true).truncate(done == 0);
        let mut file = options.open(path).with_context(cannot)?;
        let mut kept = 0;
        let mut lines = BufReader::new(&file);
        // A run that goes on from a checkpoint repeats the steps after it: their lines are cut off.
        for _ in 0..done {
            kept += lines.read_until(b'\n', &mut Vec::new()).with_context(cannot)? as u64;
        }
        file.set_len(kept).with_context(cannot)?;
        file.seek(SeekFrom::End(0)).with_context(cannot)?;
        Ok(Self { path: path.to_owned(), file })
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
