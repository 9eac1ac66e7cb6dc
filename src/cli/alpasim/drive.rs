//! `wildcity alpasim drive`.

use std::io::Write;
use std::time::Duration;

use serde_json::json;
use tokio::task::JoinSet;

use anyhow::Context as _;

use wildcity_alpasim::egodriver::{EpisodeReport, EpisodeSettings, Outcome, drive_episode};
use wildcity_alpasim::limits;
use wildcity_client::DynamicsModel;
use wildcity_client::protocol::message::{Open, RigChoice, ScenarioChoice};

use crate::cli::exit::Exit;
use crate::cli::output;

/// Exit code if the driver did not answer in time: the status of `timeout`.
const TIMEOUT_EXIT_CODE: u8 = 124;

/// Exit code if the connection to the driver was lost: EX_UNAVAILABLE.
const LOST_EXIT_CODE: u8 = 69;

/// Drive in a twin of a running server with a driver of AlpaSim.
///
/// The driver is a gRPC server of AlpaSim's service egodriver. In each step of 0.1 s it receives
/// the new images, the ego's poses and the route, which follows a recorded drive or comes from a
/// scenario. The ego then follows the driver's plan. Prints one line of JSON for each episode:
/// outcome, steps, distance, and a hash of all frames. The exit code is 1 if an episode did not
/// complete: a contact ends it as driving_failure. For a single episode it is 124 if the driver did
/// not answer in time, and 69 if the connection to it was lost. For a server with tokens, set
/// $WILDCITY_TOKEN.
///
/// Without TWIN the command is an agent for `wildcity episode run`, which describes the episode in
/// environment variables. `--agent egodriver:HOST:PORT` starts it with all cameras of the rig;
/// `--agent 'wildcity alpasim drive --egodriver HOST:PORT --cameras front --size 576x320'` starts
/// it with others.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Drive {
    /// The twin to drive in [default: the twin of `wildcity episode run`]
    #[arg(value_name = "TWIN")]
    twin: Option<String>,

    /// Address of the driver; the command waits up to 120 s for it.
    #[arg(long, value_name = "HOST:PORT")]
    egodriver: String,

    /// The server.
    #[arg(long, value_name = "URL", default_value = "ws://127.0.0.1:8080/v1/session")]
    server: String,

    /// Version of the twin [default: the latest]
    #[arg(long, value_name = "N")]
    version: Option<u64>,

    /// Recorded drive to follow [default: the twin's first]
    #[arg(long, value_name = "NAME")]
    trajectory: Option<String>,

    /// Where to start along the drive, in metres [default: where the warm-up ends]
    #[arg(long, value_name = "M")]
    start_m: Option<f64>,

    /// Scenario of the server, by its name: traffic, a route, and when an episode ends
    #[arg(long, value_name = "NAME", requires = "twin")]
    scenario: Option<String>,

    /// Rig preset [default: the twin's own rig]
    #[arg(long, value_name = "NAME")]
    rig: Option<String>,

    /// Cameras whose images the driver receives [default: all of the rig]
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    cameras: Option<Vec<String>>,

    /// Size of the images of --cameras, as 576x320 [default: the rig's]
    #[arg(long, value_name = "WxH", requires = "cameras", value_parser = size)]
    size: Option<[u32; 2]>,

    /// How the ego moves [default: as the scenario says; without one, dynamic]
    #[arg(long, value_name = "MODEL", value_parser = model)]
    dynamics: Option<DynamicsModel>,

    /// Speed at the start, in m/s [default: that of the scenario; without one, the recorded one]
    #[arg(long, value_name = "M_S")]
    speed: Option<f64>,

    /// Duration of the recorded drive before the start, in microseconds: Alpamayo's driver needs
    /// 1.5 s of poses and four frames
    #[arg(long, value_name = "US", default_value_t = 1_700_000)]
    warm_up_us: i64,

    /// Number of steps of an episode
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..))]
    steps: u64,

    /// Seed of the first episode; each later episode has the next number
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,

    /// Number of episodes
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    episodes: u64,

    /// Number of episodes at a time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=64))]
    parallel: u64,

    /// Time limit for one answer of the driver, in milliseconds
    #[arg(long, value_name = "MS", default_value_t = limits::DRIVER_ANSWER.as_millis() as u64)]
    drive_timeout_ms: u64,
}

const EXAMPLES: &str = "\
Examples:
  carla-driver-interface serve --policy route_follower --mode alpasim --port 7102
  wildcity alpasim drive demo --egodriver 127.0.0.1:7102
  wildcity alpasim drive demo --egodriver 127.0.0.1:7102 --cameras front --size 576x320 --steps 60 --episodes 4";

