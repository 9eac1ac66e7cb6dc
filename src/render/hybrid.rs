//! The cpu backend up to a stage, and the gpu backend from there: to find which stage is wrong.

use super::compare::psnr::{MIN_PSNR_DB, psnr_db, psnr_db_u8};
use super::cpu::Cpu;
use super::gpu::Gpu;
use super::stage::Stage;
use super::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target, View};

/// One frame by two backends.
#[derive(Debug)]
pub struct HybridBackend {
    cpu: Cpu,
    gpu: Gpu,
    through: Stage,
}

impl HybridBackend {
    /// The cpu backend runs the stages up to and including `through`.
    pub fn new(cpu: Cpu, gpu: Gpu, through: Stage) -> Self {
        Self { cpu, gpu, through }
    }
}

impl Backend for HybridBackend {
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
        finished: OnViewDone<'_>,
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
    finished: OnViewDone<'_>,
) -> Result<FrameStats, RenderError> {
    frame.check(targets)?;
    let (between, before) = cpu.run_through(frame, through)?;
    let mut stats = gpu.resume(&between, frame, targets, finished)?;
    stats.stages_ms.splice(0..0, before.stages_ms);
    Ok(stats)
}

/// How close the gpu backend comes to the cpu backend, by the stages that the latter runs for it.
#[derive(Clone, Debug, PartialEq)]
pub struct Bisection {
    /// The last stage on the cpu, if any, and the PSNR of all views in dB: that of colour and opacity
    /// or that of the 8-bit colour, whichever is less. Infinite where no value differs, NaN where the
    /// gpu asked for more than a frame may hold.
    pub psnr_db: Vec<(Option<Stage>, f64)>,
}

/// Renders a frame on the cpu, on the gpu, and with every stage in turn as the last one on the cpu.
///
/// # Errors
/// As [`Backend::render`].
pub fn bisect(cpu: &Cpu, gpu: &Gpu, frame: &Frame<'_>) -> Result<Bisection, RenderError> {
    let draw = |by: &dyn Fn(&mut [Target<'_>]) -> Result<FrameStats, RenderError>| {
        let mut images = Images::of(frame.views);
        by(&mut images.targets())?;
        Ok(images)
    };
    let truth = draw(&|targets| cpu.render(frame, targets, &|_, _| {}))?;
    let mut psnr_db = Vec::new();
    for through in std::iter::once(None).chain(Stage::ALL.map(Some)) {
        let images = draw(&|targets| match through {
            None => gpu.render(frame, targets, &|_, _| {}),
            Some(stage) => render_through(cpu, gpu, stage, frame, targets, &|_, _| {}),
        });
        let db = match images {
            Ok(images) => images.psnr_db(&truth),
            // A stage that counts wrong asks for more than there is; after bin nothing counts.
            Err(RenderError::TooMany { .. }) if through != Some(Stage::Bin) => f64::NAN,
            Err(error) => return Err(error),
        };
        psnr_db.push((through, db));
    }
    Ok(Bisection { psnr_db })
}

impl Bisection {
    /// The gpu's stage that is wrong, by name: the first one that the gpu runs where the image is
    /// still wrong for the last time. `None` if every image is right.
    pub fn wrong(&self) -> Option<&'static str> {
        let is_right = |(_, db): &&(Option<Stage>, f64)| *db >= MIN_PSNR_DB;
        let right = self.psnr_db.iter().rev().take_while(is_right).count();
        let names = ["rasterize", "bin", "sort", "project"];
        names.get(right).copied()
    }
}

/// All views' colours.
struct Images {
    rgba: Vec<Vec<f32>>,
    rgb8: Vec<Vec<u8>>,
}

impl Images {
    fn of(views: &[View]) -> Self {
        let pixels = || views.iter().map(|view| view.camera.pixels());
        Self {
            rgba: pixels().map(|pixels| vec![0.0; 4 * pixels]).collect(),
            rgb8: pixels().map(|pixels| vec![0; 3 * pixels]).collect(),
        }
    }

    fn targets(&mut self) -> Vec<Target<'_>> {
        let images = self.rgba.iter_mut().zip(&mut self.rgb8);
        images
            .map(|(rgba, rgb8)| Target { rgba: Some(rgba), rgb8: Some(rgb8), ..Target::default() })
            .collect()
    }

    fn psnr_db(&self, truth: &Self) -> f64 {
        let rgba = self.rgba.iter().flatten().zip(truth.rgba.iter().flatten());
        let rgb8 = self.rgb8.iter().flatten().zip(truth.rgb8.iter().flatten());
        let linear = psnr_db(rgba.map(|(&a, &b)| f64::from(a - b)));
        let written = psnr_db_u8(rgb8);
        // A NaN is not right, whatever the other is.
        if linear < written || linear.is_nan() { linear } else { written }
    }
}
