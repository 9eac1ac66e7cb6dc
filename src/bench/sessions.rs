//! `wildcity-bench sessions`.

use std::io::{self, Write};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use serde_json::json;

use super::benched_twin::BenchedTwin;
use super::processor::processor_time;
use super::size::Size;
use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_scene::{Manifest, Rig};
use wildcity_session::options::{Encoding, Open, Outputs, RigChoice, Start};
use wildcity_session::{Engine, Session};

/// Measure how many steps per second several sessions on one twin make together, without a network.
///
/// Every session drives along the twin's first trajectory, each from another place, as fast as it
/// can. For each number of sessions, prints the steps per second of all together, the time of a
/// step, the processor time of a step, and the time of a step beyond its pixels: the part that is
/// neither waiting for the renderer nor rendering.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Sessions {
    #[command(flatten)]
    twin: BenchedTwin,

    /// Numbers of sessions.
    #[arg(long, value_name = "N,..", value_delimiter = ',', default_values_t = [1, 2, 4, 8, 16],
        value_parser = clap::value_parser!(u32).range(1..=256))]
    sessions: Vec<u32>,

    /// A rig that is part of the program [default: the twin's]
    #[arg(long, value_name = "PRESET")]
    rig: Option<String>,

    /// Size of all images, for example 96x60 [default: the cameras' own]
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,

    /// Format of the images: jpeg, png or raw.
    #[arg(long, value_name = "FORMAT", default_value = "jpeg", value_parser = encoding)]
    encoding: Encoding,

    /// How long to measure each number of sessions, in seconds.
    #[arg(long, value_name = "S", default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=3600))]
    seconds: u64,

    /// Print one JSON object per number of sessions on standard output.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity-bench sessions demo --size 96x60
  wildcity-bench sessions demo --rig alpamayo2 --size 576x320 --encoding raw --json";

/// One step of one session.
#[derive(Clone, Copy)]
struct StepTime {
    whole: Duration,
    /// The part that is neither waiting for the renderer nor rendering.
    beyond_pixels: Duration,
}

/// One row of the table.
struct Row {
    sessions: usize,
    steps_per_s: f64,
    step_ms: f64,
    step_p95_ms: f64,
    step_p99_ms: f64,
    processor_ms: f64,
    beyond_pixels_ms: f64,
}