impl Drive {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let failed = runtime.block_on(self.drive(&self.settings()?))?;
        let Some(last) = failed.last() else { return Ok(()) };
        let message = format!("{} of {} episodes did not complete", failed.len(), self.episodes);
        let code = match last {
            Outcome::AgentTimeout if self.episodes == 1 => TIMEOUT_EXIT_CODE,
            Outcome::AgentLost if self.episodes == 1 => LOST_EXIT_CODE,
            _ => 1,
        };
        Err(Exit::error(code, message).into())
    }

    /// Drives all episodes, and returns the outcomes of those that did not complete.
    async fn drive(&self, settings: &EpisodeSettings) -> anyhow::Result<Vec<Outcome>> {
        let mut running = JoinSet::new();
        let mut failed = Vec::new();
        let mut next = 0;
        while next < self.episodes || !running.is_empty() {
            while next < self.episodes && (running.len() as u64) < self.parallel {
                let mut settings = settings.clone();
                settings.seed = settings.seed.wrapping_add(next);
                running.spawn(async move { drive_episode(&settings).await });
                next += 1;
            }
            if let Some(ended) = running.join_next().await {
                let report = ended??;
                // `episode run` judges the driving itself.
                let is_driven = matches!(
                    report.outcome,
                    Outcome::Completed | Outcome::DrivingFailure | Outcome::OffModel
                );
                let is_good = match self.twin {
                    Some(_) => report.outcome == Outcome::Completed,
                    None => is_driven,
                };
                if !is_good {
                    failed.push(report.outcome);
                }
                writeln!(output::stdout(), "{}", line(&report))?;
                if let (Some(reason), None) = (&report.reason, &self.twin) {
                    // `episode run` shows no output of agents.
                    eprintln!("{reason}");
                }
            }
        }
        Ok(failed)
    }

    fn settings(&self) -> anyhow::Result<EpisodeSettings> {
        let rig = self.rig.clone().map(RigChoice::Preset);
        let (open, server, seed, steps) = match &self.twin {
            Some(twin) => {
                let open = Open {
                    version: self.version,
                    scenario: self.scenario.clone().map(ScenarioChoice::Name),
                    warm_up_us: Some(self.warm_up_us),
                    rig,
                    ..Open::twin(twin)
                };
                (open, self.server.clone(), self.seed, self.steps)
            }
            None => {
                anyhow::ensure!(
                    self.episodes == 1,
                    "--episodes needs TWIN: `wildcity episode run` starts one episode at a time"
                );
                let open = Open { rig, ..asked_open()? };
                (open, asked("WILDCITY_URL")?, number("WILDCITY_SEED")?, number("WILDCITY_STEPS")?)
            }
        };
        Ok(EpisodeSettings {
            server,
            token: std::env::var("WILDCITY_TOKEN").ok().filter(|token| !token.is_empty()),
            driver: self.egodriver.clone(),
            open,
            trajectory: self.trajectory.clone(),
            start_m: self.start_m,
            cameras: self.cameras.clone(),
            size_px: self.size,
            model: self.dynamics,
            speed_m_s: self.speed,
            frames: 4,
            steps,
            seed,
            max_wait: Duration::from_millis(self.drive_timeout_ms),
        })
    }
}

/// The request `open` that `wildcity episode run` asks for.
fn asked_open() -> anyhow::Result<Open> {
    let mut fields: serde_json::Map<String, serde_json::Value> =
        serde_json::from_str(&asked("WILDCITY_OPEN")?).context("WILDCITY_OPEN")?;
    // The client numbers its requests.
    fields.insert("seq".to_owned(), 0.into());
    fields.retain(|_, value| !value.is_null());
    serde_json::from_value(fields.into()).context("WILDCITY_OPEN")
}

fn asked(name: &str) -> anyhow::Result<String> {
    std::env::var(name).ok().with_context(|| {
        format!("name a TWIN: there is no {name}, so `wildcity episode run` has not started this")
    })
}

fn number(name: &str) -> anyhow::Result<u64> {
    asked(name)?.parse().with_context(|| format!("{name} is not a number"))
}

fn line(report: &EpisodeReport) -> serde_json::Value {
    let outcome = match report.outcome {
        Outcome::Completed => "completed",
        Outcome::DrivingFailure => "driving_failure",
        Outcome::OffModel => "off_model",
        Outcome::AgentError => "agent_error",
        Outcome::AgentTimeout => "agent_timeout",
        Outcome::AgentLost => "agent_lost",
    };
    json!({
        "seed": report.seed,
        "outcome": outcome,
        "reason": report.reason,
        "steps": report.steps,
        "distance_m": report.distance_m,
        "frames_hash": report.frames_hash,
    })
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let refused = || format!("{text:?} is not a size; expected WIDTHxHEIGHT in pixels, as 576x320");
    let (width, height) = text.split_once('x').ok_or_else(refused)?;
    Ok([width.parse().map_err(|_| refused())?, height.parse().map_err(|_| refused())?])
}

fn model(text: &str) -> Result<DynamicsModel, String> {
    match text {
        "teleport" => Ok(DynamicsModel::Teleport),
        "kinematic" => Ok(DynamicsModel::Kinematic),
        "dynamic" => Ok(DynamicsModel::Dynamic),
        _ => Err("expected teleport, kinematic or dynamic".to_owned()),
    }
}
