//! `wildcity-bench step`.

use std::io::{self, Write};

use serde_json::json;

use wildcity_render::{Backend, Frame, View};

use super::timed::{Timed, time};
use wildcity::cli::backend_options::RendererOptions;
use wildcity::cli::scene_source::SceneSource;

/// Time one step: all cameras of a list in one frame, rendered to 8-bit colour.
///
/// Prints the median time and the extremes in milliseconds, after one frame that is not counted,
/// and the median time of each stage. Also counts visible (Gaussian, view) pairs, instances
/// (Gaussian, tile) after binning, and Gaussian-pixel evaluations.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Step {
    #[command(flatten)]
    source: SceneSource,

    #[command(flatten)]
    renderer: RendererOptions,

    /// Frames to time.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    repeat: u32,

    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  wildcity-bench step street.ply --cameras cameras.json --repeat 9
  wildcity-bench step street --cameras cameras.json --json | jq .step_ms";

impl Step {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let ready = self.source.open()?;
        let backend = self.renderer.backend()?;
        let views: Vec<View> = ready.shots.iter().map(|shot| shot.view).collect();
        let profile = ready.shots[0].profile;
        if let Some(other) = ready.shots.iter().find(|shot| shot.profile != profile) {
            anyhow::bail!(
                "cameras {:?} and {:?} have different values of near, but a step has one profile: give \
                 one for all with --set near=METRES",
                other.name,
                ready.shots[0].name
            );
        }
        let scene = ready.whole_scene()?;
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        // The first frame allocates buffers, and is not counted.
        time(&*backend, &frame, 1, "rendering")?;
        let timed = time(&*backend, &frame, self.repeat, "rendering")?;
        self.report(&scene, &views, &*backend, &timed)
    }

    fn report(
        &self,
        scene: &wildcity_scene::Scene,
        views: &[View],
        backend: &dyn Backend,
        timed: &Timed,
    ) -> anyhow::Result<()> {
        let Timed { steps_ms, stats, .. } = timed;
        let step_ms = timed.step_ms();
        let min_ms = steps_ms.iter().copied().fold(step_ms, f64::min);
        let max_ms = steps_ms.iter().copied().fold(step_ms, f64::max);
        let name = backend.name();
        let detail = backend.detail();
        let threads = backend.threads();
        let pixels: usize = views.iter().map(|view| view.camera.pixels()).sum();
        let mut out = io::stdout().lock();
        if self.json {
            let stages: serde_json::Map<_, _> =
                stats.stages_ms.iter().map(|(name, ms)| (name.to_string(), json!(ms))).collect();
            let report = json!({
                "backend": name,
                "detail": detail,
                "threads": threads,
                "gaussians": scene.gaussians(),
                "sh_degree": scene.sh_degree(),
                "resident_bytes": scene.bytes(),
                "cameras": views.len(),
                "pixels": pixels,
                "repeat": self.repeat,
                "step_ms": step_ms,
                "step_ms_min": min_ms,
                "step_ms_max": max_ms,
                "stages_ms": stages,
                "visible_pairs": stats.visible_pairs,
                "instances": stats.instances,
                "evaluations": stats.evaluations,
            });
            writeln!(out, "{report}")?;
            return Ok(());
        }
        writeln!(
            out,
            "{} Gaussians, {} cameras, {pixels} px, {name} {detail}, {threads} threads",
            scene.gaussians(),
            views.len()
        )?;
        writeln!(out, "visible pairs  {:>14}", stats.visible_pairs)?;
        writeln!(out, "instances      {:>14}", stats.instances)?;
        writeln!(out, "evaluations    {:>14}", stats.evaluations)?;
        for (name, ms) in &stats.stages_ms {
            writeln!(out, "{name:<14} {ms:>11.1} ms")?;
        }
        writeln!(
            out,
            "{:<14} {step_ms:>11.1} ms   (median of {}, from {min_ms:.1} to {max_ms:.1})",
            "step", self.repeat
        )?;
        Ok(())
    }
}
