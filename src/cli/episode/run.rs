//! `wildcity episode run`.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use wildcity_render::Backend;
use wildcity_suite::{
    CaseOptions, CompareError, Comparison, DrivenRun, Ending, EpisodeEntry, ExitCode, Rule,
    RunSettings, SuiteError, SuiteFile, SuiteResult, TechnicalEntry, Tolerance, cases,
    check_criteria, junit, page, pictures, verify,
};
use wildcity_twin::store::Catalog;

use crate::cli::backend_options::{BackendOptions, Devices};
use crate::cli::directories::Twins;
use crate::cli::exit::Exit;
use crate::cli::{output, progress};

use super::run_agent::{choice, wait_for_driver};
use super::{bad_input, exit};

/// Drive a suite of scenarios with an agent, judge every episode, and report.
///
/// Writes into --out: result.json, junit.xml, report.html, and the records of the episodes. The
/// exit code is 0 if every episode passed, or has no verdict and the suite accepts this. It is 1 if
/// one failed by driving. It is 2 if the command line, the suite, a scenario or the run of
/// --against is wrong, or the agent cannot be started. It is 3 if an episode was not driven for
/// technical reasons. It is 4 if an episode does not repeat (--verify). It is 5 if no episode
/// failed, but one has no verdict: a criterion could not be judged, or the ego left the trained
/// area. The suite's `accept_unjudged`, or --accept-unjudged, names what is accepted.
///
/// With --at-least or --against, the exit code can be 0 although episodes failed. --at-least
/// requires a pass rate. --against requires that the run is not worse than an earlier one, as
/// `wildcity episode compare` judges, and also writes comparison.json and comparison.html.
/// junit.xml always lists every failure, and has the exit code as a property.
///
/// Equal episodes of a scenario count once in rates and means: without jitter, two seeds give the
/// same episode.
///
/// The shell starts the command of --agent once for each episode, with these variables in its
/// environment: WILDCITY_URL, WILDCITY_OPEN (fields of its request `open` as JSON), WILDCITY_SEED
/// (for `reset`) and WILDCITY_STEPS (after which it closes its session). docs/suites.md has an
/// example. The command must end with exit code 0; with 124 if it ran out of time; or with 69 if it
/// lost something that it needs.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Run {
    /// The suite's file, or the file of a single scenario.
    #[arg(value_name = "SUITE")]
    suite: PathBuf,

    /// The agent: log, stand or idm; egodriver:HOST:PORT for a driver of AlpaSim; or a command
    /// [default: that of the suite, or log]
    #[arg(long, value_name = "AGENT")]
    agent: Option<String>,

    /// Directory for results and records; must not have records of another run.
    #[arg(long, value_name = "DIR", default_value = "wildcity-run")]
    out: PathBuf,

    /// Number of episodes at a time. Results do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    jobs: u16,

    /// Largest number of times that an episode is driven again after a technical failure.
    #[arg(long, value_name = "N", default_value_t = 1)]
    retries: u32,

    /// Time limit of a command for an episode, in seconds.
    #[arg(long, value_name = "S", default_value_t = wildcity_suite::limits::AGENT_TIMEOUT.as_secs())]
    agent_timeout_s: u64,

    /// The pass rate that is required, from 0 to 1: the lower end of the 95 % interval must reach
    /// it [default: that of the suite; without one every episode must pass]
    #[arg(long, value_name = "RATE")]
    at_least: Option<f64>,

    /// A criterion that need not be judged for a pass: contact, contact.static, off_road (a
    /// scenario without a map) or progress; or off_model, for episodes that leave the trained area.
    /// In addition to those of the suite.
    #[arg(long, value_name = "CRITERION")]
    accept_unjudged: Vec<String>,

    /// Compare with an earlier run: its result.json, or its folder.
    #[arg(long, value_name = "RUN")]
    against: Option<PathBuf>,

    /// By how much pass_rate, or the mean of a score, may be worse than in that run; see
    /// `wildcity episode compare --help`
    #[arg(long, value_name = "NAME=AMOUNT", requires = "against")]
    worse_by: Vec<Tolerance>,

    /// Export the record of each episode as MCAP, next to it: for Foxglove, Rerun and others.
    #[arg(long, value_name = "BOOL", action = clap::ArgAction::Set, default_value_t = true, num_args = 0..=1, default_missing_value = "true")]
    mcap: bool,

    /// Render every episode again afterwards, and compare all images with the records.
    #[arg(long)]
    verify: bool,

    /// Use the latest versions of the twins instead of those that the scenarios name; the results
    /// record this.
    #[arg(long)]
    latest: bool,

    /// Remove all actors. The agent log must then pass, which checks the scenario.
    #[arg(long)]
    bare: bool,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,

    #[command(flatten)]
    devices: Devices,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode run scenes/suites/street/suite.json
  wildcity episode run suite.json --agent 'python drive.py' --jobs 4 --at-least 0.9
  wildcity episode run suite.json --agent 'python drive.py' --against main/result.json
  wildcity episode run suite.json --agent egodriver:127.0.0.1:7102
  wildcity episode run pedestrian.json --agent stand --verify
  wildcity episode run suite.json --agent log --bare        (each scenario tests itself)";

