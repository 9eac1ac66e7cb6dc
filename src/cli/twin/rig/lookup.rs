//! Rigs by name, and the views of their cameras.

use std::path::Path;

use crate::cli::input_files::read_rig;
use wildcity_render::View;
use wildcity_scene::Rig;
use wildcity_scene::rig::RigCamera;

/// The preset of this name, or else the rig in this file.
pub(in crate::cli) fn find_rig(name: &str) -> anyhow::Result<Rig> {
    // Presets come first, so that a file in the current folder cannot change what a name means.
    if let Some(rig) = Rig::preset(name) {
        return Ok(rig);
    }
    let presets: Vec<&str> = Rig::preset_names().collect();
    anyhow::ensure!(
        Path::new(name).exists(),
        "rig {name:?} is neither a file nor a preset; the presets are {}",
        presets.join(", ")
    );
    read_rig(Path::new(name))
}

/// The view of a camera while the rig stands at the world's origin.
pub(super) fn camera_view(camera: &RigCamera) -> View {
    View::new(camera.camera, camera.rig_from_camera)
}
