//! Reprojection error: how far a camera's images of known points are from where its model puts
//! them.

use glam::DVec2;

use crate::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::{Gaussians, RenderProfile, Scene};

/// Number of points across the image and down.
const GRID: [u32; 2] = [7, 5];
/// Distance of the points from the camera, in metres.
const DISTANCE_M: f64 = 10.0;
/// Standard deviation of a point's image, in pixels. Its centroid is taken within four of them.
const POINT_PX: f64 = 2.0;

/// Points that a camera should show.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReprojectionErrors {
    pub count: usize,
    /// Largest distance of a point's image from its pixel; infinite if a point is not visible.
    pub worst_px: f64,
}

impl ReprojectionErrors {
    /// Renders a grid of small Gaussians, each on the ray of a known pixel, and measures the
    /// distances of their images' centroids from these pixels.
    ///
    /// # Errors
    /// The backend cannot draw them.
    pub fn measure(backend: &dyn Backend, view: &View) -> Result<Self, RenderError> {
        let size_px = view.camera.size_px();
        let mut gaussians = Gaussians::with_capacity(0, 0);
        let mut wanted = Vec::new();
        for (row, column) in (0..GRID[1]).flat_map(|row| (0..GRID[0]).map(move |k| (row, k))) {
            // The middle of one of GRID equal cells of the image, 0.37 px into a pixel, off its
            // centre.
            let share =
                (DVec2::new(column.into(), row.into()) + 0.5) / DVec2::from(GRID.map(f64::from));
            // Off the centre, so that a model that rounds to pixels or is off by a half shows up.
            let at_px = (share * size_px).floor() + 0.37;
            let rays = view.ray_world(at_px).zip(view.ray_world(at_px + DVec2::X));
            // A pixel outside of the lens' field has no ray and no point.
            let Some((ray, next_ray)) = rays else { continue };
            wanted.push(at_px);
            // The angle of one pixel, times the distance, is a pixel's width there in metres.
            let sigma_m = POINT_PX * DISTANCE_M * ray.angle_between(next_ray);
            gaussians
                .means_m
                .push((view.world_from_camera.position_m + DISTANCE_M * ray).to_array());
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([sigma_m.ln() as f32; 3]);
            // An opacity of 0.88: well above the cut, and below the cap of alpha.
            gaussians.logit_opacities.push(2.0);
            gaussians.sh.extend([1.0; 3]);
        }
        let mut opacity = vec![0.0; view.camera.pixels()];
        let scene = Scene::from_gaussians(&gaussians);
        let profile = RenderProfile::default();
        let views = [*view];
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let target = Target { opacity: Some(&mut opacity), ..Target::default() };
        backend.render(&frame, &mut [target], &|_, _| {})?;
        let size_px = [view.camera.width_px, view.camera.height_px];
        let off_px = wanted.iter().map(|&at_px| {
            // Four standard deviations are 8 px: in an image more than 112 px wide and 80 px high
            // the images of two points do not reach into each other's window.
            let found = centroid(&opacity, size_px, at_px, 4.0 * POINT_PX);
            found.map_or(f64::INFINITY, |found_px| found_px.distance(at_px))
        });
        Ok(Self { count: wanted.len(), worst_px: off_px.fold(0.0, f64::max) })
    }
}

/// The centroid of opacity within a square around a place, in pixels; `None` if opacity is 0 there.
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
    let mut sum_px = DVec2::ZERO;
    let mut weight = 0.0;
    for row in range(around_px.y, height) {
        for column in range(around_px.x, width) {
            let seen = f64::from(opacity[(row * width + column) as usize]);
            // The centre of a pixel lies at +0.5.
            sum_px += seen * (DVec2::new(f64::from(column), f64::from(row)) + 0.5);
            weight += seen;
        }
    }
    (weight > 0.0).then(|| sum_px / weight)
}
