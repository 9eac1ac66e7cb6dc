//! `[limits]`: time-outs, counts and bytes of a server.

use std::time::Duration;

use clap::builder::RangedU64ValueParser;

use wildcity_episode::Keep;
use wildcity_server::{Limits, SpoolLimits};
use wildcity_session::RecordLimits;

use crate::cli::backend_options::{bytes_of_gib, gib};

/// Heading of these options in `--help`; in a configuration file they are the table `[limits]`.
pub(super) const HEADING: &str = "Limits";

/// Largest number of sessions, connections, pushes or uploads that an option accepts.
const MAX_COUNT: u64 = 65_535;

/// Longest time-out that an option accepts: 30 days.
const MAX_TIMEOUT_S: f64 = 30.0 * 24.0 * 3600.0;

/// Longest time that records can be kept for: 100 years.
const MAX_DAYS: f64 = 36_525.0;
const SECONDS_PER_DAY: f64 = 86_400.0;

fn count() -> RangedU64ValueParser<usize> {
    RangedU64ValueParser::new().range(1..=MAX_COUNT)
}

/// Time-outs, counts and bytes of a server.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = HEADING)]
pub(super) struct LimitOptions {
    /// Largest number of sessions at a time, connected or waiting to be resumed.
    #[arg(long, value_name = "N", default_value_t = Limits::default().sessions, value_parser = count())]
    sessions: usize,

    /// Largest number of WebSocket connections at a time; 64 more connections are accepted for HTTP
    /// requests only.
    #[arg(long, hide = true, value_name = "N", default_value_t = Limits::default().connections, value_parser = count())]
    connections: usize,

    /// Largest number of pushes that wait or run at a time.
    #[arg(long, hide = true, value_name = "N", default_value_t = Limits::default().pushes, value_parser = count())]
    pushes: usize,

    /// Memory that running pushes may take together, in GiB [default: a third of --memory-gib]. A
    /// push waits until the memory that it may need is free: 24 times the size of its files, plus
    /// 0.25 GiB.
    #[arg(long, hide = true, value_name = "GIB", value_parser = gib)]
    push_memory_gib: Option<f64>,

    /// Seconds that reading and checking one push may take.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = Limits::default().push.as_secs_f64(), value_parser = seconds)]
    push_timeout_s: f64,

    /// Seconds within which a new connection must send its first message.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = Limits::default().hello.as_secs_f64(), value_parser = seconds)]
    hello_timeout_s: f64,

    /// Seconds that a connection may be silent between requests.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = Limits::default().idle.as_secs_f64(), value_parser = seconds)]
    idle_timeout_s: f64,

    /// Seconds within which a client must read an answer; at most 30, because clients wait for an
    /// answer for 90 s, of which a step may take 60.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = Limits::default().send.as_secs_f64(), value_parser = send_seconds)]
    send_timeout_s: f64,

    /// Seconds for one step, including the time that it waits for other sessions; at most 60,
    /// because clients wait for an answer for 90 s.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = Limits::default().step.as_secs_f64(), value_parser = step_seconds)]
    step_timeout_s: f64,

    /// Seconds that a session without a connection waits to be resumed.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = Limits::default().resume_grace.as_secs_f64(), value_parser = seconds)]
    resume_grace_s: f64,

    /// Seconds that sessions may go on after SIGTERM; until then the server opens no new one and is
    /// not ready. A second SIGTERM stops it at once.
    #[arg(long, value_name = "SECONDS", default_value_t = Limits::default().sessions_end.as_secs_f64(), value_parser = waiting_seconds)]
    sessions_end_s: f64,

    /// Seconds that running steps may take to finish when the server stops.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = Limits::default().drain.as_secs_f64(), value_parser = seconds)]
    drain_timeout_s: f64,

    /// Seconds between two returns of free memory to the system, while Gaussians are evicted or
    /// pushes run.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = Limits::default().memory_release.as_secs_f64(), value_parser = seconds)]
    memory_release_s: f64,

    /// Largest number of uploads that are kept at a time, finished or not.
    #[arg(long, hide = true, value_name = "N", default_value_t = SpoolLimits::default().uploads, value_parser = count())]
    max_uploads: usize,

    /// Largest size of an upload, in GiB.
    #[arg(long, hide = true, value_name = "GIB", default_value_t = bytes_as_gib(SpoolLimits::default().upload_bytes), value_parser = gib)]
    upload_gib: f64,

    /// Largest total size of all uploads, in GiB.
    #[arg(long, hide = true, value_name = "GIB", default_value_t = bytes_as_gib(SpoolLimits::default().bytes), value_parser = gib)]
    spool_gib: f64,

