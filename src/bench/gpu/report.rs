//! The report of `wildcity-bench gpu`, as Markdown and as JSON.

use std::fmt;

use anyhow::ensure;
use serde::Serialize;

use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::gpu::Roofline;

/// The goal for a step of six full cameras, from the call to the images on the host, with
/// [`GOAL_PAIRS`] visible pairs.
const GOAL_MS: f64 = 4.7;
/// The (Gaussian, view) pairs to which the goal refers.
const GOAL_PAIRS: f64 = 5e6;

/// The measurements of one device.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    /// Name and driver of the device.
    pub(super) device: String,
    #[serde(serialize_with = "measured")]
    pub(super) roofline: Roofline,
    pub(super) scenes: Vec<SceneReport>,
}

/// The measurements of one scene; times are medians of all frames.
#[derive(Debug, Serialize)]
pub(super) struct SceneReport {
    pub(super) gaussians: u32,
    pub(super) mirror_bytes: u64,
    pub(super) visible_pairs: u64,
    pub(super) touches: u64,
    pub(super) instances: u64,
    pub(super) evaluations: u64,
    /// Frames that were timed.
    pub(super) frames: u32,
    /// Number of regions that these frames were divided into, in total.
    #[serde(rename = "parts")]
    pub(super) regions: u64,
    /// How many of those regions had to be drawn again because a buffer was too small.
    pub(super) retries: u64,
    /// Empty for a device without a clock.
    pub(super) stages: Vec<StageReport>,
    /// Name and time of each host row, "unaccounted" last. These and the stages add up to the step.
    pub(super) host_ms: Vec<(&'static str, f64)>,
    pub(super) step_ms: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) cpu_step_ms: Option<f64>,
    #[serde(flatten)]
    pub(super) images: Option<Images>,
}

/// The first image compared with the cpu backend's.
#[derive(Debug, Serialize)]
pub(super) struct Images {
    images_equal: bool,
    /// `None` if the images are equal.
    #[serde(skip_serializing_if = "Option::is_none")]
    psnr_db: Option<f64>,
}

impl Images {
    /// Compares 8-bit images of the same size.
    ///
    /// # Errors
    /// They are empty, or differ in size.
    pub(super) fn compare(a: &[u8], b: &[u8]) -> anyhow::Result<Self> {
        let own = a.len();
        let other = b.len();
        ensure!(own == other && own > 0, "images of {own} and {other} bytes cannot be compared");
        let images_equal = a == b;
        let psnr_db = (!images_equal).then(|| psnr_db_u8(a.iter().zip(b)));
        Ok(Self { images_equal, psnr_db })
    }
}

/// The measurements of one stage.
#[derive(Debug, Serialize)]
pub(super) struct StageReport {
    stage: &'static str,
    device_ms: f64,
    bytes: u64,
    memory_ms: f64,
    arithmetic_ms: f64,
    /// The larger of the two rooflines, divided by the device time.
    share: f64,
}

impl StageReport {
    pub(super) fn device_ms(&self) -> f64 {
        self.device_ms
    }

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
        if self.regions > u64::from(self.frames) {
            writeln!(
                f,
                "**Warning: {} frames were drawn in {} regions: a pair that reaches into two bands of an \
                 image counts twice.**\n",
                self.frames, self.regions
            )?;
        }
        if self.retries > 0 {
            writeln!(
                f,
                "**Warning: {} attempts within {} frames drew nothing since buffers were too small; \
                 their time is in the tables.**\n",
                self.retries, self.frames
            )?;
        }
        writeln!(
            f,
            "| stage (device time, unless marked host) | ms | MB | memory roofline ms | arithmetic \
             roofline ms | share |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|")?;
        let row = |f: &mut fmt::Formatter<'_>, name: &str, stage: &StageReport| {
            let StageReport { device_ms, bytes, memory_ms, arithmetic_ms, share, .. } = *stage;
            let mb = bytes as f64 / 1e6;
            let percent = 100.0 * share;
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
        if !self.stages.is_empty() {
            row(f, "**device**", &all)?;
        }
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
            "\nGoal {GOAL_MS} ms a step at 5 million visible pairs, so {goal_ms:.3} ms here:\n"
        )?;
        if !self.stages.is_empty() {
            writeln!(f, "- device time / goal: {:.2}", all.device_ms / goal_ms)?;
        }
        writeln!(f, "- step / goal: {:.2}", self.step_ms / goal_ms)?;
        match &self.images {
            Some(Images { psnr_db: Some(db), .. }) => {
                writeln!(f, "\nThe first image is {db:.1} dB from the cpu backend's.")
            }
            Some(_) => writeln!(f, "\nThe first image equals the cpu backend's."),
            None => Ok(()),
        }
    }
}

impl SceneReport {
    /// The sum of all stages; its share uses the larger roofline of each stage.
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

/// A number with commas between thousands.
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
