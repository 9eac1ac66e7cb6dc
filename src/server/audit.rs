//! The audit log: which token made which version of a twin or which asset of an actor, one JSON
//! object per line.
//!
//! A line is on disk before a change begins, and another one after it has ended. A change that
//! cannot be logged is refused. At [`limits::AUDIT_BYTES`] the file is renamed to FILE.1, an older
//! FILE.1 to FILE.2 and so on, and a new file begins; if that fails, the log gives the reason and
//! continues in the same file. A line has a bounded length: names are checked before, and reasons
//! are cut.

use std::fmt::Display;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use parking_lot::Mutex;
use serde::Serialize;

use crate::auth::Grant;
use crate::blocking::blocking;
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
pub(crate) struct Change {
    /// `push`, `cancel`, `edit`, `rollback` or `actor`.
    pub(crate) what: &'static str,
    /// Object that is changed.
    pub(crate) target: Target,
    /// Id of the push.
    pub(crate) id: Option<String>,
}

/// Kind of object that a change concerns.
#[derive(Clone, Debug)]
pub(crate) enum Target {
    /// The twin of this name.
    Twin(String),
    /// The asset of this name.
    Actor(String),
}

/// Result of a change.
#[derive(Clone, Debug)]
pub(crate) enum Made {
    /// A version of this number.
    Version(u64),
    /// An asset of this hash.
    Asset(String),
    /// Neither: a push was cancelled.
    Nothing,
}

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

    /// Logs the start of a change, on a thread that may wait for the disk.
    ///
    /// # Errors
    /// [`Fault::Audit`]: the change must not begin.
    pub(crate) async fn begin(
        self: &Arc<Self>,
        grant: &Arc<Grant>,
        change: &Change,
    ) -> Result<(), Fault> {
        // Without a log, no thread and no copies are needed.
        if self.0.is_none() {
            return Ok(());
        }
        let shared = (self.clone(), grant.clone(), change.clone());
        blocking(move || {
            let (log, grant, change) = shared;
            log.begin_now(&grant, &change)
        })
        .await
    }

    /// Logs the result of a change, or why it failed, on a thread that may wait for the disk.
    pub(crate) async fn end(
        self: &Arc<Self>,
        grant: &Arc<Grant>,
        change: &Change,
        ended: Result<Made, impl Display>,
    ) {
        if self.0.is_none() {
            return;
        }
        let ended = ended.map_err(|reason| reason.to_string());
        let shared = (self.clone(), grant.clone(), change.clone());
        let written = blocking(move || {
            let (log, grant, change) = shared;
            log.end_now(&grant, &change, ended);
            Ok::<_, Fault>(())
        });
        if let Err(fault) = written.await {
            tracing::error!("{fault}");
        }
    }

    /// Logs the start of a change, and waits for the disk.
    ///
    /// # Errors
    /// [`Fault::Audit`]: the change must not begin.
    pub(crate) fn begin_now(&self, grant: &Grant, change: &Change) -> Result<(), Fault> {
        self.write(grant, change, None)
    }

    /// Logs the result of a change, or why it failed, and waits for the disk. The change has
    /// already happened, so a line that cannot be written is only an error in the server's log.
    pub(crate) fn end_now(
        &self,
        grant: &Grant,
        change: &Change,
        ended: Result<Made, impl Display>,
    ) {
        // Cut between characters: a byte index could be within one.
        let reason = |reason: String| match reason.char_indices().nth(limits::AUDIT_REASON_CHARS) {
            Some((at, _)) => format!("{} ..", &reason[..at]),
            None => reason,
        };
        let ended = ended.map_err(|error| reason(error.to_string()));
        if let Err(fault) = self.write(grant, change, Some(ended)) {
            tracing::error!(target = ?change.target, "{fault}");
        }
    }

    fn write(
        &self,
        grant: &Grant,
        change: &Change,
        ended: Option<Result<Made, String>>,
    ) -> Result<(), Fault> {
        let Some(log) = &self.0 else { return Ok(()) };
        // A clock before 1970 gives 0, because a wrong time is no reason to refuse a change.
        // Microseconds fill a u64 after 584,000 years.
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let Change { what, target, id } = change;
        let (twin, actor) = match target {
            Target::Twin(name) => (Some(&**name), None),
            Target::Actor(name) => (None, Some(&**name)),
        };
        let begun = Line {
            time_us: since_1970.as_micros() as u64,
            token: &grant.name,
            what,
            twin,
            actor,
            id: id.as_deref(),
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
            Some(Ok(Made::Asset(hash))) => Line { state: "done", hash: Some(hash), ..begun },
            Some(Ok(Made::Nothing)) => Line { state: "done", ..begun },
            Some(Err(reason)) => Line { state: "refused", reason: Some(reason), ..begun },
        };
        // The line is made before the lock is taken, which is held for the disk alone.
        let mut text = serde_json::to_vec(&line).map_err(|e| Fault::Internal(e.to_string()))?;
        text.push(b'\n');
        let mut log = log.lock();
        let path = log.path.clone();
        log.append(&text).map_err(|cause| Fault::Audit { path, cause })
    }
}

