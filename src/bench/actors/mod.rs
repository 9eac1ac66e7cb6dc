//! `wildcity-bench actors`.

mod street;

use std::io::{self, Write};
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde_json::json;

use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_scene::geometry::Pose;
use wildcity_session::options::{Encoding, Open, Outputs, RigChoice, Start};
use wildcity_session::{Engine, Observation, Session};
use wildcity_twin::store::Catalog;

use super::benched_twin::BenchedTwin;
use super::processor::processor_time;
use super::size::Size;
use super::timed::median;
use street::Cars;
use wildcity::cli::progress;

/// Measure the cost of actors: a step among cars that are actors, against one in a twin that
/// contains the same cars.
///
/// Cars stand in two lanes around the middle of the twin's first trajectory. Both twins, without a
/// sky, and the car's asset are made in a temporary directory. One session in each drives through
/// the same poses, in turn; images are raw. Prints the median step of each, the median of the
/// ratios of the pairs, and the processor time of all steps; first at full detail, where both draw
/// the same Gaussians, and then with the levels of detail that the twin's profile asks for.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Actors {
    #[command(flatten)]
    twin: BenchedTwin,

    /// Number of cars.
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=256))]
    cars: u32,

    /// Number of Gaussians of a car: the largest ones of the generated sedan are halved until this
    /// number is reached.
    #[arg(long, value_name = "N", default_value_t = 100_000,
        value_parser = clap::value_parser!(u32).range(1_000..=1_000_000))]
    gaussians: u32,

    /// Pairs of steps to time.
    #[arg(long, value_name = "N", default_value_t = 9, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pairs: u32,

    /// Size of all images, for example 96x60 [default: the cameras' own]
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,

    /// Print one JSON object for each level of detail on standard output.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity-bench actors demo
  wildcity-bench actors demo --backend cpu --cars 10 --pairs 21 --json | jq .ratio";

/// How far the ego drives in one step, in metres: the view must change, and the same cars must stay
/// in it.
const STEP_M: f64 = 0.1;

/// Steps of one session.
#[derive(Default)]
struct Times {
    steps_ms: Vec<f64>,
    processor: Duration,
    /// The times of the render stages, step by step.
    stages_ms: Vec<Vec<(&'static str, f64)>>,
}

/// Both sessions at one level of detail.
struct Row {
    tau_px: f64,
    actors: Times,
    baked: Times,
    /// PSNR between the last images of both, in dB. Only actors have contact shadows.
    psnr_db: f64,
}

impl Actors {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let temporary = tempfile::tempdir()?;
        let source = self.twin.twins.catalog()?;
        let version = source.version(&self.twin.twin.name, self.twin.twin.number)?;
        let catalog = Catalog::open(&temporary.path().join("twins"))?;
        let cars = street::commit(&source, &version, [self.cars, self.gaussians], &catalog)?;
        let engine = self.twin.engine(catalog, &temporary.path().join("episodes"))?;
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let mut out = io::stdout().lock();
        if !self.json {
            writeln!(
                out,
                "{} Gaussians of the twin, and {} cars of {}; {}",
                version.manifest.gaussians(),
                self.cars,
                self.gaussians,
                engine.backend()
            )?;
        }
        // 0 draws full detail in both, so that they have the same Gaussians.
        for tau_px in [0.0, version.manifest.profile.tau_px] {
            let row = runtime.block_on(self.measure(&engine, &cars, tau_px))?;
            self.print(&row, &mut out)?;
        }
        Ok(())
    }

