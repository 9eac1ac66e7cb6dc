//! Whether a camera shows points where its lens says.

use glam::DVec2;

use crate::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::{Gaussians, RenderProfile, Scene};

/// Points across an image and down.
const GRID: [u32; 2] = [7, 5];
/// How far the points are, in metres.
const AWAY_M: f64 = 10.0;
/// Size of a point in the image, one standard deviation, in pixels; it is looked for within four.
const POINT_PX: f64 = 2.0;

/// Points that a camera should show.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReprojectionErrors {
    /// How many there were.
    pub count: usize,
    /// How far the worst was from its pixel; infinite if one was not seen.
    pub worst_px: f64,
}

impl ReprojectionErrors {
    /// Draws a grid of small Gaussians before a camera, where its lens says that known places of the image
    /// look, and finds them by their centroids.
    ///
    /// # Errors
    /// The backend cannot draw them.
    pub fn measure(backend: &dyn Backend, view: &View) -> Result<Self, RenderError> {
        let size_px = view.camera.size_px();
        let mut gaussians = Gaussians::with_capacity(0, 0);
        let mut wanted = Vec::new();
        for (row, column) in (0..GRID[1]).flat_map(|row| (0..GRID[0]).map(move |k| (row, k))) {
            // Middles of equal fields, off the middle of the pixel.
            let share =
                (DVec2::new(column.into(), row.into()) + 0.5) / DVec2::from(GRID.map(f64::from));
            let at_px = (share * size_px).floor() + 0.37;
            let rays = view.ray_world(at_px).zip(view.ray_world(at_px + DVec2::X));
            let Some((ray, beside)) = rays else { continue };
            wanted.push(at_px);
            let sigma_m = POINT_PX * AWAY_M * ray.angle_between(beside);
            gaussians.means_m.push((view.world_from_camera.position_m + AWAY_M * ray).to_array());
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([sigma_m.ln() as f32; 3]);
            gaussians.logit_opacities.push(2.0);
            gaussians.sh.extend([1.0; 3]);
        }
        let mut opacity = vec![0.0; view.camera.pixels()];
        let scene = Scene::from_gaussians(&gaussians);
        let (profile, views) = (RenderProfile::default(), [*view]);
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let target = Target { opacity: Some(&mut opacity), ..Target::default() };
        backend.render(&frame, &mut [target], &|_, _| {})?;
        let (width, height) = (view.camera.width_px, view.camera.height_px);
        let off_px = wanted.iter().map(|&at_px| {
            let found = centroid(&opacity, [width, height], at_px, 4.0 * POINT_PX);
            found.map_or(f64::INFINITY, |found_px| found_px.distance(at_px))
        });
        Ok(Self { count: wanted.len(), worst_px: off_px.fold(0.0, f64::max) })
    }
}

/// The middle of what is within reach of a place, in pixels; `None` if nothing is.
pub fn centroid(
    opacity: &[f32],
    [width, height]: [u32; 2],
    around_px: DVec2,
    reach_px: f64,
) -> Option<DVec2> {
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
