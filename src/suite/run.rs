//! Drives all cases of a suite, some at once.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use wildcity_render::Backend;
use wildcity_server::{Config, Directories, Limits, Running};
use wildcity_session::{Engine, EngineSettings, Outcome, Scenarios, Session};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, DiskCacheSettings};

use crate::agent_process::{self, AgentProcess, NotDriven};
use crate::case::Case;
use crate::driver::BuiltIn;
use crate::entry::EpisodeEntry;
use crate::error::SuiteError;
use crate::finish::finish;
use crate::limits;
use crate::result::{RunHead, SuiteResult};
use crate::technical::Technical;

/// The agent of a run.
#[derive(Clone, Debug, PartialEq)]
pub enum AgentChoice {
    /// An agent that comes with the program.
    BuiltIn(BuiltIn),
    /// The command of an external agent, started once for each episode.
    Command {
        /// Its name in results.
        name: String,
        /// The command line, for the shell.
        line: String,
    },
}

impl AgentChoice {
    /// Its name in results.
    pub fn name(&self) -> &str {
        match self {
            Self::BuiltIn(agent) => agent.name(),
            Self::Command { name, .. } => name,
        }
    }
}

/// How a suite is run.
pub struct RunSettings {
    /// Name of the suite.
    pub suite: String,
    pub agent: AgentChoice,
    pub jobs: usize,
    /// How often a technical failure is tried again.
    pub retries: u32,
    /// How long a command may take for an episode.
    pub agent_timeout: Duration,
    /// Whether versions that scenarios name were ignored.
    pub latest: bool,
    /// Lower limit of the pass rate, which the lower end of its interval must reach. `None`: every
    /// episode must pass.
    pub at_least: Option<f64>,
    /// Criteria that need not be judged for a pass
    /// ([`SuiteFile::accept_unjudged`](crate::SuiteFile::accept_unjudged)).
    pub accept_unjudged: Vec<String>,
    pub catalog: Catalog,
    /// Directory or URL of the twins, for the server that external agents connect to.
    pub twins: PathBuf,
    /// The cache on disk.
    pub cache: Option<DiskCacheSettings>,
    /// Directory of the suite, with the tracks and maps that scenarios name.
    pub scenarios: PathBuf,
    pub backend: Arc<dyn Backend>,
    /// Directory of the records, which must be empty.
    pub episodes: PathBuf,
    /// Whether each record also becomes an MCAP file.
    pub mcap: bool,
    /// Called after each episode.
    pub progress: Box<dyn Fn(&EpisodeEntry) + Send + Sync>,
}

/// Settings and host that all episodes share.
struct Shared {
    agent: AgentChoice,
    retries: u32,
    agent_timeout: Duration,
    accept_unjudged: Vec<String>,
    episodes: PathBuf,
    host: Host,
    progress: Box<dyn Fn(&EpisodeEntry) + Send + Sync>,
}

/// Where sessions are opened.
enum Host {
    /// In this process, for built-in agents.
    Engine(Arc<Engine>),
    /// A server on a free port of the loopback interface.
    Server { running: Option<Running>, url: String },
}

impl std::fmt::Debug for RunSettings {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RunSettings")
            .field("suite", &self.suite)
            .field("agent", &self.agent)
            .field("jobs", &self.jobs)
            .finish_non_exhaustive()
    }
}

