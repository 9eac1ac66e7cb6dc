//! `wildcity-bench delivery`.

use std::io::{self, Write};
use std::time::{Duration, Instant};

use anyhow::Context as _;

use super::benched_twin::BenchedTwin;
use super::processor::threads_processor_time;
use super::timed::median;
use wildcity::cli::progress;
use wildcity_client::{Client, ConnectOptions, Open, Pose as WirePose};
use wildcity_render::View;
use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_server::Running;
use wildcity_session::options::{Encoding, Outputs, RigChoice};
use wildcity_session::{ImageEncoding, Session, Still, StillViews, Stills};

/// Measure the cost of delivering a step's raw images to an agent on the same machine.
///
/// The same poses are rendered in four ways, in turn: the renderer alone; a session of this
/// process; a client through the socket; and a client with shared memory. Server and client are in
/// this process. Prints, for each way, the median wall time and the median processor time of a
/// step, and the median ratio of its time to that of the renderer alone in the same round.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Delivery {
    #[command(flatten)]
    twin: BenchedTwin,

    /// A rig that is part of the program.
    #[arg(long, value_name = "PRESET", default_value = "vehicle6")]
    rig: String,

    /// Number of rounds, in which each way makes one step; one round before them is not counted.
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    rounds: u32,
}

const EXAMPLES: &str = "\
Examples:
  wildcity-bench delivery demo
  wildcity-bench delivery demo --rig alpamayo1 --rounds 30";

/// The ways, in the order of [`Ways::step`].
const WAYS: [&str; 4] = ["renderer alone", "session", "socket", "shared memory"];

/// The renderer, the session and the clients of the four ways.
struct Ways {
    stills: Stills,
    rig: Rig,
    session: Session,
    socket: Client,
    memory: Client,
}

/// The cost of a step.
#[derive(Clone, Copy, Default)]
struct Cost {
    wall: Duration,
    processor: Duration,
}

impl Delivery {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twin.twins.catalog()?;
        let version = catalog.version(&self.twin.twin.name, self.twin.twin.number)?;
        let trajectory = version.manifest.trajectories.first();
        let route = Route::new(trajectory.context("the twin has no trajectory")?)?;
        let directory = tempfile::tempdir()?;
        let config = self.twin.server(self.twin.twins.dir()?, directory.path())?;
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let costs = runtime.block_on(async {
            let running = wildcity_server::start(config).await?;
            // The server is stopped whether or not measuring failed.
            let costs = self.measure(&running, &route).await;
            running.stop().await;
            costs
        });
        runtime.shutdown_timeout(wildcity::cli::limits::SHUTDOWN_TIMEOUT);
        print(&mut io::stdout().lock(), &costs?)?;
        Ok(())
    }

    /// The costs of each way, round by round.
    async fn measure(
        &self,
        running: &Running,
        route: &Route<'_>,
    ) -> anyhow::Result<Vec<[Cost; 4]>> {
        let mut ways = self.ways(running, route.at(0.0).world_from_rig).await?;
        let bar = progress::count("measuring");
        bar.set_length(u64::from(self.rounds) + 1);
        let mut costs = Vec::new();
        for round in 0..=self.rounds {
            // Half a metre a round: the view changes, and the same data stay in memory.
            let station_m = f64::from(round) * 0.5 % route.length_m();
            let pose = route.at(station_m).world_from_rig;
            let mut of_round = [Cost::default(); 4];
            for turn in 0..WAYS.len() {
                // Each way comes first equally often.
                let way = (turn + round as usize) % WAYS.len();
                // Server and clients are in this process: the time of all threads has both sides of
                // the socket.
                let processor = threads_processor_time()?;
                let begun = Instant::now();
                ways.step(way, pose).await?;
                of_round[way] = Cost {
                    wall: begun.elapsed(),
                    processor: threads_processor_time()?.saturating_sub(processor),
                };
            }
            costs.push(of_round);
            bar.inc(1);
        }
        bar.finish_and_clear();
        // The first round loads the twin and allocates buffers.
        costs.remove(0);
        Ok(costs)
    }

    async fn ways(&self, running: &Running, start: Pose) -> anyhow::Result<Ways> {
        let engine = running.engine().clone();
        let rig =
            Rig::preset(&self.rig).with_context(|| format!("there is no rig {:?}", self.rig))?;
        let options = Open {
            rig: Some(RigChoice::Full(rig.clone().into())),
            ..self.twin.session(Outputs::colour(Encoding::Raw))
        };
        let session = Session::open(engine.clone(), "bench".to_owned(), options).await?;
        let views = View::from_rig(&rig.cameras, start);
        let stills = Stills::open(
            engine,
            session.resident().clone(),
            StillViews { images: &views, sweep: None },
        )
        .await?;
        let shared = ConnectOptions { shared_memory: true, ..ConnectOptions::default() };
        let socket = self.client(running, &ConnectOptions::default()).await?;
        let memory = self.client(running, &shared).await?;
        Ok(Ways { stills, rig, session, socket, memory })
    }

    /// A client with a session of the same rig.
    async fn client(&self, running: &Running, options: &ConnectOptions) -> anyhow::Result<Client> {
        let mut client = Client::connect_with(&running.url(), "bench", options).await?;
        let outputs = Outputs { encoding: Encoding::Raw, ..Outputs::default() };
        let open = Open {
            version: self.twin.twin.number,
            rig: Some(RigChoice::Preset(self.rig.clone())),
            outputs,
            ..Open::twin(&self.twin.twin.name)
        };
        client.open(open).await?;
        Ok(client)
    }
}

impl Ways {
    /// Makes a step in one of [`WAYS`].
    async fn step(&mut self, way: usize, pose: Pose) -> anyhow::Result<()> {
        let there = WirePose { xyz: pose.position_m.to_array(), q: pose.q_wxyz() };
        match way {
            0 => {
                let still = |(view, camera): (View, &wildcity_scene::rig::RigCamera)| Still {
                    view,
                    appearance: camera.appearance.clone(),
                    encoding: ImageEncoding::Raw,
                };
                let views =
                    View::from_rig(&self.rig.cameras, pose).into_iter().zip(&self.rig.cameras);
                let limit = wildcity_protocol::limits::STEP_TIMEOUT;
                self.stills.render(views.map(still).collect(), &[], limit).await?;
            }
            1 => drop(self.session.step(pose, false).await?),
            2 => drop(self.socket.step(there).await?),
            _ => drop(self.memory.step(there).await?),
        }
        Ok(())
    }
}

fn print(out: &mut impl Write, costs: &[[Cost; 4]]) -> io::Result<()> {
    writeln!(
        out,
        "{:<15} {:>10} {:>14} {:>18}",
        "", "wall ms", "processor ms", "of rendering alone"
    )?;
    for (way, name) in WAYS.iter().enumerate() {
        let median_ms = |of: &dyn Fn(&Cost) -> Duration| {
            1e3 * median(costs.iter().map(|round| of(&round[way]).as_secs_f64()))
        };
        let wall_ms = median_ms(&|cost| cost.wall);
        let processor_ms = median_ms(&|cost| cost.processor);
        // Within a round, so that a clock that rises during the measurement does not matter.
        let share = |round: &[Cost; 4]| round[way].processor.div_duration_f64(round[0].processor);
        let ratio = median(costs.iter().map(share));
        writeln!(out, "{name:<15} {wall_ms:>10.1} {processor_ms:>14.1} {ratio:>18.3}")?;
    }
    Ok(())
}