    /// Steps both sessions in turn.
    async fn measure(&self, engine: &Arc<Engine>, cars: &Cars, tau_px: f64) -> anyhow::Result<Row> {
        let name = |kind: &str| format!("bench-{kind}");
        let open = |kind: &'static str, options| Session::open(engine.clone(), name(kind), options);
        let mut actors = open("actors", self.options(cars, tau_px, true)?).await?;
        let mut baked = open("baked", self.options(cars, tau_px, false)?).await?;
        let mut row =
            Row { tau_px, actors: Times::default(), baked: Times::default(), psnr_db: f64::NAN };
        for session in [&mut actors, &mut baked] {
            session.reset(0, Some(Start::from(cars.ego_at(0.0)))).await?;
        }
        let bar = progress::count("stepping");
        bar.set_length(self.pairs.into());
        for pair in 1..=self.pairs {
            let pose = cars.ego_at(STEP_M * f64::from(pair));
            // Each is the first one in every second pair.
            let mut seen = Vec::new();
            for is_actors in [pair % 2 == 0, pair % 2 != 0] {
                let (session, times) = if is_actors {
                    (&mut actors, &mut row.actors)
                } else {
                    (&mut baked, &mut row.baked)
                };
                seen.push(times.step(session, pose).await?);
            }
            row.psnr_db = psnr_db_u8(pixels(&seen[0]).iter().zip(pixels(&seen[1])));
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(row)
    }

    fn options(&self, cars: &Cars, tau_px: f64, as_actors: bool) -> anyhow::Result<Open> {
        let mut rig = cars.rig.clone();
        if let Some(size) = self.size {
            size.apply(&mut rig)?;
        }
        let scenario = serde_json::from_value(cars.scenario())?;
        let twin = if as_actors { street::BARE } else { street::BAKED };
        Ok(Open {
            rig: Some(RigChoice::Full(rig.into())),
            profile: [("tau_px".to_owned(), json!(tau_px))].into_iter().collect(),
            scenario: as_actors.then_some(scenario),
            outputs: Outputs::colour(Encoding::Raw),
            ..Open::twin(twin)
        })
    }

    fn print(&self, row: &Row, out: &mut impl Write) -> io::Result<()> {
        let Row { tau_px, actors, baked, psnr_db } = row;
        let [actors_ms, baked_ms] =
            [actors, baked].map(|times| median(times.steps_ms.iter().copied()));
        let ratios =
            actors.steps_ms.iter().zip(&baked.steps_ms).map(|(actors, baked)| actors / baked);
        let ratio = median(ratios);
        let [actors_cpu_ms, baked_cpu_ms] = [actors, baked]
            .map(|times| times.processor.as_secs_f64() * 1e3 / times.steps_ms.len() as f64);
        let processor_ratio = actors_cpu_ms / baked_cpu_ms;
        let [actors_stages, baked_stages] = [actors, baked].map(Times::stages);
        if self.json {
            let object = |stages: &[(&'static str, f64)]| -> serde_json::Map<_, _> {
                stages.iter().map(|(name, ms)| ((*name).to_owned(), json!(ms))).collect()
            };
            let row = json!({
                "tau_px": tau_px,
                "cars": self.cars,
                "gaussians": self.gaussians,
                "pairs": self.pairs,
                "actors_ms": actors_ms,
                "baked_ms": baked_ms,
                "ratio": ratio,
                "actors_processor_ms": actors_cpu_ms,
                "baked_processor_ms": baked_cpu_ms,
                "processor_ratio": processor_ratio,
                "actors_stages_ms": object(&actors_stages),
                "baked_stages_ms": object(&baked_stages),
                "psnr_db": psnr_db,
            });
            return writeln!(out, "{row}");
        }
        writeln!(out, "\ntau {tau_px} px; images differ by {psnr_db:.1} dB")?;
        writeln!(out, "{:<16} {:>10} {:>10} {:>6}", "", "actors", "in the twin", "ratio")?;
        let mut line = |name: &str, actors_ms: f64, baked_ms: f64, ratio: f64| {
            writeln!(out, "{name:<16} {actors_ms:>7.1} ms {baked_ms:>8.1} ms {ratio:>6.3}")
        };
        line("step", actors_ms, baked_ms, ratio)?;
        line("processor", actors_cpu_ms, baked_cpu_ms, processor_ratio)?;
        for ((name, actors_ms), (_, baked_ms)) in actors_stages.iter().zip(&baked_stages) {
            line(name, *actors_ms, *baked_ms, actors_ms / baked_ms)?;
        }
        Ok(())
    }
}

/// The tensors of an observation, which follow its header: almost all of them pixels.
fn pixels(seen: &Observation) -> &[u8] {
    let bytes = seen.buffer.bytes();
    let length = seen.tensors.last().map_or(0, |tensor| tensor.bytes.end);
    &bytes[bytes.len().saturating_sub(length)..]
}

impl Times {
    /// Steps to a pose, and notes how long it took.
    async fn step(&mut self, session: &mut Session, pose: Pose) -> anyhow::Result<Observation> {
        let processor_before = processor_time()?;
        let begun = Instant::now();
        let seen = session.step(pose, false).await?;
        self.steps_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        self.processor += processor_time()?.saturating_sub(processor_before);
        self.stages_ms.push(seen.timings.stages_ms.clone());
        Ok(seen)
    }

    /// The median time of each stage.
    fn stages(&self) -> Vec<(&'static str, f64)> {
        let first = self.stages_ms.first().into_iter().flatten();
        // A renderer reports the same stages in the same order with every frame.
        let of = |index: usize| self.stages_ms.iter().map(move |stages| stages[index].1);
        first.enumerate().map(|(index, (name, _))| (*name, median(of(index)))).collect()
    }
}
