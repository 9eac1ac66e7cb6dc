//! `wildcity rig show`.

use std::io::{self, Write};

use glam::{DVec2, DVec3};

use super::{between_deg, rig_of, view_of};
use wildcity_scene::Rig;

/// Print what a rig's cameras see; without RIG, the presets' names.
///
/// yaw is to the left of straight ahead and pitch above the horizon, in degrees. Fields of view are
/// between the middles of opposite edges, `-` where the lens shows nothing there.
#[derive(Debug, clap::Args)]
pub(super) struct Show {
    /// A preset, or a JSON file.
    #[arg(value_name = "RIG")]
    rig: Option<String>,
}

impl Show {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = io::stdout().lock();
        let Some(name) = self.rig else {
            for name in Rig::preset_names() {
                writeln!(out, "{name}")?;
            }
            return Ok(());
        };
        let rig = rig_of(&name)?;
        writeln!(out, "{}: {} cameras", rig.name, rig.cameras.len())?;
        let head = ["#", "camera", "size px", "field deg", "x m", "y m", "z m", "yaw", "pitch"];
        let [index, camera, size, field, x, y, z, yaw, pitch] = head;
        writeln!(
            out,
            "{index:>2} {camera:<24} {size:>9} {field:>11} {x:>6} {y:>6} {z:>6} {yaw:>7} {pitch:>6}"
        )?;
        for (index, camera) in rig.cameras.iter().enumerate() {
            let view = view_of(camera);
            let (width, height) = (camera.camera.width_px, camera.camera.height_px);
            let (w, h) = (f64::from(width), f64::from(height));
            let across = between_deg(&view, DVec2::new(0.0, h / 2.0), DVec2::new(w, h / 2.0));
            let down = between_deg(&view, DVec2::new(w / 2.0, 0.0), DVec2::new(w / 2.0, h));
            let text = |deg: Option<f64>| deg.map_or("-".to_owned(), |deg| format!("{deg:.1}"));
            let [x, y, z] = camera.rig_from_camera.position_m.to_array();
            let forward = camera.rig_from_camera.rotation * DVec3::Z;
            let yaw = forward.y.atan2(forward.x).to_degrees();
            let pitch = forward.z.clamp(-1.0, 1.0).asin().to_degrees();
            writeln!(
                out,
                "{index:>2} {:<24} {:>9} {:>11} {x:>6.2} {y:>6.2} {z:>6.2} {yaw:>7.1} {pitch:>6.1}",
                camera.name,
                format!("{width}x{height}"),
                format!("{}x{}", text(across), text(down)),
            )?;
        }
        Ok(())
    }
}
