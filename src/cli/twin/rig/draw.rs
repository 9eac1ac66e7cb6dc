//! `wildcity twin rig draw`.

use std::path::PathBuf;

use anyhow::anyhow;
use glam::DVec2;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::lookup::{camera_view, find_rig};
use crate::cli::output;
use wildcity_scene::Rig;
use wildcity_scene::rig::RigCamera;

/// Draw the cameras and LiDARs of a rig from above, as an SVG file.
///
/// The rig's front is at the top; grid squares have a side of one metre. Each camera is drawn with
/// the horizontal field of view of its middle row.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "Example:\n  wildcity twin rig draw vehicle6 --out vehicle6.svg")]
pub(super) struct Draw {
    /// A preset, or a JSON file.
    #[arg(value_name = "RIG")]
    rig: String,

    /// SVG file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// Half the side of the drawing, in metres.
const HALF_SIDE_M: f64 = 10.0;
/// Side of the drawing, in pixels.
const SIDE_PX: u32 = 800;
/// Length of the drawn fields of view, in metres.
const VIEW_M: f64 = 6.0;
/// Rays across a field of view, including its edges.
const RAYS: u32 = 25;

impl Draw {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let rig = find_rig(&self.rig)?;
        let mut svg = String::new();
        draw(&rig, &mut svg).map_err(|error| anyhow!("cannot draw the rig: {error}"))?;
        output::write(&self.out, svg.as_bytes())
    }
}

type Chart<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type DrawResult = Result<(), Box<dyn std::error::Error>>;

fn draw(rig: &Rig, svg: &mut String) -> DrawResult {
    let area = SVGBackend::with_string(svg, (SIDE_PX, SIDE_PX)).into_drawing_area();
    area.fill(&WHITE)?;
    // The rig's x points up in the drawing, and its y to the left.
    let mut chart = ChartBuilder::on(&area)
        .caption(format!("{} from above, metres", rig.name), ("sans-serif", 20))
        .margin(10)
        .x_label_area_size(25)
        .y_label_area_size(35)
        .build_cartesian_2d(HALF_SIDE_M..-HALF_SIDE_M, -HALF_SIDE_M..HALF_SIDE_M)?;
    chart.configure_mesh().x_labels(20).y_labels(20).draw()?;
    for (index, camera) in rig.cameras.iter().enumerate() {
        draw_camera(&mut chart, camera, index)?;
    }
    for lidar in &rig.lidars {
        let at_m = lidar.rig_from_lidar.position_m;
        let at = (at_m.y, at_m.x);
        chart.draw_series([
            Circle::new(at, 6, BLACK.stroke_width(2)).into_dyn(),
            Text::new(format!("{} (LiDAR)", lidar.name), at, ("sans-serif", 14)).into_dyn(),
        ])?;
    }
    area.present()?;
    Ok(())
}

/// Draws the outline of a camera's field of view, with its name.
fn draw_camera(chart: &mut Chart<'_, '_>, camera: &RigCamera, index: usize) -> DrawResult {
    let view = camera_view(camera);
    let position_m = camera.rig_from_camera.position_m;
    let width = f64::from(camera.camera.width_px);
    let height = f64::from(camera.camera.height_px);
    // The end of a ray of the middle row, at (y, x) of the rig.
    let ray_end = |k: u32| {
        let at_px = DVec2::new(width * f64::from(k) / f64::from(RAYS - 1), height / 2.0);
        // Seen from above: a ray that points straight down has no direction, and ends at the
        // camera.
        let direction = view.ray_world(at_px)?.truncate();
        let end_m = position_m.truncate() + VIEW_M * direction.normalize_or_zero();
        Some((end_m.y, end_m.x))
    };
    let camera_at = (position_m.y, position_m.x);
    let outline: Vec<(f64, f64)> =
        [camera_at].into_iter().chain((0..RAYS).filter_map(ray_end)).collect();
    let closed: Vec<(f64, f64)> = outline.iter().copied().chain([camera_at]).collect();
    // The outline has at least the camera itself, if no ray of the middle row exists.
    let label_at = outline[outline.len() / 2];
    let color = Palette99::pick(index);
    chart.draw_series([
        Polygon::new(outline, color.mix(0.15).filled()).into_dyn(),
        PathElement::new(closed, color.filled()).into_dyn(),
        Text::new(camera.name.clone(), label_at, ("sans-serif", 14)).into_dyn(),
    ])?;
    Ok(())
}
