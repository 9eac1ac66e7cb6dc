//! Writes an episode's file.
//!
//! A line is written before its answer is sent, so that every answer is on record. If that fails,
//! for example on a full disk, the file is truncated to its last whole line and the request is
//! refused.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::Path;
use std::sync::Arc;

use wildcity_episode::{EpisodeFile, EpisodeResult};

use super::error::RecordError;
use super::format::Line;
use super::quota::RecordQuota;
use crate::episode::EpisodeSummary;

/// An episode's file, open for appending.
#[derive(Clone, Debug)]
pub(crate) struct Recorder {
    file: Arc<File>,
    path: Arc<Path>,
    account: Account,
}

/// Whose records these are, and the quota that they count in.
#[derive(Clone, Debug)]
pub(crate) struct Account {
    pub(crate) owner: Arc<str>,
    pub(crate) quota: Arc<RecordQuota>,
}

/// A newly created file, and the number in its name.
#[derive(Debug)]
pub(crate) struct NewFile {
    pub(crate) recorder: Recorder,
    pub(crate) number: u64,
}

impl Recorder {
    /// Creates a file with the first free number from `first_number` on, and writes its first
    /// lines. No file is left behind if that fails.
    pub(crate) fn create(
        dir: &Path,
        session: &str,
        first_number: u64,
        lines: &[Line],
        account: Account,
    ) -> Result<NewFile, RecordError> {
        let failed = |path: &Path, cause| RecordError { path: path.to_owned(), cause };
        fs::create_dir_all(dir).map_err(|cause| failed(dir, cause))?;
        let mut number = first_number;
        let (file, path) = loop {
            let path = dir.join(format!("{session}-{number}.jsonl"));
            // To look for a free name and to take it is one operation, so that two servers in one
            // directory never share a file.
            match OpenOptions::new().append(true).create_new(true).open(&path) {
                Ok(file) => break (file, path),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => number += 1,
                Err(cause) => return Err(failed(&path, cause)),
            }
        };
        let recorder = Self { file: Arc::new(file), path: path.into(), account };
        if let Err(error) = recorder.append(lines) {
            // The first error explains more than an error of removing the file would.
            let _ = fs::remove_file(&recorder.path);
            return Err(error);
        }
        Ok(NewFile { recorder, number })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Removes the file, which must be new.
    pub(crate) fn discard(self) {
        if let Err(error) = fs::remove_file(&self.path) {
            tracing::warn!(path = %self.path.display(), "an unused record was not removed: {error}");
        }
    }

    /// Verdict and scores of the episode so far, if it ends as its summary says; `None` if it
    /// cannot be read.
    pub(crate) fn result(&self, summary: &EpisodeSummary) -> Option<EpisodeResult> {
        // From the file itself, so that the result is the one that `wildcity episode score` gets.
        let mut episode = EpisodeFile::read(&self.path).ok()?;
        // The two packages have types of their own for an end, with the same fields in JSON.
        let end = serde_json::to_value(summary).ok()?;
        episode.end = serde_json::from_value(end).ok();
        wildcity_episode::result(&episode)
    }

    /// Appends whole lines, or nothing.
    pub(crate) fn append(&self, lines: &[Line]) -> Result<(), RecordError> {
        self.try_append(lines).map_err(|cause| RecordError { path: self.path.to_path_buf(), cause })
    }

    fn try_append(&self, lines: &[Line]) -> io::Result<()> {
        // A line of a step has some 800 bytes, and a few short lines may come before it.
        let mut text = Vec::with_capacity(2048);
        for line in lines {
            serde_json::to_writer(&mut text, line)?;
            text.push(b'\n');
        }
        let Account { owner, quota } = &self.account;
        quota.take(owner, text.len() as u64)?;
        let written = self.write(&text);
        if written.is_err() {
            quota.give_back(owner, text.len() as u64);
        }
        written
    }

    /// Writes all of a text, or nothing.
    fn write(&self, text: &[u8]) -> io::Result<()> {
        // No other process appends to the file.
        let length_before = self.file.metadata()?.len();
        let written = (&*self.file).write_all(text);
        // A part of a line may be on disk. In append mode, the next line begins at the new end.
        if written.is_err() {
            self.file.set_len(length_before)?;
        }
        written
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::episode::Outcome;

    fn end(steps: u64) -> Line {
        Line::End(EpisodeSummary {
            outcome: Outcome::Completed,
            steps,
            time_us: 0,
            distance_m: 0.0,
            least_trust: None,
        })
    }

    fn account(dir: &Path) -> Account {
        Account { owner: "".into(), quota: Arc::new(RecordQuota::new(dir.to_owned())) }
    }

    #[test]
    fn files_that_exist_are_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let first = Recorder::create(dir.path(), "a", 1, &[end(1)], account(dir.path())).unwrap();
        assert_eq!(first.number, 1);
        let second = Recorder::create(dir.path(), "a", 1, &[end(2)], account(dir.path())).unwrap();
        assert_eq!(second.number, 2);
        first.recorder.append(&[end(3)]).unwrap();
        let text = fs::read_to_string(dir.path().join("a-1.jsonl")).unwrap();
        assert_eq!(text.lines().count(), 2);
        assert!(text.ends_with('\n'));
    }

    #[test]
    fn a_directory_that_cannot_be_created_is_named() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let dir = file.path().join("episodes");
        let error = Recorder::create(&dir, "a", 1, &[end(1)], account(&dir)).unwrap_err();
        assert!(error.to_string().contains("episodes"), "{error}");
    }

    #[test]
    fn a_full_disk_refuses_the_line() {
        // This device refuses every write as a full disk does.
        let full = OpenOptions::new().append(true).open("/dev/full").unwrap();
        let path = Path::new("/dev/full").into();
        let recorder = Recorder { file: Arc::new(full), path, account: account(Path::new("/")) };
        let error = recorder.append(&[end(1)]).unwrap_err();
        assert!(error.to_string().contains("/dev/full"), "{error}");
    }
}