impl Run {
    pub(super) fn run(self) -> anyhow::Result<()> {
        // Mistakes are reported before anything is driven.
        let (suite, scenarios) = SuiteFile::read(&self.suite).map_err(bad_input)?;
        let at_least = self.at_least.or(suite.at_least);
        if at_least.is_some_and(|rate| !(0.0..=1.0).contains(&rate)) {
            return Err(bad_input("--at-least is a rate from 0 to 1"));
        }
        check_criteria(&self.accept_unjudged)
            .map_err(|reason| bad_input(format!("--accept-unjudged: {reason}")))?;
        let accept_unjudged =
            [suite.accept_unjudged.clone(), self.accept_unjudged.clone()].concat();
        let named = self.agent.clone().or(suite.agent.clone()).unwrap_or("log".to_owned());
        let agent = choice(&named)?;
        let catalog = self.twins.catalog()?;
        let options = CaseOptions { latest: self.latest, bare: self.bare };
        let cases = cases(&suite, &scenarios, &catalog, options).map_err(bad_input)?;
        let before =
            self.against.as_deref().map(SuiteResult::read).transpose().map_err(bad_input)?;
        let rule: Rule = self.worse_by.iter().cloned().collect();
        if let Some(before) = &before {
            Comparison::check(before, &cases, &rule).map_err(bad_input)?;
        }
        output::create_dir(&self.out).map_err(bad_input)?;
        wait_for_driver(&agent)?;

        // Drive.
        let backend = self.backend.backend_on(&self.devices)?;
        let bar = progress::count("driving");
        bar.set_length(cases.len() as u64);
        let counted = bar.clone();
        let begun = Instant::now();
        let settings = RunSettings {
            suite: suite.name,
            agent,
            jobs: usize::from(self.jobs),
            retries: self.retries,
            agent_timeout: Duration::from_secs(self.agent_timeout_s),
            latest: self.latest,
            at_least,
            accept_unjudged,
            catalog: catalog.clone(),
            twins: self.twins.dir()?,
            cache: self.twins.cache(),
            scenarios: self.suite.parent().unwrap_or(Path::new(".")).to_owned(),
            backend: backend.clone(),
            episodes: self.episodes(),
            mcap: self.mcap,
            progress: Box::new(move |episode: &EpisodeEntry| {
                counted.inc(1);
                let status = episode.status.name();
                let done = counted.position();
                let all = counted.length().unwrap_or(0);
                let seconds = begun.elapsed().as_secs_f64();
                counted.suspend(|| {
                    eprintln!("{done}/{all} after {seconds:.0} s: {status} {}", episode.name);
                });
            }),
        };
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let driven = runtime.block_on(wildcity_suite::run(settings, cases));
        let result = driven.map_err(|error| match error {
            error @ (SuiteError::NotEmpty { .. }
            | SuiteError::NoAgent { .. }
            | SuiteError::Agent { .. }) => bad_input(error),
            error => exit(ExitCode::Technical, error),
        })?;
        bar.finish_and_clear();

        // Report.
        let compared = before.as_ref().map(|before| Comparison::new(before, &result, &rule));
        let ending = self.ending(&result, compared.as_ref(), &catalog, &*backend);
        let comparison = compared.and_then(Result::ok);
        self.write_files(&result, &ending, &catalog, &*backend)?;
        if let (Some(comparison), Some(before)) = (&comparison, &before) {
            let runs = self.compared_runs(before, &result);
            let pictures = comparison.pictures(&runs, &catalog, &*backend);
            self.write("comparison.json", &comparison.to_json())?;
            self.write("comparison.html", &comparison.to_page(&runs, &pictures))?;
        }
        self.print(&result, &ending, comparison.as_ref())?;
        match ending.code {
            ExitCode::Passed => Ok(()),
            ExitCode::Driving => Err(Exit::finding(ending.code as u8, ending.why).into()),
            code => Err(exit(code, ending.why)),
        }
    }

