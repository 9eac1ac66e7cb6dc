//! A server as a process of its own, with a twin of its own.

use std::ffi::OsStr;
use std::fs;
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::json;

use crate::support::{self, Agent};

/// `wildcity serve` as a separate process.
pub(crate) struct Served {
    child: Child,
    pub(crate) address: SocketAddr,
    dir: tempfile::TempDir,
    pub(crate) episodes: tempfile::TempDir,
}

impl Served {
    pub(crate) fn start() -> Self {
        Self::with(&[])
    }

    /// Starts a server with more arguments.
    pub(crate) fn with(arguments: &[&str]) -> Self {
        let twins = support::twins();
        let at = twins.path().as_os_str().to_owned();
        Self::at(&at, twins, |command| command.args(arguments))
    }

    /// Starts a server with twins at a directory or URL, and its uploads in `dir`.
    pub(crate) fn at(
        twins: &OsStr,
        dir: tempfile::TempDir,
        change: impl FnOnce(&mut Command) -> &mut Command,
    ) -> Self {
        Self::logging("warn", twins, dir, change)
    }

    /// As [`Served::at`], with a filter for its log.
    pub(crate) fn logging(
        filter: &str,
        twins: &OsStr,
        dir: tempfile::TempDir,
        change: impl FnOnce(&mut Command) -> &mut Command,
    ) -> Self {
        let episodes = tempfile::tempdir().unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--threads", "1", "--log", filter]);
        let mut child = change(&mut command)
            .arg("--twins")
            .arg(twins)
            .arg("--episodes")
            .arg(episodes.path())
            .arg("--uploads")
            .arg(dir.path().join(".uploads"))
            .arg("--scenarios")
            .arg(dir.path().join(".scenarios"))
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let address = line
            .strip_prefix("listening on ws://")
            .and_then(|rest| rest.trim_end().strip_suffix("/v1/session"));
        let address = address.expect(&line).parse().unwrap();
        Self { child, address, dir, episodes }
    }

    fn proc(&self, file: &str) -> PathBuf {
        Path::new("/proc").join(self.child.id().to_string()).join(file)
    }

    fn memory(&self, field: &str) -> u64 {
        let status = fs::read_to_string(self.proc("status")).unwrap();
        let line = status.lines().find(|line| line.starts_with(field)).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() << 10
    }

    /// Resident memory, in bytes.
    pub(crate) fn rss(&self) -> u64 {
        self.memory("VmRSS:")
    }

    /// The most resident memory since [`Self::forget_peak`], in bytes.
    pub(crate) fn peak(&self) -> u64 {
        self.memory("VmHWM:")
    }

    /// Lets the peak begin at the memory of now (`proc_pid_clear_refs(5)`).
    pub(crate) fn forget_peak(&self) {
        fs::write(self.proc("clear_refs"), "5").unwrap();
    }

    /// The directory of its twins, uploads and scenarios.
    pub(crate) fn dir(&self) -> &Path {
        self.dir.path()
    }

    /// Bytes of all files of its twins, uploads, scenarios and records.
    pub(crate) fn disk_bytes(&self) -> u64 {
        bytes_below(self.dir()) + bytes_below(self.episodes.path())
    }

    /// Processor time since the start, in seconds.
    pub(crate) fn processor_s(&self) -> f64 {
        let stat = fs::read_to_string(self.proc("stat")).unwrap();
        let fields = stat[stat.rfind(')').unwrap()..].split_whitespace().skip(12).take(2);
        fields.map(|ticks| ticks.parse::<f64>().unwrap() / 100.0).sum()
    }

    pub(crate) async fn whole_session(&self, steps: u32) {
        let mut agent = Agent::connect(self.address).await;
        agent.hello().await;
        agent.open(json!({})).await;
        for step in 0..steps {
            agent.step(f64::from(step)).await;
        }
        agent.ask(json!({ "type": "close" })).await;
    }

    /// Sends SIGHUP.
    pub(crate) fn hang_up(&self) {
        let kill = Command::new("kill").arg("-HUP").arg(self.child.id().to_string()).status();
        assert!(kill.unwrap().success());
    }

    pub(crate) fn signal_and_wait(mut self) -> Option<i32> {
        let kill = Command::new("kill").arg(self.child.id().to_string()).status().unwrap();
        assert!(kill.success());
        let deadline = Instant::now() + Duration::from_secs(20);
        loop {
            match self.child.try_wait().unwrap() {
                Some(status) => return status.code(),
                None if Instant::now() > deadline => return None,
                None => std::thread::sleep(Duration::from_millis(10)),
            }
        }
    }
}

fn bytes_below(dir: &Path) -> u64 {
    let Ok(entries) = fs::read_dir(dir) else { return 0 };
    let bytes = |entry: fs::DirEntry| match entry.metadata() {
        Ok(metadata) if metadata.is_dir() => bytes_below(&entry.path()),
        Ok(metadata) => metadata.len(),
        // It was removed meanwhile.
        Err(_) => 0,
    };
    entries.flatten().map(bytes).sum()
}

impl Drop for Served {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
