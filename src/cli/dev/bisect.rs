//! `wildcity dev bisect`.

use std::io::Write;

use wildcity_render::compare::psnr::MIN_PSNR_DB;
use wildcity_render::hybrid::bisect;
use wildcity_render::{Backend, Frame};

use crate::cli::backend_options::HardwareOptions;
use crate::cli::output;
use crate::cli::progress;
use crate::cli::scene_source::SceneSource;

/// Find the stage of the gpu backend that is wrong, if one is.
///
/// Draws each camera of the list on the cpu backend, on the gpu backend, and with the stages up to
/// project, sort, or bin on the cpu and the rest on the GPU. Prints the PSNR of each image against
/// the cpu's in dB (inf if no value differs, NaN if the GPU counted more than a frame can hold). A
/// stage is wrong if the image is wrong (below 60 dB) when the GPU runs the stage, and right when
/// the cpu runs it. The exit code is 1 if a camera has a wrong stage.
/// `wildcity render --cpu-through STAGE` writes the images.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Bisect {
    #[command(flatten)]
    source: SceneSource,

    #[command(flatten)]
    hardware: HardwareOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity dev bisect street --cameras views.json
  wildcity dev bisect scene.ply --cameras views.json --device llvmpipe";

impl Bisect {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let ready = self.source.open()?;
        let cpu = self.hardware.cpu()?;
        let gpu = self.hardware.gpu()?;
        let bar = progress::count("rendering");
        bar.set_length(ready.shots.len() as u64);
        let mut out = output::stdout();
        writeln!(out, "device       {}", gpu.detail())?;
        writeln!(out, "cpu through      none  project     sort      bin")?;
        let mut wrong = None;
        for shot in &ready.shots {
            let views = std::slice::from_ref(&shot.view);
            let scene = ready.shot_scene(shot)?;
            let frame = Frame { scene: &scene, profile: &shot.profile, views };
            let bisection = bisect(&cpu, &gpu, &frame)?;
            write!(out, "{:<12}", shot.name)?;
            for (_, db) in &bisection.psnr_db {
                write!(out, " {db:>8.1}")?;
            }
            match bisection.wrong() {
                None => writeln!(out, "  right")?,
                Some(stage) => writeln!(out, "  {stage} is wrong")?,
            }
            wrong = wrong.or(bisection.wrong().map(|stage| (&shot.name, stage)));
            bar.inc(1);
        }
        bar.finish_and_clear();
        match wrong {
            None => Ok(()),
            Some((camera, stage)) => anyhow::bail!(
                "camera {camera:?} is below {MIN_PSNR_DB} dB while the GPU runs stage {stage}"
            ),
        }
    }
}
