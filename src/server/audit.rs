//! The audit log: which token made which version of a twin or which asset of an actor, one JSON object a line.
//!
//! A line is on disk before what it announces begins, and again when that ended: what cannot be logged is refused. At
//! [`limits::AUDIT_BYTES`] the file is renamed to FILE.1, in place of an older one, and a new file begins; if that
//! fails, the log says why and goes on in the same file.

use std::fmt::Display;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use parking_lot::Mutex;
use serde::Serialize;

use crate::auth::Grant;
use crate::fault::Fault;
use crate::limits;

/// The audit log of a server, if it has one.
#[derive(Debug, Default)]
pub(crate) struct Audit(Option<Mutex<Log>>);

#[derive(Debug)]
struct Log {
    path: PathBuf,
    file: File,
    bytes: u64,
    limit_bytes: u64,
}

/// A change of a twin, or of the assets of actors.
#[derive(Clone, Debug)]
pub(crate) struct Change<'a> {
    /// `push`, `edit`, `rollback` or `actor`.
    pub(crate) what: &'static str,
    /// What is changed.
    pub(crate) target: Target<'a>,
    /// Id of the push.
    pub(crate) id: Option<&'a str>,
}

/// What a change changes.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Target<'a> {
    /// The twin of this name.
    Twin(&'a str),
    /// The asset of this name.
    Actor(&'a str),
}

/// What a change made.
#[derive(Clone, Debug)]
pub(crate) enum Made<'a> {
    /// A version of this number.
    Version(u64),
    /// An asset of this hash.
    Asset(&'a str),
}

/// A line.
#[derive(Serialize)]
struct Line<'a> {
    time_us: u64,
    /// Name of the token; empty on a server without tokens.
    token: &'a str,
    what: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    twin: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    actor: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<&'a str>,
    /// `begun`, `done` or `refused`.
    state: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    version: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    hash: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<&'a str>,
}

impl Audit {
    /// Opens a log, whose lines are kept.
    pub(crate) fn open(path: Option<&Path>) -> io::Result<Self> {
        path.map(|path| Log::open(path, limits::AUDIT_BYTES).map(Mutex::new)).transpose().map(Self)
    }

    /// Writes that a change begins.
    ///
    /// # Errors
    /// [`Fault::Audit`]: the change must not begin.
    pub(crate) fn begin(&self, grant: &Grant, change: &Change<'_>) -> Result<(), Fault> {
        self.write(grant, change, None)
    }

    /// Writes what a change made, or why it made nothing. What is done is done: a line that cannot be written is an
    /// error in the server's log.
    pub(crate) fn end(
        &self,
        grant: &Grant,
        change: &Change<'_>,
        ended: Result<Made<'_>, impl Display>,
    ) {
        let ended = ended.map_err(|reason| reason.to_string());
        if let Err(fault) = self.write(grant, change, Some(ended)) {
            tracing::error!(target = ?change.target, "{fault}");
        }
    }

    fn write(
        &self,
        grant: &Grant,
        change: &Change<'_>,
        ended: Option<Result<Made<'_>, String>>,
    ) -> Result<(), Fault> {
        let Some(log) = &self.0 else { return Ok(()) };
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let Change { what, target, id } = *change;
        let (twin, actor) = match target {
            Target::Twin(name) => (Some(name), None),
            Target::Actor(name) => (None, Some(name)),
        };
        let begun = Line {
            time_us: since_1970.as_micros() as u64,
            token: &grant.name,
            what,
            twin,
            actor,
            id,
            state: "begun",
            version: None,
            hash: None,
            reason: None,
        };
        let line = match &ended {
            None => begun,
            Some(Ok(Made::Version(version))) => {
                Line { state: "done", version: Some(*version), ..begun }
            }
            Some(Ok(Made::Asset(hash))) => Line { state: "done", hash: Some(*hash), ..begun },
            Some(Err(reason)) => Line { state: "refused", reason: Some(reason), ..begun },
        };
        let mut text = serde_json::to_vec(&line).map_err(|e| Fault::Internal(e.to_string()))?;
        text.push(b'\n');
        let mut log = log.lock();
        let path = log.path.clone();
        log.append(&text).map_err(|cause| Fault::Audit { path, cause })
    }
}

impl Log {
    fn open(path: &Path, limit_bytes: u64) -> io::Result<Self> {
        let file = OpenOptions::new().create(true).append(true).open(path)?;
        let bytes = file.metadata()?.len();
        let mut log = Self { path: path.to_owned(), file, bytes, limit_bytes };
        log.end_cut_line()?;
        Ok(log)
    }