    /// The folder of the records.
    fn episodes(&self) -> PathBuf {
        self.out.join("episodes")
    }

    /// The exit code. With --verify, all episodes are rendered again first.
    fn ending(
        &self,
        result: &SuiteResult,
        compared: Option<&Result<Comparison, CompareError>>,
        catalog: &Catalog,
        backend: &dyn Backend,
    ) -> Ending {
        let wrong = if self.verify {
            verify(result, &self.episodes(), catalog, backend)
        } else {
            Vec::new()
        };
        if wrong.is_empty() { Ending::new(result, compared) } else { Ending::not_verified(&wrong) }
    }

    fn write_files(
        &self,
        result: &SuiteResult,
        ending: &Ending,
        catalog: &Catalog,
        backend: &dyn Backend,
    ) -> anyhow::Result<()> {
        let pictures = pictures(result, &self.episodes(), catalog, backend);
        self.write(SuiteResult::FILE, &result.to_json())?;
        self.write("junit.xml", &junit(result, ending))?;
        self.write("report.html", &page(result, ending, &pictures, &self.episodes()))
    }

    /// The earlier run, and this one.
    fn compared_runs<'a>(
        &self,
        before: &'a SuiteResult,
        after: &'a SuiteResult,
    ) -> [DrivenRun<'a>; 2] {
        let earlier = self.against.as_deref().map_or(PathBuf::new(), SuiteResult::records);
        [
            DrivenRun { result: before, episodes: earlier },
            DrivenRun { result: after, episodes: self.episodes() },
        ]
    }

    fn write(&self, name: &str, text: &str) -> anyhow::Result<()> {
        output::write(&self.out.join(name), text.as_bytes())
    }

    /// A summary on standard output; main prints why the exit code is not 0.
    fn print(
        &self,
        result: &SuiteResult,
        ending: &Ending,
        comparison: Option<&Comparison>,
    ) -> anyhow::Result<()> {
        let mut out = output::stdout();
        for episode in &result.episodes {
            let mut why: Vec<String> =
                episode.faults.iter().map(|fault| fault.fault.clone()).collect();
            why.extend(episode.not_judged_texts());
            why.extend(episode.errors.last().map(TechnicalEntry::text));
            why.extend(episode.untested_texts());
            why.extend(episode.duplicate_text());
            let status = episode.status.name();
            let line = format!("{status:<12} {:<32} {}", episode.name, why.join(", "));
            writeln!(out, "{}", line.trim_end())?;
            if let Some(reason) = episode.mcap_error() {
                eprintln!("warning: no MCAP file of {}: {reason}", episode.name);
            }
        }
        writeln!(out, "passed      {}", result.pass_rate.text())?;
        if let Some(text) = result.duplicates_text() {
            writeln!(out, "note        {text}")?;
        }
        if let Some(comparison) = comparison {
            write!(out, "\n{}\n", comparison.to_text())?;
        }
        if self.verify && ending.code != ExitCode::NotVerified {
            writeln!(out, "verified    all episodes repeat")?;
        }
        writeln!(out, "report      {}", self.out.join("report.html").display())?;
        if ending.code == ExitCode::Passed {
            writeln!(out, "ended       {}", ending.why)?;
        }
        Ok(())
    }
}