    /// Largest total size of the uploads of one token, in GiB [default: half of --spool-gib if
    /// several tokens may upload, else all]
    #[arg(long, hide = true, value_name = "GIB", value_parser = gib)]
    token_spool_gib: Option<f64>,

    /// Seconds that an upload is kept after its last byte.
    #[arg(long, hide = true, value_name = "SECONDS", default_value_t = SpoolLimits::default().age.as_secs_f64(), value_parser = seconds)]
    upload_age_s: f64,

    /// Largest total size of all records, in GiB.
    #[arg(long, hide = true, value_name = "GIB", default_value_t = bytes_as_gib(Limits::default().records.bytes), value_parser = gib)]
    records_gib: f64,

    /// Largest total size of the records of one token, in GiB.
    #[arg(long, hide = true, value_name = "GIB", default_value_t = bytes_as_gib(Limits::default().records.owner_bytes), value_parser = gib)]
    token_records_gib: f64,

    /// Number of records to keep: the newest ones; older ones are removed [default: all]. An
    /// episode that is driven, or ended within the last minute, keeps its record.
    #[arg(long, hide = true, value_name = "N", value_parser = count())]
    keep_records: Option<usize>,

    /// Days that a record is kept after its last line [default: for ever]
    #[arg(long, hide = true, value_name = "DAYS", value_parser = days)]
    keep_records_days: Option<f64>,

    /// Size of all records to keep, with their MCAP files, in GiB: the oldest ones beyond it are
    /// removed [default: any size]. Below --records-gib, so that no episode is refused.
    #[arg(long, hide = true, value_name = "GIB", value_parser = gib)]
    keep_records_gib: Option<f64>,
}

impl LimitOptions {
    /// The limits of a server. Its twins may take `resident_bytes` of memory.
    pub(super) fn limits(&self, resident_bytes: Option<u64>) -> Limits {
        let seconds = Duration::from_secs_f64;
        Limits {
            hello: seconds(self.hello_timeout_s),
            idle: seconds(self.idle_timeout_s),
            send: seconds(self.send_timeout_s),
            step: seconds(self.step_timeout_s),
            resume_grace: seconds(self.resume_grace_s),
            sessions_end: seconds(self.sessions_end_s),
            drain: seconds(self.drain_timeout_s),
            connections: self.connections,
            sessions: self.sessions,
            pushes: self.pushes,
            push_memory_bytes: self.push_memory_gib.map(bytes_of_gib),
            push: seconds(self.push_timeout_s),
            resident_bytes,
            memory_release: seconds(self.memory_release_s),
            spool: SpoolLimits {
                uploads: self.max_uploads,
                upload_bytes: bytes_of_gib(self.upload_gib),
                bytes: bytes_of_gib(self.spool_gib),
                token_bytes: self.token_spool_gib.map(bytes_of_gib),
                age: seconds(self.upload_age_s),
            },
            records: RecordLimits {
                bytes: bytes_of_gib(self.records_gib),
                owner_bytes: bytes_of_gib(self.token_records_gib),
            },
            keep_records: Keep {
                records: self.keep_records,
                age: self.keep_records_days.map(|days| seconds(days * SECONDS_PER_DAY)),
                bytes: self.keep_records_gib.map(bytes_of_gib),
            },
        }
    }
}

/// Converts bytes to GiB.
pub(super) fn bytes_as_gib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 30)
}

fn days(text: &str) -> Result<f64, String> {
    match text.parse() {
        // NaN fails both comparisons; beyond the limit `Duration::from_secs_f64` could panic.
        Ok(days) if days > 0.0 && days <= MAX_DAYS => Ok(days),
        _ => Err(format!("expected days above 0 and up to {MAX_DAYS}")),
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    seconds_up_to(text, MAX_TIMEOUT_S)
}

/// Seconds, or 0 for no wait.
fn waiting_seconds(text: &str) -> Result<f64, String> {
    // 0 means not to wait at all, which other time-outs do not accept.
    if text.parse() == Ok(0.0) { Ok(0.0) } else { seconds(text) }
}

fn send_seconds(text: &str) -> Result<f64, String> {
    seconds_up_to(text, wildcity_protocol::limits::SEND_TIMEOUT.as_secs_f64())
}

fn step_seconds(text: &str) -> Result<f64, String> {
    seconds_up_to(text, wildcity_protocol::limits::STEP_TIMEOUT.as_secs_f64())
}

fn seconds_up_to(text: &str, most: f64) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds) if seconds >= 0.001 && seconds <= most => Ok(seconds),
        _ => Err(format!("expected seconds, from 0.001 to {most}")),
    }
}
