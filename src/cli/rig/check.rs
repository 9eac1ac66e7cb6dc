//! `wildcity rig check`.

use std::io::{self, Write};

use glam::DVec2;

use super::{rig_of, view_of};
use crate::cli::scene_source::Engine;
use crate::render::{Backend, Frame, Target, View};
use crate::scene::rig::RigCamera;
use crate::scene::{Gaussians, RenderProfile, Scene};

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
    engine: Engine,
}

/// Farthest that a point may be from its pixel, in pixels.
const OFF_PX: f64 = 0.1;
/// Points across an image and down.
const GRID: [u32; 2] = [7, 5];
/// How far the points are, in metres.
const AWAY_M: f64 = 10.0;
/// Size of a point in the image, one standard deviation, in pixels; it is looked for within four.
const POINT_PX: f64 = 2.0;

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let rig = rig_of(&self.rig)?;
        let backend = self.engine.backend()?;
        let mut out = io::stdout().lock();
        let mut wrong = Vec::new();
        for camera in &rig.cameras {
            let (points, worst_px) = worst(&*backend, camera)?;
            writeln!(out, "{:<24} {points:>3} points, at most {worst_px:.3} px off", camera.name)?;
            if worst_px > OFF_PX || points == 0 {
                wrong.push(camera.name.clone());
            }
        }
        anyhow::ensure!(wrong.is_empty(), "not where the lens says: {}", wrong.join(", "));
        Ok(())
    }
}

/// How many points a camera shows, and how far the worst is off, in pixels.
fn worst(backend: &dyn Backend, camera: &RigCamera) -> anyhow::Result<(usize, f64)> {
    let view = view_of(camera);
    let (width, height) = (camera.camera.width_px, camera.camera.height_px);
    let mut gaussians = Gaussians::with_capacity(0, 0);
    let mut wanted = Vec::new();
    for row in 0..GRID[1] {
        for column in 0..GRID[0] {
            // Middles of equal fields, off the middle of the pixel.
            let middle =
                |k: u32, of: u32, side: u32| f64::from(side) * (f64::from(k) + 0.5) / f64::from(of);
            let field_px = DVec2::new(middle(column, GRID[0], width), middle(row, GRID[1], height));
            let at_px = field_px.floor() + 0.37;
            let Some((ray, beside)) = view.ray_world(at_px).zip(view.ray_world(at_px + DVec2::X))
            else {
                continue;
            };
            wanted.push(at_px);
            let sigma_m = POINT_PX * AWAY_M * ray.angle_between(beside);
            gaussians.means_m.push((view.world_from_camera.position_m + AWAY_M * ray).to_array());
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([sigma_m.ln() as f32; 3]);
            gaussians.logit_opacities.push(2.0);
            gaussians.sh.extend([1.0; 3]);
        }
    }
    let mut opacity = vec![0.0; camera.camera.pixels()];
    let scene = Scene::from_gaussians(&gaussians);
    let views: [View; 1] = [view];
    let frame = Frame { scene: &scene, profile: &RenderProfile::default(), views: &views };
    let target = Target { opacity: Some(&mut opacity), ..Target::default() };
    backend.render(&frame, &mut [target], &|_, _| {})?;
    let off_px = wanted.iter().map(|at_px| {
        let found = centroid(&opacity, [width, height], *at_px);
        found.map_or(f64::INFINITY, |found_px| found_px.distance(*at_px))
    });
    Ok((wanted.len(), off_px.fold(0.0, f64::max)))
}

/// The middle of what is within four standard deviations of a place, in pixels; `None` if nothing is.
fn centroid(opacity: &[f32], [width, height]: [u32; 2], around_px: DVec2) -> Option<DVec2> {
    let reach_px = 4.0 * POINT_PX;
    let range = |middle: f64, side: u32| {
        let from = (middle - reach_px).floor().max(0.0) as u32;
        from..((middle + reach_px).ceil() as u32).min(side)
    };
    let (mut sum_px, mut weight) = (DVec2::ZERO, 0.0);
    for row in range(around_px.y, height) {
        for column in range(around_px.x, width) {
            let seen = f64::from(opacity[(row * width + column) as usize]);
            sum_px += seen * (DVec2::new(f64::from(column), f64::from(row)) + 0.5);
            weight += seen;
        }
    }
    (weight > 0.0).then(|| sum_px / weight)
}
