//! `wildcity episode run`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use wildcity_render::Backend;
use wildcity_suite::{
    AgentChoice, BuiltIn, CaseOptions, ExitCode, RunSettings, SuiteFile, SuiteResult, cases, junit,
    page, pictures,
};
use wildcity_twin::store::Catalog;

use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::Twins;
use crate::cli::exit::Exit;
use crate::cli::{output, progress};

/// Drive a suite of scenarios with an agent, judge every episode, and report.
///
/// Writes into --out: result.json, junit.xml, report.html, and the records of the episodes. The exit code is 0 if no
/// episode failed by driving (with --at-least, if the pass rate is as wanted), 1 if that is not so, 2 if the command
/// line, the suite or a scenario is wrong, 3 if an episode was not driven for technical reasons or more than a tenth of
/// them left the trained area, 4 if an episode does not repeat (--verify).
///
/// An agent that is a command is started by the shell, once for each episode. It finds in its environment
/// WILDCITY_URL, WILDCITY_OPEN (the fields of its request `open` as JSON), WILDCITY_SEED (for `reset`) and
/// WILDCITY_STEPS (after which it closes its session). It ends with exit code 0, or 124 if it ran out of time, 69 if what
/// it needs went away.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Run {
    /// The suite's file, or the file of a single scenario.
    #[arg(value_name = "SUITE")]
    suite: PathBuf,

    /// What drives: log, stand or idm; egodriver:HOST:PORT, a driver of AlpaSim; or a command [default: that of the
    /// suite, or log]
    #[arg(long, value_name = "AGENT")]
    agent: Option<String>,

    /// Directory for results and records; must not have records of another run.
    #[arg(long, value_name = "DIR", default_value = "wildcity-run")]
    out: PathBuf,

    /// Episodes at once. Results do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    jobs: u16,

    /// How often an episode that failed for technical reasons is driven again.
    #[arg(long, value_name = "N", default_value_t = 1)]
    retries: u32,

    /// How long a command may take for an episode, in seconds.
    #[arg(long, value_name = "S", default_value_t = wildcity_suite::limits::AGENT_TIMEOUT.as_secs())]
    agent_timeout_s: u64,

    /// The least pass rate, from 0 to 1, held against the lower end of its 95 % interval [default: that of the
    /// suite; without one every episode must pass]
    #[arg(long, value_name = "RATE")]
    at_least: Option<f64>,

    /// Export the record of each episode as MCAP, beside it: for Foxglove, Rerun and others.
    #[arg(long, value_name = "BOOL", action = clap::ArgAction::Set, default_value_t = true, num_args = 0..=1, default_missing_value = "true")]
    mcap: bool,

    /// Render every episode again afterwards, and compare all images with the records.
    #[arg(long)]
    verify: bool,

    /// Take the latest versions of the twins, whatever the scenarios name; the results say so.
    #[arg(long)]
    latest: bool,

    /// Leave out all actors: on the bare twin the agent log must pass.
    #[arg(long)]
    bare: bool,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode run scenes/suites/street/suite.json
  wildcity episode run suite.json --agent 'python drive.py' --jobs 4 --at-least 0.9
  wildcity episode run suite.json --agent egodriver:127.0.0.1:7102
  wildcity episode run pedestrian.json --agent stand --verify
  wildcity episode run suite.json --agent log --bare        (each scenario tests itself)";

