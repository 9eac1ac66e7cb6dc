//! The cpu backend up to a stage and the gpu backend from there, to find the gpu stage that is
//! wrong.
//!
//! The stages exchange [`StageOutputs`](crate::stage::StageOutputs). [`bisect`] draws a frame with
//! every stage in turn as the last one on the cpu: the first gpu stage with which the image is
//! still wrong is the faulty one.

use super::compare::psnr::{MIN_PSNR_DB, psnr_db, psnr_db_u8};
use super::cpu::Cpu;
use super::gpu::Gpu;
use super::stage::Stage;
use super::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target, View};

/// A backend that runs the first stages of every frame on the cpu and the rest on the gpu.
#[derive(Debug)]
pub struct HybridBackend {
    cpu: Cpu,
    gpu: Gpu,
    last_on_cpu: Stage,
}

impl HybridBackend {
    /// The cpu backend runs the stages up to and including `last_on_cpu`.
    pub fn new(cpu: Cpu, gpu: Gpu, last_on_cpu: Stage) -> Self {
        Self { cpu, gpu, last_on_cpu }
    }
}

impl Backend for HybridBackend {
    fn name(&self) -> &'static str {
        "cpu+gpu"
    }

    fn detail(&self) -> String {
        let cpu = self.cpu.detail();
        let gpu = self.gpu.detail();
        format!("{cpu} through {}, then {gpu}", self.last_on_cpu.name())
    }

    fn threads(&self) -> usize {
        self.cpu.threads()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        on_view_done: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        render_split(&self.cpu, &self.gpu, self.last_on_cpu, frame, targets, on_view_done)
    }
}

fn render_split(
    cpu: &Cpu,
    gpu: &Gpu,
    last_on_cpu: Stage,
    frame: &Frame<'_>,
    targets: &mut [Target<'_>],
    on_view_done: OnViewDone<'_>,
) -> Result<FrameStats, RenderError> {
    // Before the cpu's stages, which would be in vain.
    frame.check(targets)?;
    let (outputs, cpu_stats) = cpu.run_through(frame, last_on_cpu)?;
    let mut stats = gpu.resume(&outputs, frame, targets, on_view_done)?;
    // The cpu's stages ran first.
    stats.stages_ms.splice(0..0, cpu_stats.stages_ms);
    Ok(stats)
}

/// PSNR of the images of the gpu backend against those of the cpu backend, by the number of stages
/// that run on the cpu.
#[derive(Clone, Debug, PartialEq)]
pub struct Bisection {
    /// The last stage on the cpu, if any, and the PSNR of all views in dB: the lesser of that of
    /// linear colour and opacity and that of the 8-bit colour. Infinite if no value differs, NaN if
    /// the gpu failed with [`RenderError::TooMany`].
    pub psnr_db: Vec<(Option<Stage>, f64)>,
}

/// Renders a frame on the cpu, on the gpu, and with every stage in turn as the last one on the cpu.
///
/// # Errors
/// As [`Backend::render`].
pub fn bisect(cpu: &Cpu, gpu: &Gpu, frame: &Frame<'_>) -> Result<Bisection, RenderError> {
    let draw = |render: &dyn Fn(&mut [Target<'_>]) -> Result<FrameStats, RenderError>| {
        let mut images = Images::new(frame.views);
        render(&mut images.targets())?;
        Ok(images)
    };
    let truth = draw(&|targets| cpu.render(frame, targets, &|_, _| {}))?;
    let mut psnr_db = Vec::new();
    for last_on_cpu in std::iter::once(None).chain(Stage::ALL.map(Some)) {
        let images = draw(&|targets| match last_on_cpu {
            None => gpu.render(frame, targets, &|_, _| {}),
            Some(stage) => render_split(cpu, gpu, stage, frame, targets, &|_, _| {}),
        });
        let db = match images {
            Ok(images) => images.psnr_db(&truth),
            // A faulty stage may count too many pairs. After bin no stage counts.
            // The other errors mean that the frame cannot be drawn at all.
            Err(RenderError::TooMany { .. }) if last_on_cpu != Some(Stage::Bin) => f64::NAN,
            Err(error) => return Err(error),
        };
        psnr_db.push((last_on_cpu, db));
    }
    Ok(Bisection { psnr_db })
}

impl Bisection {
    /// The name of the gpu stage that is wrong; `None` if every image is right.
    ///
    /// Among the images that are wrong it takes the one with the most stages on the cpu: the first
    /// stage that the gpu ran for it is the faulty one.
    pub fn wrong(&self) -> Option<&'static str> {
        let is_right = |(_, db): &&(Option<Stage>, f64)| *db >= MIN_PSNR_DB;
        // Counted from the one with the most stages on the cpu: `right` images at the end are
        // right, and the next one adds the faulty stage. With all four right there is no name.
        let right = self.psnr_db.iter().rev().take_while(is_right).count();
        let names = ["rasterize", "bin", "sort", "project"];
        names.get(right).copied()
    }
}

/// Linear and 8-bit colours of all views.
struct Images {
    rgba: Vec<Vec<f32>>,
    rgb8: Vec<Vec<u8>>,
}

impl Images {
    fn new(views: &[View]) -> Self {
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
        let rounded = psnr_db_u8(rgb8);
        // A NaN counts as wrong, whatever the other value is.
        if linear < rounded || linear.is_nan() { linear } else { rounded }
    }
}
