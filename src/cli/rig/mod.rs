//! `wildcity rig`.

mod check;
mod draw;
mod show;

use std::path::Path;

use glam::DVec2;

use wildcity_render::View;
use wildcity_scene::Rig;
use wildcity_scene::rig::RigCamera;

use super::import::read_rig;

/// Look at a vehicle's cameras, and prove that images show what they should.
///
/// RIG is a preset (see `wildcity rig show`) or a JSON file as `wildcity import --rig` reads it.
#[derive(Debug, clap::Args)]
pub(super) struct RigCommand {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    Show(show::Show),
    Check(check::Check),
    Draw(draw::Draw),
}

impl RigCommand {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.what {
            What::Show(show) => show.run(),
            What::Check(check) => check.run(),
            What::Draw(draw) => draw.run(),
        }
    }
}

/// A preset, or else a file.
pub(super) fn rig_of(name: &str) -> anyhow::Result<Rig> {
    if let Some(rig) = Rig::preset(name) {
        return Ok(rig);
    }
    let presets: Vec<&str> = Rig::preset_names().collect();
    anyhow::ensure!(
        Path::new(name).exists(),
        "{name:?} is neither a file nor a preset; there is {}",
        presets.join(", ")
    );
    read_rig(Path::new(name))
}

/// The view of a camera while the rig stands at the world's origin.
fn view_of(camera: &RigCamera) -> View {
    View::new(camera.camera, camera.rig_from_camera)
}

/// Angle between what two points of an image look at, in degrees; `None` where one shows nothing.
fn between_deg(view: &View, a_px: DVec2, b_px: DVec2) -> Option<f64> {
    let (a, b) = (view.ray_world(a_px)?, view.ray_world(b_px)?);
    Some(a.angle_between(b).to_degrees())
}