/// Drives all cases. The result is in order of their names and has no times of the clock, so it
/// does not depend on `jobs`.
///
/// # Errors
/// The directory has episodes of another run, a scenario lacks what a built-in agent follows, the
/// engine or the server cannot be started, or the shell finds no such command as the agent's.
pub async fn run(settings: RunSettings, cases: Vec<Case>) -> Result<SuiteResult, SuiteError> {
    // Before the engine starts, since a mistake of the caller costs nothing then.
    check_empty(&settings.episodes)?;
    if let AgentChoice::BuiltIn(agent) = &settings.agent {
        check_agent(*agent, &cases)?;
    }
    let host = match &settings.agent {
        AgentChoice::BuiltIn(_) => Host::Engine(engine(&settings)?),
        AgentChoice::Command { .. } => server(&settings).await?,
    };
    let head = RunHead {
        suite: settings.suite,
        agent: settings.agent.name().to_owned(),
        latest: settings.latest,
        // The step of the suite, which is the same for all cases.
        dt_us: cases.first().and_then(|case| case.options.dt_us),
        at_least: settings.at_least,
        accept_unjudged: settings.accept_unjudged.clone(),
    };
    // At least one, because no job would never end.
    let permits = Arc::new(Semaphore::new(settings.jobs.clamp(1, limits::JOBS)));
    let shared = Arc::new(Shared {
        agent: settings.agent,
        retries: settings.retries,
        agent_timeout: settings.agent_timeout,
        accept_unjudged: settings.accept_unjudged,
        episodes: settings.episodes,
        host,
        progress: settings.progress,
    });
    // A task for each case, of which `jobs` run at once: the others wait for a permit.
    let mut tasks = JoinSet::new();
    for case in cases {
        let shared = shared.clone();
        let permits = permits.clone();
        tasks.spawn(async move {
            // The semaphore is never closed.
            let _permit = permits.acquire_owned().await;
            let begun = Instant::now();
            let mut entry = shared.episode(&case).await?;
            entry.wall = begun.elapsed();
            (shared.progress)(&entry);
            Ok(entry)
        });
    }
    let mut entries = Vec::new();
    let mut failed = None;
    // All tasks are awaited, also after an error: aborted ones must have let go of the host.
    while let Some(ended) = tasks.join_next().await {
        let entry = ended.map_err(|error| SuiteError::Task(error.to_string()));
        match entry.flatten() {
            Ok(entry) => entries.push(entry),
            // Keep the first error: later ones come from the tasks that are aborted here.
            Err(error) => {
                failed.get_or_insert(error);
                tasks.abort_all();
            }
        }
    }
    // The tasks have ended and dropped their handles, so this is the last one.
    if let Some(mut shared) = Arc::into_inner(shared) {
        // The engine is taken before the server stops, because the exports go on in it.
        let engine = shared.host.engine();
        // The server ends the sessions of agents that went away.
        shared.host.stop().await;
        if let Some(engine) = engine {
            engine.wait_for_exports(None, limits::EXPORT_WAIT).await;
            entries.iter_mut().for_each(|entry| entry.add_mcap(&shared.episodes, &engine));
        }
    }
    // Tasks end in any order.
    entries.sort_by(|a, b| a.name.cmp(&b.name));
    match failed {
        Some(error) => Err(error),
        None => Ok(SuiteResult::new(head, entries)),
    }
}

/// Refuses an agent that some scenario does not suit: a mistake that a second attempt would repeat.
fn check_agent(agent: BuiltIn, cases: &[Case]) -> Result<(), SuiteError> {
    cases.iter().try_for_each(|case| {
        agent
            .check(&case.resolved, case.drive.as_deref())
            .map_err(|cause| SuiteError::Agent { scenario: case.scenario.clone(), cause })
    })
}

/// Refuses a directory with records: their names would differ from those of a fresh run.
fn check_empty(dir: &Path) -> Result<(), SuiteError> {
    let failed = |cause| SuiteError::Io { what: "read", path: dir.to_owned(), cause };
    if wildcity_episode::list(dir).map_err(failed)?.is_empty() {
        Ok(())
    } else {
        Err(SuiteError::NotEmpty { dir: dir.to_owned() })
    }
}

fn engine(settings: &RunSettings) -> Result<Arc<Engine>, SuiteError> {
    Ok(Engine::start(EngineSettings {
        cache: Cache::new(settings.catalog.clone()),
        episodes: settings.episodes.clone(),
        // Scenarios come with their sessions; files that they name are in the directory of the
        // suite.
        scenarios: Scenarios::in_dir(&settings.scenarios),
        backend: settings.backend.clone(),
        step_timeout: Limits::default().step,
        repairs: Arc::default(),
        mcap: settings.mcap,
    })?)
}

async fn server(settings: &RunSettings) -> Result<Host, SuiteError> {
    let directories = Directories {
        twins: settings.twins.clone(),
        episodes: settings.episodes.clone(),
        scenarios: settings.scenarios.clone(),
        uploads: settings.episodes.join(".uploads"),
    };
    let config = Config {
        cache: settings.cache.clone(),
        mcap: settings.mcap,
        ..Config::local(directories, settings.backend.clone())
    };
    let running = wildcity_server::start(config).await?;
    let url = running.url();
    Ok(Host::Server { running: Some(running), url })
}

