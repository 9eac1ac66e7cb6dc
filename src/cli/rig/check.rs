//! `wildcity rig check`.

use std::io::{self, Write};

use super::{rig_of, view_of};
use crate::cli::backend_options::BackendOptions;
use wildcity_render::compare::reprojection::ReprojectionErrors;

/// Render points that each camera must show at known pixels, and find them there.
///
/// A grid of small Gaussians stands before each camera, where its lens says that the middle of a pixel
/// looks. Their images' centroids are compared with those pixels; fails with exit code 1 if one is off by
/// more than 0.1 px.
#[derive(Debug, clap::Args)]
pub(super) struct Check {
    /// A preset, or a JSON file.
    #[arg(value_name = "RIG")]
    rig: String,

    #[command(flatten)]
    backend: BackendOptions,
}

/// Farthest that a point may be from its pixel, in pixels.
const OFF_PX: f64 = 0.1;

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let rig = rig_of(&self.rig)?;
        let backend = self.backend.backend()?;
        let mut out = io::stdout().lock();
        let mut wrong = Vec::new();
        for camera in &rig.cameras {
            let ReprojectionErrors { count, worst_px } =
                ReprojectionErrors::measure(&*backend, &view_of(camera))?;
            writeln!(out, "{:<24} {count:>3} points, at most {worst_px:.3} px off", camera.name)?;
            if worst_px > OFF_PX || count == 0 {
                wrong.push(camera.name.clone());
            }
        }
        anyhow::ensure!(wrong.is_empty(), "not where the lens says: {}", wrong.join(", "));
        Ok(())
    }
}
