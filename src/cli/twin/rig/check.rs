//! `wildcity twin rig check`.

use std::io::Write;

use super::lookup::{camera_view, find_rig};
use crate::cli::backend_options::BackendOptions;
use crate::cli::output;
use wildcity_render::compare::reprojection::ReprojectionErrors;

/// Render points at known pixels, and check that each camera of a rig shows them there.
///
/// Places a grid of small Gaussians in front of each camera, on rays through the centres of pixels,
/// and compares the centroids of their images with those pixel centres. Prints the largest distance
/// for each camera; the exit code is 1 if one is above 0.1 px.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin rig check alpamayo2
  wildcity twin rig check car.json --backend reference")]
pub(super) struct Check {
    /// A preset, or a JSON file.
    #[arg(value_name = "RIG")]
    rig: String,

    #[command(flatten)]
    backend: BackendOptions,
}

/// Largest distance of a point from its pixel, in pixels.
const MAX_DISTANCE_PX: f64 = 0.1;

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let rig = find_rig(&self.rig)?;
        let backend = self.backend.backend()?;
        let mut out = output::stdout();
        let mut wrong = Vec::new();
        for camera in &rig.cameras {
            let ReprojectionErrors { count, worst_px } =
                ReprojectionErrors::measure(&*backend, &camera_view(camera))?;
            writeln!(out, "{:<24} {count:>3} points, at most {worst_px:.3} px off", camera.name)?;
            // A camera of which no point was found shows nothing where it should.
            if worst_px > MAX_DISTANCE_PX || count == 0 {
                wrong.push(camera.name.clone());
            }
        }
        anyhow::ensure!(
            wrong.is_empty(),
            "these cameras do not show points where their lens says: {}",
            wrong.join(", ")
        );
        Ok(())
    }
}