impl Host {
    /// The engine that writes MCAP files; none if it does not.
    fn engine(&self) -> Option<Arc<Engine>> {
        let engine = match self {
            Self::Engine(engine) => Some(engine),
            Self::Server { running, .. } => running.as_ref().map(Running::engine),
        };
        engine.filter(|engine| engine.exports_mcap()).cloned()
    }

    async fn stop(&mut self) {
        if let Self::Server { running, .. } = self
            && let Some(running) = running.take()
        {
            running.stop().await;
        }
    }
}

impl Shared {
    /// Drives a case, technical failures once more, and judges its record.
    ///
    /// # Errors
    /// The agent is a command that the shell does not find.
    async fn episode(&self, case: &Case) -> Result<EpisodeEntry, SuiteError> {
        let mut errors = Vec::new();
        // In 64 bits, because `retries + 1` may not fit into 32.
        for attempt in 1..=u64::from(self.retries) + 1 {
            let driven = self.attempt(case, attempt).await;
            let finished = match driven {
                Ok(record) => finish(case, record).await,
                Err(NotDriven::Technical(technical)) => Err(technical),
                // Another attempt, and every other episode, would fail in the same way.
                Err(NotDriven::NoCommand(reason)) => {
                    return Err(SuiteError::NoAgent {
                        agent: self.agent.name().to_owned(),
                        reason,
                    });
                }
            };
            match finished {
                Ok(finished) => {
                    return Ok(EpisodeEntry::new(
                        case,
                        Some(finished),
                        errors,
                        &self.accept_unjudged,
                    ));
                }
                Err(technical) => {
                    tracing::warn!(
                        episode = case.name,
                        "{}: {}",
                        technical.kind,
                        technical.message
                    );
                    errors.push(technical);
                }
            }
        }
        Ok(EpisodeEntry::new(case, None, errors, &self.accept_unjudged))
    }

    /// Drives a case. Returns the file of its record.
    async fn attempt(&self, case: &Case, attempt: u64) -> Result<PathBuf, NotDriven> {
        // Each attempt has a session of its own: the server keeps a lost session for a while.
        let session = match attempt {
            1 => case.name.clone(),
            attempt => format!("{}.{attempt}", case.name),
        };
        // The first episode of the session, as the server names its file.
        let record = self.episodes.join(format!("{session}-1.jsonl"));
        match (&self.host, &self.agent) {
            (Host::Engine(engine), AgentChoice::BuiltIn(agent)) => {
                drive(engine.clone(), case, session, *agent).await?;
            }
            (Host::Server { url, .. }, AgentChoice::Command { name, line }) => {
                let timeout = self.agent_timeout;
                let process = AgentProcess { name, command: line, url, session: &session, timeout };
                agent_process::drive(&process, case, &record).await?;
            }
            _ => return Err(Technical::server("the host does not fit the agent").into()),
        }
        Ok(record)
    }
}

/// Drives a case with a built-in agent.
async fn drive(
    engine: Arc<Engine>,
    case: &Case,
    session: String,
    agent: BuiltIn,
) -> Result<(), Technical> {
    let failed = |error: wildcity_session::SessionError| Technical::server(error.to_string());
    let mut session = Session::open(engine, session, case.options.clone()).await.map_err(failed)?;
    let driven = steps(&mut session, case, agent).await;
    let outcome = if driven.is_ok() { Outcome::Completed } else { Outcome::ServerError };
    // Closed on failure as well, because the record gets its end from it.
    session.close(outcome).await;
    driven
}

async fn steps(session: &mut Session, case: &Case, agent: BuiltIn) -> Result<(), Technical> {
    let failed = |error: wildcity_session::SessionError| Technical::server(error.to_string());
    session.reset(case.seed, None).await.map_err(failed)?;
    for step in 1..=case.steps {
        let command = agent.command(case, session).map_err(Technical::server)?;
        session.step(command, step == case.steps).await.map_err(failed)?;
        // A rule of the scenario may end the episode earlier.
        if session.episode().terminated() {
            break;
        }
    }
    Ok(())
}
