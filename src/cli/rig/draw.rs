//! `wildcity rig draw`.

use std::path::PathBuf;

use anyhow::anyhow;
use glam::DVec2;
use plotters::prelude::*;

use super::{rig_of, view_of};
use crate::cli::output;

/// Draw a rig's cameras from above, as SVG: the front is at the top, a square is a metre.
#[derive(Debug, clap::Args)]
pub(super) struct Draw {
    /// A preset, or a JSON file.
    #[arg(value_name = "RIG")]
    rig: String,

    /// The picture.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// Half the picture's side, in metres, and in pixels.
const REACH_M: f64 = 10.0;
const SIDE_PX: u32 = 800;
/// How far views are drawn, in metres.
const VIEW_M: f64 = 6.0;
/// Rays across a view, its edges included.
const RAYS: u32 = 25;

impl Draw {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let rig = rig_of(&self.rig)?;
        let mut svg = String::new();
        {
            let area = SVGBackend::with_string(&mut svg, (SIDE_PX, SIDE_PX)).into_drawing_area();
            let failed = |error: &dyn std::fmt::Display| anyhow!("cannot draw: {error}");
            area.fill(&WHITE).map_err(|e| failed(&e))?;
            // The rig's x is up in the picture, and its y to the left.
            let mut chart = ChartBuilder::on(&area)
                .caption(format!("{} from above, metres", rig.name), ("sans-serif", 20))
                .margin(10)
                .x_label_area_size(25)
                .y_label_area_size(35)
                .build_cartesian_2d(REACH_M..-REACH_M, -REACH_M..REACH_M)
                .map_err(|e| failed(&e))?;
            chart.configure_mesh().x_labels(20).y_labels(20).draw().map_err(|e| failed(&e))?;
            for (index, camera) in rig.cameras.iter().enumerate() {
                let view = view_of(camera);
                let at_m = camera.rig_from_camera.position_m;
                let (w, h) =
                    (f64::from(camera.camera.width_px), f64::from(camera.camera.height_px));
                let ray = |k: u32| {
                    let at_px = DVec2::new(w * f64::from(k) / f64::from(RAYS - 1), h / 2.0);
                    let ray = view.ray_world(at_px)?.truncate();
                    let end_m = at_m.truncate() + VIEW_M * ray.normalize_or_zero();
                    Some((end_m.y, end_m.x))
                };
                let eye = (at_m.y, at_m.x);
                let outline: Vec<(f64, f64)> =
                    [eye].into_iter().chain((0..RAYS).filter_map(ray)).collect();
                let color = Palette99::pick(index);
                let label_at = outline[outline.len() / 2];
                let around = outline.iter().copied().chain([eye]);
                chart
                    .draw_series([
                        Polygon::new(outline.clone(), color.mix(0.15).filled()).into_dyn(),
                        PathElement::new(around.collect::<Vec<_>>(), color.filled()).into_dyn(),
                        Text::new(camera.name.clone(), label_at, ("sans-serif", 14)).into_dyn(),
                    ])
                    .map_err(|e| failed(&e))?;
            }
            area.present().map_err(|e| failed(&e))?;
        }
        output::write(&self.out, svg.as_bytes())
    }
}
