//! `wildcity bench soak`.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde_json::json;
use tokio::task::JoinSet;

use wildcity_client::protocol::message::{Rig, RigChoice};
use wildcity_client::{Client, Open, Pose};
use wildcity_scene::Trajectory;
use wildcity_server::{Config, Directories, Limits};

use super::benched_twin::BenchedTwin;
use super::memory::{mib, rss_bytes};
use crate::cli::backend_options::bytes_of_gib;
use crate::cli::directories::TwinVersion;
use crate::cli::exit::Exit;

/// Drive many sessions of small cameras against a server for minutes or hours, and look for what grows or changes.
///
/// The server runs in this process. The twin needs a recorded drive: each session drives the same stretch of the first
/// one again and again, and compares the hash of every image with that of its first round. Prints the memory of the
/// process every minute. The exit code is 1 if a request fails, a hash changes, or the memory grows by more than
/// --growth after the first sixth of the time. With --memory-gib below what the twin needs, the server evicts and
/// loads all the time.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Soak {
    #[command(flatten)]
    twin: BenchedTwin,

    /// How long, in minutes.
    #[arg(long, value_name = "N", default_value_t = 60.0, value_parser = minutes)]
    minutes: f64,

    /// Sessions at once.
    #[arg(long, value_name = "K", default_value_t = 16, value_parser = clap::value_parser!(u32).range(1..=256))]
    sessions: u32,

    /// Steps of a session before it is closed and opened again.
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    steps: u32,

    /// Growth of the memory that is accepted, in per cent.
    #[arg(long, value_name = "PERCENT", default_value_t = 2.0)]
    growth: f64,
}

const EXAMPLES: &str = "\
Examples:
  wildcity bench soak street
  wildcity bench soak street --minutes 2 --sessions 4 --memory-gib 0.1";

/// Speed of the agents, in m/s.
const SPEED_M_PER_S: f64 = 10.0;
/// Time between two lines.
const LINE_EVERY: Duration = Duration::from_secs(60);
/// Share of the time after which memory is compared: caches and pools are full by then.
const SETTLED_SHARE: f64 = 1.0 / 6.0;

/// What one session did.
#[derive(Clone, Copy, Debug, Default)]
struct Driven {
    steps: u64,
    rounds: u64,
}

impl Soak {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let TwinVersion { name, number } = &self.twin.twin;
        let version = self.twin.twins.catalog()?.version(name, *number)?;
        let Some(route) = version.manifest.trajectories.first().cloned() else {
            anyhow::bail!("twin {name:?} has no recorded drive to follow");
        };
        // Records, scenarios and uploads of this run only.
        let directory = tempfile::tempdir()?;
        let below = |name: &str| -> PathBuf { directory.path().join(name) };
        let mut limits = Limits::default();
        limits.resident_bytes = self.twin.memory_gib.map(bytes_of_gib);
        limits.sessions = limits.sessions.max(self.sessions as usize);
        let directories = Directories {
            twins: self.twin.twins.dir()?,
            episodes: below("episodes"),
            scenarios: below("scenarios"),
            uploads: below("uploads"),
        };
        let backend = Arc::from(self.twin.backend.backend()?);
        let config = Config {
            cache: self.twin.twins.cache(),
            limits,
            mcap: false,
            ..Config::local(directories, backend)
        };
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let result = runtime.block_on(async {
            let running = wildcity_server::start(config).await?;
            let result = self.soak(&running.url(), &route).await;
            running.stop().await;
            result
        });
        runtime.shutdown_background();
        result
    }

    async fn soak(&self, url: &str, route: &Trajectory) -> anyhow::Result<()> {
        let begun = Instant::now();
        let length = Duration::from_secs_f64(60.0 * self.minutes);
        let mut sessions = JoinSet::new();
        for number in 0..self.sessions {
            let agent = Agent {
                url: url.to_owned(),
                twin: self.twin.twin.clone(),
                route: route.clone(),
                number,
                steps: self.steps,
                until: begun + length,
            };
            sessions.spawn(agent.drive());
        }
        let mut settled = None;
        let mut most = 0;
        let mut next_line = begun;
        let mut total = Driven::default();
        let mut out = io::stdout();
        let mut tick = tokio::time::interval(Duration::from_secs(1));
        loop {
            tokio::select! {
                ended = sessions.join_next() => match ended {
                    None => break,
                    Some(driven) => {
                        let driven = driven.context("a session crashed")??;
                        total.steps += driven.steps;
                        total.rounds += driven.rounds;
                    }
                },
                _ = tick.tick() => {
                    let bytes = rss_bytes()?.now;
                    let elapsed = begun.elapsed();
                    if elapsed >= length.mul_f64(SETTLED_SHARE) {
                        settled.get_or_insert(bytes);
                        most = most.max(bytes);
                    }
                    if Instant::now() >= next_line {
                        next_line += LINE_EVERY;
                        let minutes = elapsed.as_secs_f64() / 60.0;
                        writeln!(out, "{minutes:>6.1} min  {:>8.1} MiB", mib(bytes))?;
                    }
                }
            }
        }
        let settled = settled.unwrap_or(most).max(1);
        let growth = 100.0 * (most as f64 / settled as f64 - 1.0);
        writeln!(
            out,
            "{} steps in {} rounds of {} sessions, every image as in its first round; memory {:.1} MiB, \
             then at most {:.1} MiB ({growth:+.2} %)",
            total.steps,
            total.rounds,
            self.sessions,
            mib(settled),
            mib(most),
        )?;
        if growth > self.growth {
            let message =
                format!("memory grew by {growth:.2} %, and {} % is accepted", self.growth);
            return Err(Exit { code: 1, message }.into());
        }
        Ok(())
    }
}