    /// A server that was killed within a line leaves a part of it: the next line must not join it.
    fn end_cut_line(&mut self) -> io::Result<()> {
        if self.bytes > 0 && fs::read(&self.path)?.last() != Some(&b'\n') {
            self.append(b"\n")?;
        }
        Ok(())
    }

    /// Appends a line, and returns when it is on disk.
    fn append(&mut self, line: &[u8]) -> io::Result<()> {
        if self.bytes > 0 && self.bytes + line.len() as u64 > self.limit_bytes {
            self.rotate();
        }
        let written = self.file.write_all(line).and_then(|()| self.file.sync_data());
        match written {
            Ok(()) => self.bytes += line.len() as u64,
            // A part of the line may be there; what follows begins on a line of its own.
            Err(_) => drop(self.file.write_all(b"\n")),
        }
        written
    }

    /// Begins a new file, and keeps one old file.
    fn rotate(&mut self) {
        let mut old = self.path.clone().into_os_string();
        old.push(".1");
        let begin = || {
            fs::rename(&self.path, &old)?;
            OpenOptions::new().create(true).append(true).open(&self.path)
        };
        match begin() {
            Ok(file) => {
                self.file = file;
                self.bytes = 0;
                // The new name must survive a power cut as well. Not all file systems can do that.
                let dir = self.path.parent().filter(|dir| !dir.as_os_str().is_empty());
                let _ = File::open(dir.unwrap_or(Path::new("."))).and_then(|dir| dir.sync_all());
            }
            Err(error) => {
                tracing::error!("the audit log is not rotated: {}: {error}", self.path.display());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change() -> Change<'static> {
        Change { what: "push", target: Target::Twin("street"), id: Some("p1") }
    }

    fn lines(path: &Path) -> Vec<serde_json::Value> {
        let text = fs::read_to_string(path).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    #[test]
    fn lines_say_who_did_what_and_survive_a_restart() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("audit.jsonl");
        let grant = Grant::everything();
        for _ in 0..2 {
            let audit = Audit::open(Some(&path)).unwrap();
            audit.begin(&grant, &change()).unwrap();
            audit.end(&grant, &change(), Ok::<_, &str>(Made::Version(3)));
            audit.end(&grant, &change(), Err("too sparse"));
        }
        let lines = lines(&path);
        assert_eq!(lines.len(), 6);
        assert_eq!((&lines[0]["state"], &lines[0]["id"]), (&"begun".into(), &"p1".into()));
        assert_eq!((&lines[1]["version"], &lines[1]["twin"]), (&3.into(), &"street".into()));
        assert_eq!(lines[2]["reason"], "too sparse");
        assert!(lines[1].get("actor").is_none() && lines[1].get("hash").is_none());
        assert!(lines[0]["time_us"].as_u64().unwrap() > 1_700_000_000_000_000);
    }

    #[test]
    fn a_full_file_is_rotated_and_a_cut_line_is_ended() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("audit.jsonl");
        fs::write(&path, "{\"cut").unwrap();
        let mut log = Log::open(&path, 40).unwrap();
        log.append(b"{\"first\": 1}\n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "{\"cut\n{\"first\": 1}\n");
        log.append(b"{\"second, too long for it\": 2}\n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "{\"second, too long for it\": 2}\n");
        let old = dir.path().join("audit.jsonl.1");
        assert_eq!(fs::read_to_string(&old).unwrap(), "{\"cut\n{\"first\": 1}\n");
        // Where the old file cannot be replaced, the log goes on in the same one.
        fs::remove_file(&old).unwrap();
        fs::create_dir_all(old.join("taken")).unwrap();
        log.append(b"{\"third, too long for it\": 3}\n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap().lines().count(), 2);
    }

    #[test]
    fn a_log_that_cannot_be_written_refuses_what_would_begin() {
        let full = Path::new("/dev/full");
        assert!(full.exists(), "this test needs /dev/full");
        let file = OpenOptions::new().append(true).open(full).unwrap();
        let log = Log { path: full.to_owned(), file, bytes: 0, limit_bytes: 1 << 20 };
        let audit = Audit(Some(Mutex::new(log)));
        let refused = audit.begin(&Grant::everything(), &change()).unwrap_err();
        assert!(matches!(refused, Fault::Audit { .. }), "{refused}");
        assert!(Audit::open(None).unwrap().begin(&Grant::everything(), &change()).is_ok());
        assert!(Audit::open(Some(Path::new("/nowhere/audit.jsonl"))).is_err());
    }
}
