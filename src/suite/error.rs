//! Why a suite could not be run at all. Failures within an episode are part of the results.

use std::io;
use std::path::PathBuf;

use wildcity_server::ServerError;
use wildcity_session::{ScenarioError, SessionError};
use wildcity_sim::scenario::FileError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

/// Every kind of agent, in words.
pub const AGENTS: &str =
    "log, stand or idm, which are built in; egodriver:HOST:PORT; or a command that drives";

/// Why a suite could not be run.
#[derive(Debug, thiserror::Error)]
pub enum SuiteError {
    /// A file cannot be read or written.
    #[error("cannot {what} {}: {cause}", path.display())]
    Io {
        /// The failed operation as a verb: `read`, `write` and so on.
        what: &'static str,
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    /// A file is larger than this build reads.
    #[error("{} has {bytes} bytes; at most {limit_bytes} are read", path.display())]
    TooLarge {
        path: PathBuf,
        bytes: u64,
        /// The largest size that is read.
        limit_bytes: u64,
    },
    /// The suite, a scenario, or a file that it names is malformed, or does not fit its twin.
    #[error("{}: {cause}", path.display())]
    File { path: PathBuf, cause: FileError },
    /// A scenario does not fit its twin, or a file that it names is malformed.
    #[error("{}: {cause}", path.display())]
    Scenario { path: PathBuf, cause: ScenarioError },
    /// The warm-up or the start of a scenario is not possible in its twin.
    #[error("{}: ego.start: {cause}", path.display())]
    Start { path: PathBuf, cause: Box<SessionError> },
    /// A scenario lacks what the agent needs.
    #[error("scenario {scenario:?}: {cause}")]
    Agent { scenario: String, cause: FileError },
    /// A file is not a result of a run.
    #[error(
        "{} is no result of a run: {reason}; give the result.json of `wildcity episode run`, or its --out directory",
        path.display()
    )]
    NoResult { path: PathBuf, reason: String },
    /// The command of the agent cannot be started.
    #[error("the agent {agent:?} cannot be started: {reason}; an agent is {AGENTS}")]
    NoAgent { agent: String, reason: String },
    /// The version of a twin that a scenario was made for does not exist.
    #[error(
        "scenario {scenario:?} was made for version {wanted} of twin {twin:?}, which is not in the store: import that \
         version, or run with --latest"
    )]
    NoVersion {
        scenario: String,
        twin: String,
        /// BLAKE3 of the version's manifest.
        wanted: String,
    },
    /// Two cases have the same name.
    #[error("two episodes are named {name:?}: give the scenarios different names")]
    SameName { name: String },
    /// There are more episodes than this build runs.
    #[error("{count} episodes; at most {} are run", crate::limits::EPISODES)]
    TooMany { count: usize },
    /// The directory has episodes of another run.
    #[error("{} has episodes of another run: give another directory with --out", dir.display())]
    NotEmpty { dir: PathBuf },
    /// A twin cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A twin cannot be opened.
    #[error(transparent)]
    Twin(#[from] ResidencyError),
    /// The engine cannot be started.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The server for agents cannot be started.
    #[error(transparent)]
    Server(#[from] ServerError),
    /// A task of the run ended unexpectedly.
    #[error("an episode's task ended unexpectedly: {0}")]
    Task(String),
}
