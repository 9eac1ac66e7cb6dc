//! Metrics of this process and of its disks, with the names that Prometheus' own clients use.
//!
//! Linux gives them in `/proc/self` ([proc_pid_stat(5)], [proc_pid_status(5)]); on other systems
//! only the start time is known.
//!
//! [proc_pid_stat(5)]: https://man7.org/linux/man-pages/man5/proc_pid_stat.5.html
//! [proc_pid_status(5)]: https://man7.org/linux/man-pages/man5/proc_pid_status.5.html

use std::fs;
use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric as _};
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;

/// Ticks of the processor time in `/proc/self/stat` per second, the same on all of Linux'
/// architectures.
const TICKS_PER_S: f64 = 100.0;

/// Reads the metrics when they are asked for.
#[derive(Debug)]
pub(crate) struct Process {
    started: SystemTime,
    /// Directories that the server writes to, each with its name.
    directories: Vec<(&'static str, PathBuf)>,
}

impl Process {
    pub(crate) fn new(directories: Vec<(&'static str, PathBuf)>) -> Self {
        Self { started: SystemTime::now(), directories }
    }
}

impl Collector for Process {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        let started_s = self.started.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        let gauges = [
            ("start_time_seconds", "When the process started, since 1970", Some(started_s)),
            ("resident_memory_bytes", "Memory of the process", resident_bytes()),
            ("open_fds", "Open files", open_files()),
            ("max_fds", "Open files that the process may have", open_files_limit()),
        ];
        for (name, help, value) in gauges {
            let Some(value) = value else { continue };
            let gauge = ConstGauge::new(value);
            let name = format!("process_{name}");
            let kind = gauge.metric_type();
            gauge.encode(encoder.encode_descriptor(&name, help, None, kind)?)?;
        }
        if let Some(seconds) = processor_seconds() {
            let counter = ConstCounter::new(seconds);
            let help = "Time of the processors";
            let kind = counter.metric_type();
            let name = "process_cpu_seconds";
            counter.encode(encoder.encode_descriptor(name, help, None, kind)?)?;
        }
        let free: Vec<_> = self
            .directories
            .iter()
            .filter_map(|(name, path)| Some((*name, free_bytes(path)?)))
            .collect();
        if free.is_empty() {
            return Ok(());
        }
        let help = "Free bytes of the disk of a directory";
        let kind = ConstGauge::new(0.0).metric_type();
        let mut of_all = encoder.encode_descriptor("wildcity_disk_free_bytes", help, None, kind)?;
        for (name, bytes) in free {
            ConstGauge::new(bytes).encode(of_all.encode_family(&[("directory", name)])?)?;
        }
        Ok(())
    }
}

fn resident_bytes() -> Option<f64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(line.trim().strip_suffix(" kB")?.trim().parse::<f64>().ok()? * 1024.0)
}

/// Fields 14 and 15, `utime` and `stime`, counted after the name, which may contain spaces.
fn processor_seconds() -> Option<f64> {
    let stat = fs::read_to_string("/proc/self/stat").ok()?;
    let after_name = &stat[stat.rfind(')')? + 1..];
    let mut fields = after_name.split_whitespace().skip(11);
    let user: f64 = fields.next()?.parse().ok()?;
    let system: f64 = fields.next()?.parse().ok()?;
    Some((user + system) / TICKS_PER_S)
}

fn open_files() -> Option<f64> {
    Some(fs::read_dir("/proc/self/fd").ok()?.count() as f64)
}

fn open_files_limit() -> Option<f64> {
    let limits = fs::read_to_string("/proc/self/limits").ok()?;
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files"))?;
    line.split_whitespace().next()?.parse().ok()
}

#[cfg(target_os = "linux")]
fn free_bytes(path: &std::path::Path) -> Option<f64> {
    // A directory that does not exist yet will be made in its nearest parent.
    let existing = path.ancestors().find(|path| path.is_dir())?;
    let disk = rustix::fs::statvfs(existing).ok()?;
    Some(disk.f_bavail.saturating_mul(disk.f_frsize) as f64)
}

#[cfg(not(target_os = "linux"))]
fn free_bytes(_: &std::path::Path) -> Option<f64> {
    None
}
