//! `wildcity doctor`.

use std::fs;
use std::io::Write;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::thread::available_parallelism;
use std::time::SystemTime;

use serde_json::json;

#[cfg(feature = "gpu")]
use wildcity_render::gpu::devices;
use wildcity_twin::residency::default_memory_bytes;
use wildcity_twin::store::StoreError;

use super::directories::{Episodes, Twins, Uploads};
use super::exit::{self, Exit};
use super::serve::Serve;
use crate::cli::output;

/// Check that this machine can run the server: devices, memory, open files, disks, twins, clock.
///
/// Prints one line for each check. A line that starts with `bad` says what to do; then the exit
/// code is 1. `note` is for information only. Nothing is changed: the check whether a directory can
/// be written creates an unnamed file in it and removes it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Doctor {
    /// TOML file of `wildcity serve --config`: also check its address, tokens, certificate, audit
    /// log and scenarios.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["twins", "episodes", "uploads"])]
    config: Option<PathBuf>,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    episodes: Episodes,

    #[command(flatten)]
    uploads: Uploads,

    /// Print one JSON array on standard output.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity doctor
  wildcity doctor --config /etc/wildcity/wildcity.toml
  wildcity doctor --twins s3://city/twins";

/// Memory below which a city of a few blocks does not fit.
const LITTLE_MEMORY_BYTES: u64 = 2 << 30;
/// Free space below which a push or a day of records may fail.
const LITTLE_DISK_BYTES: u64 = 5 << 30;
/// Open files of a full server: 1,024 connections, 512 unauthenticated ones, and the files that it
/// reads.
const FILES: u64 = 4096;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Level {
    Good,
    Note,
    Bad,
}

/// The result of one check.
#[derive(Debug)]
struct Finding {
    level: Level,
    about: &'static str,
    text: String,
}

impl Finding {
    fn new(level: Level, about: &'static str, text: String) -> Self {
        Self { level, about, text }
    }
}

impl Level {
    fn name(self) -> &'static str {
        match self {
            Self::Good => "ok",
            Self::Note => "note",
            Self::Bad => "bad",
        }
    }
}

impl Doctor {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let serve = self.config.as_deref().map(Serve::from_file).transpose()?;
        let (twins, episodes, uploads) = match serve.as_ref().map(Serve::directories) {
            Some(all) => (&all.twins, &all.episodes, &all.uploads),
            None => (&self.twins, &self.episodes, &self.uploads),
        };
        let mut findings = vec![devices_found(), processors(), memory(), open_files(), clock()];
        match &serve {
            Some(serve) => {
                findings.extend(serve.checks().into_iter().map(|(about, found)| {
                    let level = if found.is_ok() { Level::Good } else { Level::Bad };
                    Finding::new(level, about, found.unwrap_or_else(|wrong| wrong))
                }));
                findings.extend(serve.tokens_file().and_then(readable_by_others));
            }
            None => findings.push(port()),
        }
        let directories = [("episodes", episodes.dir()?), ("uploads", uploads.dir()?)];
        findings.extend(in_use(&directories[1].1));
        findings.extend(directories.map(|(about, dir)| disk(about, &dir)));
        findings.extend(twins_found(twins));
        let mut out = output::stdout();
        if self.json {
            let of = |Finding { level, about, text }: &Finding| json!({ "level": level.name(), "about": about, "text": text });
            writeln!(out, "{}", json!(findings.iter().map(of).collect::<Vec<_>>()))?;
        } else {
            for Finding { level, about, text } in &findings {
                writeln!(out, "{:<5}{about:<12}{text}", level.name())?;
            }
        }
        let bad = findings.iter().filter(|finding| finding.level == Level::Bad).count();
        if bad > 0 {
            let message = format!("{bad} of {} checks failed", findings.len());
            return Err(Exit::error(1, message).into());
        }
        Ok(())
    }
}

/// The directory or the object store of the twins, and the twins.
fn twins_found(twins: &Twins) -> Vec<Finding> {
    let bad = |text: String| vec![Finding::new(Level::Bad, "twins", text)];
    let dir = match twins.dir() {
        Ok(dir) => dir,
        Err(error) => return bad(exit::chain(&error)),
    };
    // An object store has no disk here.
    let is_remote = dir.to_string_lossy().contains("://");
    let mut findings = if is_remote { Vec::new() } else { vec![disk("twins", &dir)] };
    let begun = std::time::Instant::now();
    let listed = twins.catalog().and_then(|catalog| {
        let twins = catalog.twins()?;
        Ok((twins, catalog.actors()?))
    });
    match listed {
        Ok((list, actors)) => {
            let text = format!(
                "{} in {}, listed in {} ms",
                output::counted(list.twins.len(), "twin"),
                dir.display(),
                begun.elapsed().as_millis()
            );
            let level = if list.twins.is_empty() { Level::Note } else { Level::Good };
            findings.push(Finding::new(level, "twins", text));
            for damaged in list.damaged {
                let text = format!(
                    "{} is damaged: {}; wildcity twin fsck {} says more",
                    damaged.name, damaged.error, damaged.name
                );
                findings.push(Finding::new(Level::Bad, "twins", text));
            }
            for damaged in actors.damaged {
                let text = StoreError::from(damaged).to_string();
                findings.push(Finding::new(Level::Bad, "actors", text));
            }
        }
        Err(error) => findings.extend(bad(format!("{}: {}", dir.display(), exit::chain(&error)))),
    }
    findings
}

