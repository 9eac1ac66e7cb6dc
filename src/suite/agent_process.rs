//! External agents: a process is started for each episode, connects to the server, and drives.

use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use serde_json::json;
use tokio::time::{Instant, sleep};

use wildcity_episode::EpisodeFile;

use crate::case::Case;
use crate::limits;
use crate::process_group::ProcessGroup;
use crate::stderr::Tail;
use crate::technical::Technical;

/// An agent's process, and the episode that it is started for.
pub(crate) struct AgentProcess<'a> {
    /// Its name in results.
    pub(crate) name: &'a str,
    /// The command line, for the shell.
    pub(crate) command: &'a str,
    /// URL of the server that it connects to.
    pub(crate) url: &'a str,
    /// The session that it opens.
    pub(crate) session: &'a str,
    /// How long it may take.
    pub(crate) timeout: Duration,
}

/// Why an episode was not driven to its end.
#[derive(Debug)]
pub(crate) enum NotDriven {
    /// The shell finds no such command, or cannot run it, so that no other episode can be driven
    /// either. Holds the shell's message.
    NoCommand(String),
    /// A failure that may not occur in another attempt.
    Technical(Technical),
}

impl From<Technical> for NotDriven {
    fn from(technical: Technical) -> Self {
        Self::Technical(technical)
    }
}

/// Starts the command and waits for it and for the end of its record.
///
/// The environment of the command has `WILDCITY_URL`, `WILDCITY_OPEN` (the fields of `open` as
/// JSON, which it sends with outputs of its own), `WILDCITY_SEED` (for `reset`) and
/// `WILDCITY_STEPS` (after which it terminates).
pub(crate) async fn drive(
    process: &AgentProcess<'_>,
    case: &Case,
    record: &Path,
) -> Result<(), NotDriven> {
    let mut running = start(process, case).map_err(|error| {
        Technical::new("agent_lost", format!("the shell cannot be started: {error}"))
    })?;
    let tail = Tail::new(running.leader.stderr.take());
    let status = wait(&mut running.leader, process.timeout).await;
    // Killed before its text is awaited: a process that hangs would keep the stream open.
    drop(running);
    let stderr = tail.text().await;
    // Every failure from here on has what the agent said.
    let said = |technical: Technical| Technical { stderr: stderr.clone(), ..technical };
    let status = status.map_err(said)?;
    let Some(drove) = interpret_exit(process, status, record.exists()) else {
        let reason = if stderr.is_empty() { status.to_string() } else { stderr };
        return Err(NotDriven::NoCommand(reason));
    };
    drove.map_err(said)?;
    Ok(wait_for_end(record).await.map_err(said)?)
}

/// Interprets the exit status of an agent's process. `None` if the shell did not find the command
/// or could not run it. `has_driven`: whether a record exists, that is, whether the agent has reset
/// its session.
fn interpret_exit(
    process: &AgentProcess<'_>,
    status: ExitStatus,
    has_driven: bool,
) -> Option<Result<(), Technical>> {
    let is_no_command =
        status.code().is_some_and(|code| limits::NO_COMMAND_STATUSES.contains(&code));
    let kind = match status.code() {
        // With a record, a status of 127 is that of the agent and not of the shell.
        _ if is_no_command && !has_driven => return None,
        Some(0) if has_driven => return Some(Ok(())),
        // A success without a record means that the agent never drove.
        Some(0 | limits::LOST_STATUS) => "agent_lost",
        Some(limits::TIMEOUT_STATUS) => "agent_timeout",
        _ => "agent_error",
    };
    let name = process.name;
    let message = if has_driven {
        format!("{name:?} ended with {status}")
    } else {
        format!(
            "{name:?} ended with {status} and drove nothing: it must connect to $WILDCITY_URL, then open and reset the \
             session of $WILDCITY_OPEN"
        )
    };
    Some(Err(Technical::new(kind, message)))
}

fn start(process: &AgentProcess<'_>, case: &Case) -> std::io::Result<ProcessGroup> {
    let mut shell = Command::new("sh");
    shell
        .arg("-c")
        .arg(process.command)
        .env("WILDCITY_URL", process.url)
        .env("WILDCITY_OPEN", open_json(process.session, case).to_string())
        .env("WILDCITY_SESSION", process.session)
        .env("WILDCITY_TWIN", &case.options.twin)
        .env("WILDCITY_SEED", case.seed.to_string())
        .env("WILDCITY_STEPS", case.steps.to_string())
        // The agent has no terminal: it must not wait for input, and its output must not mix with
        // that of the run.
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    ProcessGroup::start(&mut shell)
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

/// Waits for a process until its time is over, without blocking the thread.
async fn wait(child: &mut Child, timeout: Duration) -> Result<ExitStatus, Technical> {
    let lost = |error: std::io::Error| Technical::new("agent_lost", error.to_string());
    let end = Instant::now() + timeout;
    loop {
        // Looked at before the time: a process that ended in the last moment counts.
        if let Some(status) = child.try_wait().map_err(lost)? {
            return Ok(status);
        }
        if Instant::now() >= end {
            let message = format!("the agent took more than {} s", timeout.as_secs());
            return Err(Technical::new("agent_timeout", message));
        }
        sleep(limits::AGENT_POLL).await;
    }
}

/// Waits until the server has written the end of the record, which it does when the connection is
/// closed.
async fn wait_for_end(record: &Path) -> Result<(), Technical> {
    let end = Instant::now() + limits::CLOSE_WAIT;
    loop {
        // The record may be half written while the server closes it, so that an error may pass as
        // well.
        let last = match EpisodeFile::read(record) {
            Ok(episode) if episode.end.is_some() => return Ok(()),
            Ok(_) => "the agent ended without closing its session".to_owned(),
            Err(error) => format!("the record cannot be read: {error}"),
        };
        if Instant::now() >= end {
            return Err(Technical::new("agent_lost", last));
        }
        sleep(limits::AGENT_POLL).await;
    }
}
