//! `wildcity twin rig show`.

use std::io::Write;

use glam::{DVec2, DVec3};

use super::lookup::{camera_view, find_rig};
use crate::cli::output;
use wildcity_render::View;
use wildcity_scene::Rig;
use wildcity_scene::rig::RigLidar;

/// Print the cameras and LiDARs of a rig; without RIG, the names of the presets.
///
/// Positions are in the rig's axes, in metres: x forward, y left, z up. Yaw is positive to the left
/// of straight ahead and pitch is positive above the horizon, both in degrees. A field of view is
/// the angle between the rays of the midpoints of opposite edges, in degrees, or `-` if the lens
/// shows nothing there.
#[derive(Debug, clap::Args)]
#[command(
    after_long_help = "Examples:\n  wildcity twin rig show\n  wildcity twin rig show vehicle6"
)]
pub(super) struct Show {
    /// A preset, or a JSON file.
    #[arg(value_name = "RIG")]
    rig: Option<String>,
}

impl Show {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = output::stdout();
        let Some(name) = self.rig else {
            for name in Rig::preset_names() {
                writeln!(out, "{name}")?;
            }
            return Ok(());
        };
        let rig = find_rig(&name)?;
        let lidars = match rig.lidars.len() {
            0 => String::new(),
            count => format!(", {}", output::counted(count, "LiDAR")),
        };
        let cameras = output::counted(rig.cameras.len(), "camera");
        writeln!(out, "{}: {cameras}{lidars}", rig.name)?;
        let headings =
            ["#", "camera", "size px", "field deg", "x m", "y m", "z m", "yaw deg", "pitch deg"];
        let [index, camera, size, field, x, y, z, yaw, pitch] = headings;
        writeln!(
            out,
            "{index:>2} {camera:<24} {size:>9} {field:>11} {x:>6} {y:>6} {z:>6} {yaw:>7} {pitch:>9}"
        )?;
        for (index, camera) in rig.cameras.iter().enumerate() {
            let view = camera_view(camera);
            let width_px = camera.camera.width_px;
            let height_px = camera.camera.height_px;
            let [x, y, z] = camera.rig_from_camera.position_m.to_array();
            let forward = camera.rig_from_camera.rotation * DVec3::Z;
            // Camera axes: z points forward.
            let yaw = tenths(forward.y.atan2(forward.x).to_degrees());
            // Rounding may make a component of a unit vector exceed 1, of which there is no arc
            // sine.
            let pitch = tenths(forward.z.clamp(-1.0, 1.0).asin().to_degrees());
            writeln!(
                out,
                "{index:>2} {:<24} {:>9} {:>11} {x:>6.2} {y:>6.2} {z:>6.2} {yaw:>7.1} {pitch:>9.1}",
                camera.name,
                format!("{width_px}x{height_px}"),
                fields_of_view(&view),
            )?;
        }
        for RigLidar { name, lidar, rig_from_lidar } in &rig.lidars {
            let [x, y, z] = rig_from_lidar.position_m.to_array();
            writeln!(
                out,
                "LiDAR {name}: {} rows of {} beams, {} to {} m, at x {x:.2} y {y:.2} z {z:.2}, a sweep in {} ms",
                lidar.rows(),
                lidar.columns(),
                lidar.min_range_m(),
                lidar.max_range_m(),
                lidar.duration_us() as f64 / 1e3,
            )?;
        }
        Ok(())
    }
}

/// Rounded as it is printed, without a minus before 0.0.
fn tenths(value: f64) -> f64 {
    // Adding 0 turns -0, which would be printed with its sign, into 0.
    (10.0 * value).round() / 10.0 + 0.0
}

/// Horizontal and vertical field of view in degrees, as text.
fn fields_of_view(view: &View) -> String {
    let width = f64::from(view.camera.width_px);
    let height = f64::from(view.camera.height_px);
    let left = DVec2::new(0.0, height / 2.0);
    let right = DVec2::new(width, height / 2.0);
    let top = DVec2::new(width / 2.0, 0.0);
    let bottom = DVec2::new(width / 2.0, height);
    let text = |angle: Option<f64>| angle.map_or("-".to_owned(), |deg| format!("{deg:.1}"));
    let horizontal = text(angle_between_deg(view, left, right));
    let vertical = text(angle_between_deg(view, top, bottom));
    format!("{horizontal}x{vertical}")
}

/// Angle between the rays of two points of an image, in degrees. None if the lens shows nothing at
/// one of them.
fn angle_between_deg(view: &View, a_px: DVec2, b_px: DVec2) -> Option<f64> {
    let a = view.ray_world(a_px)?;
    let b = view.ray_world(b_px)?;
    Some(a.angle_between(b).to_degrees())
}