#[cfg(not(feature = "gpu"))]
fn devices_found() -> Finding {
    Finding::new(Level::Note, "gpu", super::left_out::built_without("gpu"))
}

#[cfg(feature = "gpu")]
fn devices_found() -> Finding {
    let devices = devices();
    match devices.iter().find(|device| device.kind != "cpu") {
        Some(device) => {
            let text = format!("{} ({}), driver {}", device.name, device.kind, device.driver);
            Finding::new(Level::Good, "gpu", text)
        }
        None => {
            let found = if devices.is_empty() { "no GPU" } else { "no GPU, except software" };
            let text = format!(
                "{found}: the server renders on the CPU. For a GPU install its driver with Vulkan, and in a \
                 container NVIDIA_DRIVER_CAPABILITIES=graphics"
            );
            Finding::new(Level::Note, "gpu", text)
        }
    }
}

fn processors() -> Finding {
    let count = available_parallelism().map_or(1, usize::from);
    Finding::new(Level::Good, "processors", format!("{count} for this process"))
}

fn memory() -> Finding {
    let bytes = default_memory_bytes();
    let text = format!("{:.1} GiB for Gaussians, unless --memory-gib says otherwise", gib(bytes));
    if bytes >= LITTLE_MEMORY_BYTES {
        Finding::new(Level::Good, "memory", text)
    } else {
        Finding::new(Level::Note, "memory", format!("{text}: enough for small twins only"))
    }
}

/// The limit of open files, as Linux gives it.
fn open_files() -> Finding {
    let limits = fs::read_to_string("/proc/self/limits").unwrap_or_default();
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files"));
    let soft = line.and_then(|line| line.split_whitespace().next());
    match soft.map(str::parse::<u64>) {
        Some(Ok(files)) if files < FILES => {
            let text = format!("at most {files}, and a full server has {FILES}: ulimit -n {FILES}");
            Finding::new(Level::Note, "open files", text)
        }
        Some(Ok(files)) => Finding::new(Level::Good, "open files", format!("at most {files}")),
        // `unlimited`, or another system.
        _ => Finding::new(Level::Good, "open files", "no limit is known".to_owned()),
    }
}

/// A clock that is behind the program's own file is wrong: tokens of object stores and certificates
/// need it.
fn clock() -> Finding {
    let built = std::env::current_exe().and_then(fs::metadata).and_then(|file| file.modified());
    // The program cannot be from the future. A clock that is ahead cannot be noticed this way.
    let behind = built.ok().and_then(|built| built.duration_since(SystemTime::now()).ok());
    match behind.filter(|behind| behind.as_secs() > 60) {
        Some(behind) => {
            let text = format!("{} s behind the file of this program: set it", behind.as_secs());
            Finding::new(Level::Bad, "clock", text)
        }
        None => {
            Finding::new(Level::Good, "clock", "not behind the file of this program".to_owned())
        }
    }
}

fn port() -> Finding {
    let address = wildcity_server::limits::LISTEN;
    match TcpListener::bind(address) {
        Ok(_) => Finding::new(Level::Good, "port", format!("{address} is free")),
        Err(error) => {
            let text = format!("{address}: {error}; a server may run already, or give --listen");
            Finding::new(Level::Note, "port", text)
        }
    }
}

/// A note if other users can read the tokens of a file.
#[cfg(unix)]
fn readable_by_others(path: &Path) -> Option<Finding> {
    use std::os::unix::fs::MetadataExt as _;
    // A file that is not there is a finding of its own.
    let mode = fs::metadata(path).ok()?.mode();
    // Any right of the group or of others.
    let is_open = mode & 0o077 != 0;
    let path = path.display();
    let text = format!(
        "{path} has mode {:o}: other users can read or change it; chmod 600 {path}",
        mode & 0o777
    );
    is_open.then(|| Finding::new(Level::Note, "tokens", text))
}

#[cfg(not(unix))]
fn readable_by_others(_: &Path) -> Option<Finding> {
    None
}

/// A note if a server uses the directory of uploads now: it holds a lock there. Its other folders
/// are most likely those of the same options.
fn in_use(uploads: &Path) -> Option<Finding> {
    let lock = fs::File::open(uploads.join("lock")).ok()?;
    // The lock is released when the file is closed, at the end of this function.
    let is_free = lock.try_lock().is_ok();
    let text = format!(
        "a server uses {} now: a second one with the same options takes no uploads; give it another --uploads and \
         --episodes",
        uploads.display()
    );
    (!is_free).then(|| Finding::new(Level::Note, "uploads", text))
}

/// Whether a directory can be written, and its free space.
fn disk(about: &'static str, dir: &Path) -> Finding {
    // It may not exist yet: then the server makes it in its nearest parent.
    let existing =
        dir.ancestors().find(|dir| dir.is_dir()).map_or(PathBuf::from("."), PathBuf::from);
    if let Err(error) = tempfile::tempfile_in(&existing) {
        let text = format!("{} cannot be written: {error}", existing.display());
        return Finding::new(Level::Bad, about, text);
    }
    match rustix::fs::statvfs(&existing) {
        Ok(disk) => {
            let free_bytes = disk.f_bavail.saturating_mul(disk.f_frsize);
            let text = format!("{}: {:.1} GiB free", dir.display(), gib(free_bytes));
            let level = if free_bytes < LITTLE_DISK_BYTES { Level::Note } else { Level::Good };
            Finding::new(level, about, text)
        }
        Err(error) => {
            let text = format!("{}: its free space is not known: {error}", dir.display());
            Finding::new(Level::Note, about, text)
        }
    }
}

fn gib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 30)
}