impl Log {
    fn open(path: &Path, limit_bytes: u64) -> io::Result<Self> {
        // In append mode the kernel puts each write at the end, also if another program has
        // written.
        let file = OpenOptions::new().create(true).append(true).open(path)?;
        let bytes = file.metadata()?.len();
        sync_name(path);
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
        // A line that is longer than the limit alone still goes into an empty file.
        if self.bytes > 0 && self.bytes + line.len() as u64 > self.limit_bytes {
            self.rotate();
        }
        // `sync_data` also syncs the length of the file, without which the line could not be read
        // again.
        let written = self.file.write_all(line).and_then(|()| self.file.sync_data());
        match written {
            Ok(()) => self.bytes += line.len() as u64,
            // A part of the line may have been written, so start the next one on a new line.
            Err(_) => drop(self.file.write_all(b"\n")),
        }
        written
    }

    /// Begins a new file, and keeps [`limits::AUDIT_OLD_FILES`] old ones.
    fn rotate(&mut self) {
        let old = |number: usize| match number {
            0 => self.path.clone(),
            _ => {
                let mut path = self.path.clone().into_os_string();
                path.push(format!(".{number}"));
                PathBuf::from(path)
            }
        };
        let begin = || {
            // The file is gone if it was moved away, or if the last rotation failed after its
            // renames: then the old files stay where they are, and only a new one begins.
            let kept = if self.path.try_exists()? { limits::AUDIT_OLD_FILES } else { 0 };
            // Rename the oldest file first, because a rename replaces the target.
            for number in (0..kept).rev() {
                match fs::rename(old(number), old(number + 1)) {
                    Err(error) if number > 0 && error.kind() == io::ErrorKind::NotFound => {}
                    renamed => renamed?,
                }
            }
            OpenOptions::new().create(true).append(true).open(&self.path)
        };
        match begin() {
            Ok(file) => {
                self.file = file;
                self.bytes = 0;
                sync_name(&self.path);
            }
            Err(error) => {
                tracing::error!("the audit log is not rotated: {}: {error}", self.path.display());
            }
        }
    }
}

/// Makes the name of a file durable, as its lines are: otherwise a power cut takes both. Not all
/// file systems can.
fn sync_name(path: &Path) {
    let dir = path.parent().filter(|dir| !dir.as_os_str().is_empty());
    let _ = File::open(dir.unwrap_or(Path::new("."))).and_then(|dir| dir.sync_all());
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change() -> Change {
        let target = Target::Twin("street".to_owned());
        Change { what: "push", target, id: Some("p1".to_owned()) }
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
        // The second turn opens the file of the first, as a restart does: 3 lines each.
        for _ in 0..2 {
            let audit = Audit::open(Some(&path)).unwrap();
            audit.begin_now(&grant, &change()).unwrap();
            audit.end_now(&grant, &change(), Ok::<_, &str>(Made::Version(3)));
            audit.end_now(&grant, &change(), Err("too sparse"));
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
        // The cut line has 5 bytes and its end 1, and the first line 13: 19 of 40. The next line
        // has 31.
        let mut log = Log::open(&path, 40).unwrap();
        log.append(b"{\"first\": 1}\n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "{\"cut\n{\"first\": 1}\n");
        log.append(b"{\"second, too long for it\": 2}\n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "{\"second, too long for it\": 2}\n");
        let old = dir.path().join("audit.jsonl.1");
        assert_eq!(fs::read_to_string(&old).unwrap(), "{\"cut\n{\"first\": 1}\n");
        // If an old file cannot be replaced, the log continues in the same file.
        fs::write(dir.path().join("audit.jsonl.7"), "old").unwrap();
        fs::create_dir_all(dir.path().join("audit.jsonl.8/taken")).unwrap();
        log.append(b"{\"third, too long for it\": 3}\n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap().lines().count(), 2);
    }

    #[test]
    fn several_old_files_are_kept_and_a_long_reason_is_cut() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("audit.jsonl");
        let mut log = Log::open(&path, 40).unwrap();
        // Each line has 33 bytes, so that each gets its own file. With 8 old files and 11 lines,
        // numbers 0 and 1 are gone.
        let last = limits::AUDIT_OLD_FILES + 2;
        for number in 0..=last {
            log.append(format!("{{\"line, too long for two\": {number:4}}}\n").as_bytes()).unwrap();
        }
        for (name, number) in
            [("audit.jsonl", last), ("audit.jsonl.1", last - 1), ("audit.jsonl.8", 2)]
        {
            let text = fs::read_to_string(dir.path().join(name)).unwrap();
            assert!(text.ends_with(&format!("{number:4}}}\n")), "{name}: {text}");
        }
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1 + limits::AUDIT_OLD_FILES);

        let audit = Audit::open(Some(&dir.path().join("long.jsonl"))).unwrap();
        audit.end_now(&Grant::everything(), &change(), Err("é".repeat(60_000)));
        let reason =
            lines(&dir.path().join("long.jsonl"))[0]["reason"].as_str().unwrap().to_owned();
        // Three characters say that the reason was cut.
        assert_eq!(reason.chars().count(), limits::AUDIT_REASON_CHARS + 3);
    }

    #[test]
    fn a_log_that_cannot_be_written_refuses_what_would_begin() {
        let full = Path::new("/dev/full");
        assert!(full.exists(), "this test needs /dev/full");
        let file = OpenOptions::new().append(true).open(full).unwrap();
        let log = Log { path: full.to_owned(), file, bytes: 0, limit_bytes: 1 << 20 };
        let audit = Audit(Some(Mutex::new(log)));
        let refused = audit.begin_now(&Grant::everything(), &change()).unwrap_err();
        assert!(matches!(refused, Fault::Audit { .. }), "{refused}");
        assert!(Audit::open(None).unwrap().begin_now(&Grant::everything(), &change()).is_ok());
        assert!(Audit::open(Some(Path::new("/nowhere/audit.jsonl"))).is_err());
    }
}