impl Run {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let (suite, scenarios) = SuiteFile::read(&self.suite).map_err(usage)?;
        let at_least = self.at_least.or(suite.at_least);
        if at_least.is_some_and(|rate| !(0.0..=1.0).contains(&rate)) {
            return Err(usage("--at-least is a rate from 0 to 1"));
        }
        let agent = self.agent.clone().or(suite.agent.clone()).unwrap_or("log".to_owned());
        let agent = choice(agent)?;
        let catalog = self.twins.catalog()?;
        let options = CaseOptions { latest: self.latest, bare: self.bare };
        let cases = cases(&suite, &scenarios, &catalog, options).map_err(usage)?;
        output::create_dir(&self.out).map_err(usage)?;
        let backend: Arc<dyn Backend> = Arc::from(self.backend.backend()?);
        let episodes = self.out.join("episodes");
        let bar = progress::count("driving");
        bar.set_length(cases.len() as u64);
        let counted = bar.clone();
        let settings = RunSettings {
            suite: suite.name,
            agent,
            jobs: usize::from(self.jobs),
            retries: self.retries,
            agent_timeout: Duration::from_secs(self.agent_timeout_s),
            latest: self.latest,
            at_least,
            catalog: catalog.clone(),
            twins: self.twins.dir()?,
            cache: self.twins.cache(),
            scenarios: self.suite.parent().unwrap_or(Path::new(".")).to_owned(),
            backend: backend.clone(),
            episodes: episodes.clone(),
            mcap: self.mcap,
            progress: Box::new(move |_| counted.inc(1)),
        };
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let result =
            runtime.block_on(wildcity_suite::run(settings, cases)).map_err(
                |error| match error {
                    error @ wildcity_suite::SuiteError::NotEmpty { .. } => usage(error),
                    error => exit(ExitCode::Technical, error),
                },
            )?;
        bar.finish_and_clear();
        self.write(&result, &episodes, &catalog, &*backend)?;
        self.verified(&result, &episodes, &catalog, &*backend)?;
        match result.exit_code() {
            ExitCode::Passed => Ok(()),
            ExitCode::Driving => {
                Err(Exit::finding(ExitCode::Driving as u8, ending(&result)).into())
            }
            code => Err(exit(code, ending(&result))),
        }
    }

    /// Writes the three files, and a summary to standard output.
    fn write(
        &self,
        result: &SuiteResult,
        episodes: &Path,
        catalog: &Catalog,
        backend: &dyn Backend,
    ) -> anyhow::Result<()> {
        let pictures = pictures(result, episodes, catalog, backend);
        let html = page(result, &pictures, episodes);
        for (name, text) in
            [("result.json", result.to_json()), ("junit.xml", junit(result)), ("report.html", html)]
        {
            output::write(&self.out.join(name), text.as_bytes())?;
        }
        let mut out = io::stdout().lock();
        for episode in &result.episodes {
            let why: Vec<&str> = episode.faults.iter().map(|fault| &*fault.fault).collect();
            let error =
                episode.errors.last().map(|error| format!("{}: {}", error.kind, error.message));
            let why = why.join(", ") + &error.unwrap_or_default();
            writeln!(out, "{:<12} {:<32} {why}", episode.status.name(), episode.name)?;
            if let Some(reason) = episode.mcap_error() {
                eprintln!("warning: no MCAP file of {}: {reason}", episode.name);
            }
        }
        let rate = &result.pass_rate;
        let [low, high] = rate.interval.map(|end| 100.0 * end);
        writeln!(
            out,
            "passed      {} of {} (95 %: {low:.1} to {high:.1} %)",
            rate.passed, rate.runs
        )?;
        writeln!(out, "report      {}", self.out.join("report.html").display())?;
        Ok(())
    }

    fn verified(
        &self,
        result: &SuiteResult,
        episodes: &Path,
        catalog: &Catalog,
        backend: &dyn Backend,
    ) -> anyhow::Result<()> {
        if !self.verify {
            return Ok(());
        }
        let wrong = wildcity_suite::verify(result, episodes, catalog, backend);
        if wrong.is_empty() {
            writeln!(io::stdout().lock(), "verified    all episodes repeat")?;
            return Ok(());
        }
        Err(exit(ExitCode::NotVerified, format!("not repeated: {}", wrong.join("; "))))
    }
}

/// An agent by what the command line or the suite says.
fn choice(agent: String) -> anyhow::Result<AgentChoice> {
    if let Some(built_in) = BuiltIn::named(&agent) {
        return Ok(AgentChoice::BuiltIn(built_in));
    }
    let line = match agent.strip_prefix("egodriver:") {
        // This program is the bridge. The address is an argument of its own for the shell.
        Some(address) => {
            let is_address = |c: char| c.is_ascii_alphanumeric() || "-._:[]".contains(c);
            if address.is_empty() || !address.chars().all(is_address) {
                return Err(usage(format!("{agent:?} is no agent: expected egodriver:HOST:PORT")));
            }
            let program = std::env::current_exe().map_err(usage)?;
            format!("'{}' drive --egodriver '{address}'", program.display())
        }
        None => agent.clone(),
    };
    Ok(AgentChoice::Command { name: agent, line })
}

/// Why a run did not end as wanted.
fn ending(result: &SuiteResult) -> String {
    let counts = &result.counts;
    let text = format!(
        "of {} episodes {} failed, {} were not judged, {} were not driven, {} left the trained area",
        counts.episodes, counts.failed, counts.not_judged, counts.technical, counts.off_model
    );
    let low = result.pass_rate.interval[0];
    match result.at_least.filter(|least| low < *least) {
        Some(least) => {
            format!("{text}; the pass rate is at least {low:.3}, and {least} was wanted")
        }
        None => text,
    }
}

fn exit(code: ExitCode, message: impl std::fmt::Display) -> anyhow::Error {
    Exit::error(code as u8, format!("{message:#}")).into()
}

fn usage(message: impl std::fmt::Display) -> anyhow::Error {
    exit(ExitCode::Usage, message)
}