/// One session's agent.
struct Agent {
    url: String,
    twin: TwinVersion,
    route: Trajectory,
    number: u32,
    steps: u32,
    until: Instant,
}

impl Agent {
    /// Drives rounds until the time is over. A round has a connection and a session of its own.
    async fn drive(self) -> anyhow::Result<Driven> {
        let mut first = BTreeMap::new();
        let mut driven = Driven::default();
        while Instant::now() < self.until {
            let mut client = Client::connect(&self.url, "wildcity bench soak").await?;
            let rig = Some(RigChoice::Full(rig()?));
            let TwinVersion { name, number } = &self.twin;
            client.open(Open { rig, version: *number, ..Open::twin(name) }).await?;
            for step in 0..=self.steps {
                if Instant::now() >= self.until {
                    break;
                }
                let seen = match step {
                    0 => client.reset(0, None).await?,
                    _ => client.step(self.pose(step)).await?,
                };
                seen.verify()?;
                let hash = seen.metadata().frame_hash.clone();
                let known = first.entry(step).or_insert_with(|| hash.clone());
                anyhow::ensure!(
                    *known == hash,
                    "session {}, round {}, step {step}: the images have hash {hash}, and had {known} before",
                    self.number,
                    driven.rounds + 1,
                );
                driven.steps += u64::from(step > 0);
            }
            client.close().await?;
            driven.rounds += 1;
        }
        Ok(driven)
    }

    /// Each session drives another part of the route.
    fn pose(&self, step: u32) -> Pose {
        let length_m = self.route.length_m().max(f64::MIN_POSITIVE);
        let from_m = f64::from(self.number) * 0.37 * length_m;
        let station_m = (from_m + f64::from(step) * 0.1 * SPEED_M_PER_S) % length_m;
        let pose = self.route.at_station(station_m);
        Pose { xyz: pose.position_m.to_array(), q: pose.q_wxyz() }
    }
}

/// Two small cameras, ahead and back.
fn rig() -> anyhow::Result<Rig> {
    let camera = |name: &str, x: f64, q: [f64; 4]| {
        json!({ "name": name, "width": 160, "height": 100, "fx": 100.0, "fy": 100.0, "cx": 80.0, "cy": 50.0,
                "camera_to_rig": { "xyz": [x, 0.0, 1.6], "q": q } })
    };
    let cameras = json!([
        camera("front", 1.9, [0.5, -0.5, 0.5, -0.5]),
        camera("rear", -0.6, [0.5, -0.5, -0.5, 0.5])
    ]);
    Ok(Rig { name: "soak".to_owned(), cameras: serde_json::from_value(cameras)? })
}

fn minutes(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(minutes) if minutes > 0.0 && minutes <= 100_000.0 => Ok(minutes),
        _ => Err("expected minutes above 0, at most 100000".to_owned()),
    }
}
