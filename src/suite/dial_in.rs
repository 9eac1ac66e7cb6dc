//! Agents that are commands: each is started for one episode, dials the server, and drives.

use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use serde_json::json;
use tokio::time::{Instant, sleep};

use wildcity_episode::EpisodeFile;

use crate::case::Case;
use crate::limits;
use crate::technical::Technical;

/// A command that is started.
pub(crate) struct Dialled<'a> {
    /// The command line, for the shell.
    pub(crate) command: &'a str,
    /// Where it dials.
    pub(crate) url: &'a str,
    /// The session that it opens.
    pub(crate) session: &'a str,
    /// How long it may take.
    pub(crate) timeout: Duration,
}

/// Starts the command and waits for it and for the end of its record.
///
/// The command finds in its environment `WILDCITY_URL`, `WILDCITY_OPEN` (the fields of `open` as JSON, which it sends
/// with outputs of its own), `WILDCITY_SEED` (for `reset`) and `WILDCITY_STEPS` (after which it terminates).
pub(crate) async fn drive(
    dialled: &Dialled<'_>,
    case: &Case,
    record: &Path,
) -> Result<(), Technical> {
    let child = start(dialled, case).map_err(|error| Technical {
        kind: "agent_lost",
        message: format!("{:?} cannot be started: {error}", dialled.command),
    })?;
    let status = wait(child, dialled.timeout).await?;
    if !status.success() {
        let message = format!("{:?} ended with {status}", dialled.command);
        return Err(Technical { kind: "agent_error", message });
    }
    wait_for_end(record).await
}

fn start(dialled: &Dialled<'_>, case: &Case) -> std::io::Result<Child> {
    Command::new("sh")
        .arg("-c")
        .arg(dialled.command)
        .env("WILDCITY_URL", dialled.url)
        .env("WILDCITY_OPEN", open_json(dialled.session, case).to_string())
        .env("WILDCITY_SESSION", dialled.session)
        .env("WILDCITY_TWIN", &case.options.twin)
        .env("WILDCITY_SEED", case.seed.to_string())
        .env("WILDCITY_STEPS", case.steps.to_string())
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
}

/// The fields of the request `open` that the scenario gives.
fn open_json(session: &str, case: &Case) -> serde_json::Value {
    let options = &case.options;
    json!({
        "session": session,
        "twin": options.twin,
        "version": options.version,
        "seed": options.seed,
        "dt_us": options.dt_us,
        // With start, dynamics and warm-up.
        "scenario": case.line.scenario,
    })
}

/// Waits for a process without blocking others; kills it when its time is over.
async fn wait(mut child: Child, timeout: Duration) -> Result<ExitStatus, Technical> {
    let lost = |error: std::io::Error| Technical { kind: "agent_lost", message: error.to_string() };
    let end = Instant::now() + timeout;
    loop {
        if let Some(status) = child.try_wait().map_err(lost)? {
            return Ok(status);
        }
        if Instant::now() >= end {
            // It may have ended just now; then there is nothing to kill.
            let _ = child.kill();
            let _ = child.wait();
            let message = format!("the agent took more than {} s", timeout.as_secs());
            return Err(Technical { kind: "agent_timeout", message });
        }
        sleep(limits::AGENT_POLL).await;
    }
}

/// Waits until the server has written the end of the record, which it does when the connection is closed.
async fn wait_for_end(record: &Path) -> Result<(), Technical> {
    let end = Instant::now() + limits::CLOSE_WAIT;
    loop {
        let last = match EpisodeFile::read(record) {
            Ok(episode) if episode.end.is_some() => return Ok(()),
            Ok(_) => "the agent ended without closing its session".to_owned(),
            Err(error) => format!("the agent drove nothing: {error}"),
        };
        if Instant::now() >= end {
            return Err(Technical { kind: "agent_lost", message: last });
        }
        sleep(limits::AGENT_POLL).await;
    }
}
