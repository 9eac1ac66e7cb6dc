//! `wildcity-bench drive`.

mod report;
mod step;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;

use wildcity::cli::{output, progress};
use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_scene::{Manifest, Rig};
use wildcity_session::Session;
use wildcity_session::options::{Open, Outputs, RigChoice, Start};
use wildcity_twin::residency::Stats;

use super::benched_twin::BenchedTwin;
use super::memory::rss_bytes;
use report::{Report, Row};
use step::DriveStep;

/// Time a drive along a twin's first trajectory, in a session without a network.
///
/// Drives at a constant speed with ten steps per second. Each step starts 0.1 s after the previous
/// one, or as soon as the previous one is done if that took longer, like an agent that runs in real
/// time. For every kilometre, prints how long the steps took, how many of them waited for the disk
/// and for how long, and how much memory was in use.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Drive {
    #[command(flatten)]
    twin: BenchedTwin,

    /// Speed, in m/s.
    #[arg(long, value_name = "M_PER_S", default_value_t = 30.0, value_parser = speed)]
    speed_m_s: f64,

    /// Distance along the trajectory at which the drive starts, in metres.
    #[arg(long, value_name = "M", default_value_t = 0.0, value_parser = distance)]
    from_m: f64,

    /// Number of steps, of 0.1 s each [default: to the end of the trajectory]
    #[arg(long, value_name = "N")]
    steps: Option<u32>,

    /// Divide the width and height of every camera by N and render only the middle of its image.
    /// The same Gaussians must be in memory as for whole images, but there is less to render.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    crop: u32,

    /// Start each step as soon as the previous one is done, instead of in real time.
    #[arg(long)]
    unpaced: bool,

    /// Number of jumps to scattered places of the trajectory after the drive.
    #[arg(long, value_name = "N", default_value_t = 0)]
    teleports: u32,

    /// CSV file to write, with a line for every step and jump.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,

    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity-bench drive city --memory-gib 2 --crop 4 --teleports 200
  wildcity-bench drive city --from-m 9000 --steps 600 --json | jq .all";

impl Drive {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let episodes = tempfile::tempdir()?;
        let (engine, version) = self.twin.start(episodes.path())?;
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let report = runtime.block_on(self.drive(engine, &version.manifest))?;
        if let Some(path) = &self.csv {
            output::write(path, report.csv().as_bytes())?;
        }
        report.print(self.json)
    }

    async fn drive(
        &self,
        engine: Arc<wildcity_session::Engine>,
        manifest: &Manifest,
    ) -> anyhow::Result<Report> {
        let trajectory = manifest
            .trajectories
            .first()
            .with_context(|| format!("twin {:?} has no trajectory", manifest.twin))?;
        let route = Route::new(trajectory)?;

        // Open the session, and render the first frame.
        let opened = Instant::now();
        let session = Session::open(engine.clone(), "bench".into(), self.opening(manifest)).await?;
        let open = opened.elapsed();
        let start = Start::from(route.at(self.from_m).world_from_rig);
        let mut driving = DrivingSession { session, engine, last: Stats::default() };
        let first = Instant::now();
        driving.session.reset(0, Some(start)).await?;
        let first = first.elapsed();
        driving.last = driving.engine.residency();

        // Drive.
        let step_m = self.speed_m_s * wildcity_session::limits::DT_US as f64 * 1e-6;
        let to_the_end = ((route.length_m() - self.from_m) / step_m).max(0.0) as u32;
        let count = self.steps.unwrap_or(to_the_end).min(to_the_end);
        let bar = progress::count("driving");
        bar.set_length(u64::from(count) + u64::from(self.teleports));
        let mut steps = Vec::with_capacity(count as usize);
        let begun = tokio::time::Instant::now();
        for number in 1..=count {
            if !self.unpaced {
                let due = Duration::from_micros(
                    u64::from(number) * wildcity_session::limits::DT_US as u64,
                );
                tokio::time::sleep_until(begun + due).await;
            }
            let station_m = self.from_m + f64::from(number) * step_m;
            let pose = route.at(station_m).world_from_rig;
            steps.push(driving.step(station_m, pose).await?);
            bar.inc(1);
        }

        // Jump.
        let mut jumps = Vec::with_capacity(self.teleports as usize);
        for number in 0..self.teleports {
            let station_m = route.length_m() * scattered(number);
            let pose = route.at(station_m).world_from_rig;
            jumps.push(driving.step(station_m, pose).await?);
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(Report {
            twin: manifest.twin.clone(),
            gaussians: manifest.gaussians(),
            length_m: route.length_m(),
            speed_m_s: self.speed_m_s,
            backend: driving.engine.backend(),
            cameras: Row::cameras(driving.session.cameras()),
            reserved_bytes: driving.session.reserved_bytes(),
            open,
            first,
            steps,
            jumps,
            peak_rss_bytes: rss_bytes()?.peak,
            stats: driving.engine.residency(),
        })
    }

    fn opening(&self, manifest: &Manifest) -> Open {
        let rig = manifest
            .rig
            .clone()
            .or_else(|| Rig::preset(wildcity_session::limits::RIG))
            .map(|rig| cropped(rig, self.crop));
        let outputs = Outputs::default();
        Open { rig: rig.map(|rig| RigChoice::Full(rig.into())), ..self.twin.session(outputs) }
    }
}

/// A session that drives, with the statistics of its engine after the last step.
struct DrivingSession {
    session: Session,
    engine: Arc<wildcity_session::Engine>,
    last: Stats,
}

impl DrivingSession {
    async fn step(&mut self, station_m: f64, pose: Pose) -> anyhow::Result<DriveStep> {
        let begun = Instant::now();
        let stepped = self.session.step(pose, false).await;
        stepped.with_context(|| format!("at {station_m:.1} m of the trajectory"))?;
        let step = begun.elapsed();
        let before = self.last;
        let now = self.engine.residency();
        self.last = now;
        Ok(DriveStep {
            station_m,
            step,
            waited: now.wait_time.saturating_sub(before.wait_time),
            misses: now.misses - before.misses,
            loads: now.loads - before.loads,
            evictions: now.evictions - before.evictions,
            held_bytes: now.held_bytes,
            rss_bytes: rss_bytes()?.now,
        })
    }
}

/// The rig with only the middle of each image.
fn cropped(mut rig: Rig, crop: u32) -> Rig {
    for camera in rig.cameras.iter_mut().map(|camera| &mut camera.camera) {
        let width_px = camera.width_px;
        let height_px = camera.height_px;
        camera.width_px = (width_px / crop).max(1);
        camera.height_px = (height_px / crop).max(1);
        camera.pinhole.cx -= 0.5 * f64::from(width_px - camera.width_px);
        camera.pinhole.cy -= 0.5 * f64::from(height_px - camera.height_px);
    }
    rig
}

/// Numbers that fill [0, 1) evenly without being sorted: multiples of the golden ratio, modulo 1.
fn scattered(number: u32) -> f64 {
    (0.5 + 0.618_033_988_749_895 * f64::from(number)).fract()
}

fn speed(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(speed_m_s) if (0.1..=1000.0).contains(&speed_m_s) => Ok(speed_m_s),
        _ => Err("expected 0.1 to 1000 m/s, for example 30".to_owned()),
    }
}

fn distance(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(distance_m) if (0.0..=1e7).contains(&distance_m) => Ok(distance_m),
        _ => Err("expected 0 to 1e7 m, for example 9000".to_owned()),
    }
}
