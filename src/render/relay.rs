//! The cpu backend up to a stage, and the gpu backend from there: to find which stage is wrong.

use super::cpu::Cpu;
use super::gpu::Gpu;
use super::stage::Stage;
use super::{Backend, Finished, Frame, FrameStats, RenderError, Target, View};

/// One frame by two backends.
#[derive(Debug)]
pub struct Relay {
    cpu: Cpu,
    gpu: Gpu,
    through: Stage,
}

impl Relay {
    /// The cpu backend runs the stages up to and including `through`.
    pub fn new(cpu: Cpu, gpu: Gpu, through: Stage) -> Self {
        Self { cpu, gpu, through }
    }
}

impl Backend for Relay {
    fn name(&self) -> &'static str {
        "cpu+gpu"
    }

    fn detail(&self) -> String {
        let (cpu, gpu) = (self.cpu.detail(), self.gpu.detail());
        format!("{cpu} through {}, then {gpu}", self.through.name())
    }

    fn threads(&self) -> usize {
        self.cpu.threads()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: Finished<'_>,
    ) -> Result<FrameStats, RenderError> {
        render_through(&self.cpu, &self.gpu, self.through, frame, targets, finished)
    }
}

fn render_through(
    cpu: &Cpu,
    gpu: &Gpu,
    through: Stage,
    frame: &Frame<'_>,
    targets: &mut [Target<'_>],
    finished: Finished<'_>,
) -> Result<FrameStats, RenderError> {
    frame.check(targets)?;
    let (between, before) = cpu.through(frame, through)?;
    let mut stats = gpu.go_on(&between, frame, targets, finished)?;
    stats.stages_ms.splice(0..0, before.stages_ms);
    Ok(stats)
}

/// Least PSNR at which an image counts as right, in dB: what backends promise each other.
pub const RIGHT_DB: f64 = 60.0;

/// How close the gpu backend comes to the cpu backend, by the stages that the latter runs for it.
#[derive(Clone, Debug, PartialEq)]
pub struct Bisection {
    /// The last stage on the cpu, if any, and PSNR of the colour and opacity of all views, in dB;
    /// infinite where no value differs.
    pub psnr_db: Vec<(Option<Stage>, f64)>,
}

/// Renders a frame on the cpu, on the gpu, and with every stage in turn as the last one on the cpu.
///
/// # Errors
/// As [`Backend::render`].
pub fn bisect(cpu: &Cpu, gpu: &Gpu, frame: &Frame<'_>) -> Result<Bisection, RenderError> {
    let rendered =
        |render: &mut dyn FnMut(&mut [Target<'_>]) -> Result<FrameStats, RenderError>| {
            let mut images: Vec<Vec<f32>> = frame.views.iter().map(empty).collect();
            let targets = images.iter_mut();
            let mut targets: Vec<Target<'_>> =
                targets.map(|image| Target { rgba: Some(image), ..Target::default() }).collect();
            render(&mut targets)?;
            Ok(images)
        };
    let truth = rendered(&mut |targets| cpu.render(frame, targets, &|_, _| {}))?;
    let mut psnr_db = Vec::new();
    for through in std::iter::once(None).chain(Stage::ALL.map(Some)) {
        let images = rendered(&mut |targets| match through {
            None => gpu.render(frame, targets, &|_, _| {}),
            Some(stage) => render_through(cpu, gpu, stage, frame, targets, &|_, _| {}),
        })?;
        psnr_db.push((through, psnr(&images, &truth)));
    }
    Ok(Bisection { psnr_db })
}

impl Bisection {
    /// The gpu's stage that is wrong, by name: the first one that the gpu runs where the image is
    /// still wrong for the last time. `None` if every image is right.
    pub fn wrong(&self) -> Option<&'static str> {
        let is_right = |(_, db): &&(Option<Stage>, f64)| *db >= RIGHT_DB;
        let right = self.psnr_db.iter().rev().take_while(is_right).count();
        let names = ["rasterize", "bin", "sort", "project"];
        names.get(right).copied()
    }
}

fn empty(view: &View) -> Vec<f32> {
    vec![0.0; 4 * view.camera.pixels()]
}

/// Of values whose peak is 1. NaN anywhere gives NaN, which is not right.
fn psnr(images: &[Vec<f32>], truths: &[Vec<f32>]) -> f64 {
    let values = || images.iter().flatten().zip(truths.iter().flatten());
    let squares: f64 = values().map(|(a, b)| f64::from(a - b).powi(2)).sum();
    -10.0 * (squares / values().count() as f64).log10()
}
