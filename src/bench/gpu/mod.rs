//! `wildcity-bench gpu`: measures a device with one command.

mod report;

use std::io::{self, Write};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};

use self::report::{Images, Report, SceneReport, StageReport};
use super::timed::{Timed, time};
use wildcity::cli::progress;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gpu::{self, AdapterChoice, FrameCounts, Roofline};
use wildcity_render::{Backend, Frame, View};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{RenderProfile, Rig, Scene};

/// Measure a device: the time of each stage of a step with six full cameras, in streets of several
/// sizes, next to the limit of the device's memory and an estimate of its arithmetic (its
/// roofline).
///
/// Prints tables in Markdown. The streets are generated in memory and are the same on every machine
/// up to rounding. Times of stages are device time, by the device's clock. Rows marked "host" are
/// host time; the last of them, "unaccounted", is the rest of the step: copying pixels to memory
/// that the host can read, mapping it, and waiting between submissions. So the rows add up to the
/// step as its caller sees it. The peak rates of the device are measured in the same run, by a copy
/// and by a loop of multiply-adds. The bytes that a stage must move are computed from the counts of
/// the frame (`src/render/gpu/bandwidth.rs` has the formulas). The cpu backend draws the same step
/// for comparison, and the first images of both are compared, so that a device that is fast but
/// wrong is detected.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Gpu {
    /// Numbers of Gaussians of the streets.
    #[arg(
        long,
        value_name = "COUNT,...",
        value_delimiter = ',',
        default_value = "1000000,5000000,20000000",
        value_parser = clap::value_parser!(u32).range(1..=MOST_GAUSSIANS)
    )]
    gaussians: Vec<u32>,

    /// The device: its number in `wildcity dev devices`, or a part of its name. Default: the
    /// fastest kind.
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,

    /// Frames to time. Before them, at least two frames, and frames for a second, are rendered and
    /// not timed.
    #[arg(long, default_value_t = 9, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    repeat: u32,

    /// Do not run the cpu backend, and do not compare images.
    #[arg(long)]
    no_cpu: bool,

    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity-bench gpu
  wildcity-bench gpu --gaussians 100000 --repeat 3 --device llvmpipe
  wildcity-bench gpu --json > report.json";

/// Largest number of Gaussians of a street: each takes 200 B while the street is made.
const MOST_GAUSSIANS: i64 = 100_000_000;
/// Untimed frames before the timed ones: the first one uploads the scene and allocates buffers.
const WARM_UP: u32 = 2;
/// Least time of the untimed frames: a graphics card that was idle needs hundreds of milliseconds
/// to raise its clock.
const WARM_UP_TIME: Duration = Duration::from_secs(1);

impl Gpu {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let named = |name: &String| AdapterChoice::Named(name.clone());
        let choice = self.device.as_ref().map_or(AdapterChoice::Best, named);
        let device = gpu::Gpu::new(&choice, 0)?;
        let cpu = (!self.no_cpu).then(|| Cpu::new(0, Simd::Best)).transpose()?;
        let roofline = device.roofline()?;
        let mut report = Report { device: device.detail(), roofline, scenes: Vec::new() };
        for &gaussians in &self.gaussians {
            let scene = self.scene(gaussians, &device, cpu.as_ref(), &roofline);
            report.scenes.push(scene.with_context(|| format!("{gaussians} Gaussians"))?);
        }
        let mut out = io::stdout().lock();
        if self.json {
            writeln!(out, "{}", serde_json::to_string(&report)?)?
        } else {
            write!(out, "{report}")?
        }
        Ok(())
    }

    fn scene(
        &self,
        gaussians: u32,
        device: &gpu::Gpu,
        cpu: Option<&Cpu>,
        roofline: &Roofline,
    ) -> anyhow::Result<SceneReport> {
        let bar = progress::count("making");
        let scene = Scene::from_gaussians(&wildcity_generate::canyon(
            gaussians as usize,
            &mut progress::show(&bar),
        ));
        bar.finish_and_clear();
        let views = views()?;
        let usage = || device.usage().context("the device was lost");
        let profile = RenderProfile::default();
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let warm_up = Instant::now();
        time(device, &frame, WARM_UP, "gpu")?;
        while warm_up.elapsed() < WARM_UP_TIME {
            time(device, &frame, 1, "gpu")?;
        }
        // Some counters only grow: what the warm-up has added to them is subtracted below.
        let before = usage()?;
        let own = time(device, &frame, self.repeat, "gpu")?;
        let usage = usage()?;
        let cpu = cpu.map(|cpu| {
            // The second of warm-up is for the clock of a graphics card: here two frames suffice.
            time(cpu, &frame, WARM_UP, "cpu")?;
            time(cpu, &frame, self.repeat, "cpu")
        });
        let cpu = cpu.transpose()?;
        let stages = stages(&own, &usage.last_frame, roofline);
        Ok(SceneReport {
            gaussians,
            mirror_bytes: usage.mirror_bytes,
            visible_pairs: usage.last_frame.splats,
            touches: usage.last_frame.touches,
            instances: usage.last_frame.instances,
            evaluations: own.stats.evaluations,
            frames: self.repeat,
            regions: usage.regions.saturating_sub(before.regions),
            retries: usage.retries.saturating_sub(before.retries),
            host_ms: host(&own, &usage.last_frame, &stages),
            stages,
            step_ms: own.step_ms(),
            cpu_step_ms: cpu.as_ref().map(Timed::step_ms),
            images: cpu.map(|cpu| Images::compare(&own.images[0], &cpu.images[0])).transpose()?,
        })
    }
}

/// The views of a vehicle in the middle of the street: 3 x 1440x928 and 3 x 1240x728.
fn views() -> anyhow::Result<Vec<View>> {
    let rig = Rig::preset("vehicle6").context("the rig vehicle6 comes with the program")?;
    ensure!(!rig.cameras.is_empty(), "the rig vehicle6 has no cameras");
    Ok(View::from_rig(&rig.cameras, Pose::IDENTITY))
}

/// Device time, bytes, and rooflines of each stage; empty for a device without a clock.
fn stages(own: &Timed, counts: &FrameCounts, roofline: &Roofline) -> Vec<StageReport> {
    let bytes = counts.stage_bytes().into_iter();
    let stages = bytes.filter_map(|(stage, bytes)| {
        let device_ms = own.stats.stages_ms.iter().find(|(name, _)| *name == stage)?.1;
        // Of the other stages only the traffic is estimated.
        let operations = if stage == "rasterize" { counts.rasterize_operations() } else { 0 };
        Some(StageReport::new(stage, device_ms, bytes, operations, roofline))
    });
    stages.collect()
}

/// Host times: those that the host measured, then the rest of the step.
fn host(own: &Timed, counts: &FrameCounts, stages: &[StageReport]) -> Vec<(&'static str, f64)> {
    let bytes = counts.stage_bytes();
    // A stage without a count of bytes is not one of the device.
    let is_host = |name: &str| bytes.iter().all(|(stage, _)| *stage != name);
    let timed = own.stats.stages_ms.iter().filter(|(name, _)| is_host(name));
    let mut host_ms: Vec<(&'static str, f64)> = timed.copied().collect();
    let host_sum_ms: f64 = host_ms.iter().map(|(_, ms)| ms).sum();
    let device_sum_ms: f64 = stages.iter().map(StageReport::device_ms).sum();
    host_ms.push(("unaccounted", own.step_ms() - device_sum_ms - host_sum_ms));
    host_ms
}