impl Sessions {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let episodes = tempfile::tempdir()?;
        let (engine, version) = self.twin.start(episodes.path())?;
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let mut out = io::stdout().lock();
        if !self.json {
            writeln!(
                out,
                "{:>8} {:>9} {:>9} {:>9} {:>9} {:>14} {:>14}",
                "sessions",
                "steps/s",
                "step ms",
                "p95 ms",
                "p99 ms",
                "processor ms",
                "beyond pixels"
            )?;
        }
        for &count in &self.sessions {
            let row = runtime.block_on(self.measure(&engine, &version.manifest, count))?;
            row.print(&mut out, self.json)?;
        }
        Ok(())
    }

    /// Opens sessions, lets all of them drive for the same time, and closes them.
    async fn measure(
        &self,
        engine: &Arc<Engine>,
        manifest: &Manifest,
        count: u32,
    ) -> anyhow::Result<Row> {
        let trajectory = manifest
            .trajectories
            .first()
            .with_context(|| format!("twin {:?} has no trajectory", manifest.twin))?;
        let route = Route::new(trajectory)?;
        // Poses along the route, one per step.
        let count_of_poses = (route.length_m() / Driver::STEP_M) as usize + 1;
        let poses: Arc<[Pose]> = (0..count_of_poses)
            .map(|index| route.at(index as f64 * Driver::STEP_M).world_from_rig)
            .collect();
        let mut drivers = Vec::new();
        for number in 0..count {
            // Spread evenly: at one place all sessions would need the same parts of the twin.
            let at = poses.len() * number as usize / count as usize;
            let name = format!("bench-{number}");
            let options = self.options(manifest)?;
            let mut session = Session::open(engine.clone(), name, options).await?;
            let start = Start::from(poses[at]);
            session.reset(0, Some(start)).await?;
            drivers.push(Driver { session, poses: poses.clone(), at });
        }

        let processor_before = processor_time()?;
        let begun = Instant::now();
        let end = begun + Duration::from_secs(self.seconds);
        let tasks: Vec<_> =
            drivers.into_iter().map(|driver| tokio::spawn(driver.drive_until(end))).collect();
        let mut steps = Vec::new();
        for task in tasks {
            steps.extend(task.await??);
        }
        // Measured to the end of the last step, which may be after `end`: all its steps are
        // counted.
        let took = begun.elapsed();
        let processor = processor_time()?.saturating_sub(processor_before);
        anyhow::ensure!(!steps.is_empty(), "no step ended within {} s", self.seconds);
        let ms = |of: &dyn Fn(&StepTime) -> Duration, share: f64| {
            let mut all: Vec<f64> = steps.iter().map(|step| of(step).as_secs_f64() * 1e3).collect();
            all.sort_by(f64::total_cmp);
            all[((all.len() - 1) as f64 * share) as usize]
        };
        Ok(Row {
            sessions: count as usize,
            steps_per_s: steps.len() as f64 / took.as_secs_f64(),
            step_ms: ms(&|step| step.whole, 0.5),
            step_p95_ms: ms(&|step| step.whole, 0.95),
            step_p99_ms: ms(&|step| step.whole, 0.99),
            processor_ms: processor.as_secs_f64() * 1e3 / steps.len() as f64,
            beyond_pixels_ms: ms(&|step| step.beyond_pixels, 0.5),
        })
    }

    fn options(&self, manifest: &Manifest) -> anyhow::Result<Open> {
        let preset = |name: &str| {
            let known: Vec<&str> = Rig::preset_names().collect();
            Rig::preset(name).with_context(|| {
                format!("there is no rig {name:?}; the presets are {}", known.join(", "))
            })
        };
        let mut rig = match (&self.rig, &manifest.rig) {
            (Some(name), _) => preset(name)?,
            (None, Some(rig)) => rig.clone(),
            (None, None) => preset(wildcity_session::limits::RIG)?,
        };
        if let Some(size) = self.size {
            size.apply(&mut rig)?;
        }
        Ok(Open {
            rig: Some(RigChoice::Full(rig.into())),
            ..self.twin.session(Outputs::colour(self.encoding))
        })
    }
}

/// A session that drives in circles.
struct Driver {
    session: Session,
    /// Poses along the route.
    poses: Arc<[Pose]>,
    /// Index of the last pose.
    at: usize,
}

impl Driver {
    /// Distance of a step, in metres: 30 m/s at ten steps per second.
    const STEP_M: f64 = 3.0;

    /// Steps until the given moment. Starts over at the end of the route.
    async fn drive_until(mut self, end: Instant) -> anyhow::Result<Vec<StepTime>> {
        let mut steps = Vec::new();
        while Instant::now() < end {
            self.at = (self.at + 1) % self.poses.len();
            let pose = self.poses[self.at];
            let begun = Instant::now();
            let observation = self.session.step(pose, false).await?;
            let whole = begun.elapsed();
            let timings = &observation.timings;
            let beyond_pixels = whole.saturating_sub(timings.queue + timings.render);
            steps.push(StepTime { whole, beyond_pixels });
        }
        Ok(steps)
    }
}

impl Row {
    fn print(&self, out: &mut impl Write, as_json: bool) -> io::Result<()> {
        let Self {
            sessions,
            steps_per_s,
            step_ms,
            step_p95_ms,
            step_p99_ms,
            processor_ms,
            beyond_pixels_ms,
        } = self;
        if as_json {
            let row = json!({
                "sessions": sessions,
                "steps_per_s": steps_per_s,
                "step_ms": step_ms,
                "step_p95_ms": step_p95_ms,
                "step_p99_ms": step_p99_ms,
                "processor_ms": processor_ms,
                "beyond_pixels_ms": beyond_pixels_ms,
            });
            return writeln!(out, "{row}");
        }
        writeln!(
            out,
            "{sessions:>8} {steps_per_s:>9.1} {step_ms:>9.2} {step_p95_ms:>9.2} {step_p99_ms:>9.2} {processor_ms:>14.2} \
             {beyond_pixels_ms:>14.3}"
        )
    }
}

fn encoding(text: &str) -> Result<Encoding, String> {
    match text {
        "jpeg" => Ok(Encoding::Jpeg),
        "png" => Ok(Encoding::Png),
        "raw" => Ok(Encoding::Raw),
        _ => Err("expected jpeg, png or raw".to_owned()),
    }
}
