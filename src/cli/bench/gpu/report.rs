//! What `wildcity bench gpu` found, as Markdown and as JSON.

use std::fmt;

use serde::Serialize;

use crate::render::gpu::Roofline;

/// The goal: a step of six full cameras at as many visible pairs.
const GOAL_MS: f64 = 4.7;
const GOAL_PAIRS: f64 = 5e6;

/// One device.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub(super) device: String,
    #[serde(serialize_with = "measured")]
    pub(super) roofline: Roofline,
    pub(super) scenes: Vec<SceneReport>,
}

/// One scene, medians of all frames.
#[derive(Debug, Serialize)]
pub(super) struct SceneReport {
    pub(super) gaussians: u32,
    pub(super) mirror_bytes: u64,
    pub(super) visible_pairs: u64,
    pub(super) touches: u64,
    pub(super) instances: u64,
    pub(super) evaluations: u64,
    /// Empty for a device without a clock.
    pub(super) stages: Vec<StageReport>,
    pub(super) host_ms: Vec<(&'static str, f64)>,
    pub(super) step_ms: f64,
    pub(super) cpu_step_ms: Option<f64>,
    /// Of the first image against the cpu backend's; JSON's null for equal ones.
    pub(super) psnr_db: Option<f64>,
}

/// One stage.
#[derive(Debug, Serialize)]
pub(super) struct StageReport {
    stage: &'static str,
    device_ms: f64,
    bytes: u64,
    memory_ms: f64,
    arithmetic_ms: f64,
    /// The larger roofline, as a part of the time.
    share: f64,
}

impl StageReport {
    pub(super) fn new(
        stage: &'static str,
        device_ms: f64,
        bytes: u64,
        operations: u64,
        roofline: &Roofline,
    ) -> Self {
        let memory_ms = bytes as f64 / roofline.bytes_per_s * 1e3;
        let arithmetic_ms = operations as f64 / roofline.multiply_adds_per_s * 1e3;
        let share = memory_ms.max(arithmetic_ms) / device_ms;
        Self { stage, device_ms, bytes, memory_ms, arithmetic_ms, share }
    }
}

fn measured<S: serde::Serializer>(roofline: &Roofline, to: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Measured {
        bytes_per_s: f64,
        multiply_adds_per_s: f64,
    }
    let Roofline { bytes_per_s, multiply_adds_per_s } = *roofline;
    Measured { bytes_per_s, multiply_adds_per_s }.serialize(to)
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Roofline { bytes_per_s, multiply_adds_per_s } = self.roofline;
        writeln!(
            f,
            "{}: copies {:.0} GB/s, {:.2} T multiply-adds/s, measured in this run",
            self.device,
            bytes_per_s / 1e9,
            multiply_adds_per_s / 1e12
        )?;
        self.scenes.iter().try_for_each(|scene| write!(f, "\n{scene}"))
    }
}

impl fmt::Display for SceneReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} Gaussians ({} MB on the device), six cameras, {} visible pairs, {} touches of macro \
             tiles, {} instances, {} evaluations:\n",
            grouped(self.gaussians.into()),
            self.mirror_bytes / 1_000_000,
            grouped(self.visible_pairs),
            grouped(self.touches),
            grouped(self.instances),
            grouped(self.evaluations)
        )?;
        writeln!(
            f,
            "| stage | device ms | MB | memory roofline ms | arithmetic roofline ms | share |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|")?;
        let row = |f: &mut fmt::Formatter<'_>, name: &str, stage: &StageReport| {
            let StageReport { device_ms, bytes, memory_ms, arithmetic_ms, share, .. } = *stage;
            let (mb, percent) = (bytes as f64 / 1e6, 100.0 * share);
            writeln!(
                f,
                "| {name} | {device_ms:.3} | {mb:.1} | {memory_ms:.3} | {arithmetic_ms:.3} | \
                 {percent:.0} % |"
            )
        };
        for stage in &self.stages {
            row(f, stage.stage, stage)?;
        }
        let all = self.all();
        row(f, "**device**", &all)?;
        for (name, ms) in &self.host_ms {
            writeln!(f, "| {name} (host) | {ms:.3} | | | | |")?;
        }
        writeln!(f, "| **step** | {:.3} | | | | |", self.step_ms)?;
        if let Some(cpu_step_ms) = self.cpu_step_ms {
            let ratio = cpu_step_ms / self.step_ms;
            writeln!(
                f,
                "| cpu backend's step | {cpu_step_ms:.3} | | | | {ratio:.2} times the gpu's |"
            )?;
        }
        let goal_ms = GOAL_MS * self.visible_pairs as f64 / GOAL_PAIRS;
        writeln!(
            f,
            "\nGoal {GOAL_MS} ms at 5 million visible pairs, so {goal_ms:.3} ms here: the device takes \
             {:.2} times that.",
            all.device_ms / goal_ms
        )?;
        match self.psnr_db {
            Some(db) if db.is_infinite() => {
                writeln!(f, "The first image equals the cpu backend's.")
            }
            Some(db) => writeln!(f, "The first image is {db:.1} dB from the cpu backend's."),
            None => Ok(()),
        }
    }
}

impl SceneReport {
    /// All stages; of the rooflines the larger one of each.
    fn all(&self) -> StageReport {
        let sum = |of: fn(&StageReport) -> f64| self.stages.iter().map(of).sum::<f64>();
        let device_ms = sum(|stage| stage.device_ms);
        StageReport {
            stage: "device",
            device_ms,
            bytes: self.stages.iter().map(|stage| stage.bytes).sum(),
            memory_ms: sum(|stage| stage.memory_ms),
            arithmetic_ms: sum(|stage| stage.arithmetic_ms),
            share: sum(|stage| stage.memory_ms.max(stage.arithmetic_ms)) / device_ms,
        }
    }
}

/// With commas between thousands.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut grouped = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    grouped
}
