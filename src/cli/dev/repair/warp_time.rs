//! The time that the references of a view take, in addition to the model.

use std::sync::Arc;
use std::time::Instant;

use glam::{DVec2, DVec3};

use wildcity_repair::Image;
use wildcity_repair::reference::{Projection, Rays, Reference, WarpTarget, warp};
use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};

/// The wall that the cameras look at, in metres ahead.
const WALL_M: f64 = 20.0;

/// Places of the references, in metres ahead of the view.
const AHEAD_M: [f64; 5] = [-8.0, -5.5, -3.0, -0.5, 2.0];

/// Seconds to warp five references that show the whole view into it, on one core: with a pinhole,
/// and with a fisheye.
pub(super) fn seconds(width: usize, height: usize) -> [f64; 2] {
    let pinhole = Pinhole {
        fx: 0.6 * width as f64,
        fy: 0.6 * width as f64,
        cx: 0.5 * width as f64,
        cy: 0.5 * height as f64,
    };
    let straight = Camera::from_pinhole(width as u32, height as u32, pinhole);
    let fisheye = Camera { lens: Lens::Fisheye(Fisheye::new([0.0; 4], None)), ..straight };
    [straight, fisheye].map(|camera| {
        let projection = Arc::new(Projection::from_camera(&camera));
        let rays = Rays::from_camera(&camera);
        let references: Vec<Arc<Reference>> = AHEAD_M
            .into_iter()
            .map(|ahead_m| {
                let image = Image { width, height, rgb8: vec![128; 3 * width * height] };
                let depth_m = depth(&camera, WALL_M - ahead_m);
                let projection = projection.clone();
                let position_m = DVec3::new(0.0, 0.0, ahead_m);
                let world_from_camera = Pose { position_m, ..Pose::IDENTITY };
                Arc::new(Reference { image, depth_m, projection, world_from_camera })
            })
            .collect();
        let position_m = DVec3::new(3.0, 0.0, 0.0);
        let target = WarpTarget {
            camera: &camera,
            rays: &rays,
            world_from_camera: Pose { position_m, ..Pose::IDENTITY },
            shutter: None,
            depth_m: &depth(&camera, WALL_M),
        };
        let start = Instant::now();
        let warped = warp(&target, &references);
        let seconds = start.elapsed().as_secs_f64();
        // Used, so that it is computed.
        if warped.valid.is_empty() { 0.0 } else { seconds }
    })
}

/// The depth of a wall across the axis.
fn depth(camera: &Camera, wall_m: f64) -> Vec<f32> {
    let width = camera.width_px as usize;
    let depth_m = |at: usize| {
        let at_px = DVec2::new((at % width) as f64 + 0.5, (at / width) as f64 + 0.5);
        // Nearly parallel to the wall, a ray meets it too far away to matter.
        let ray = camera.unproject(at_px).filter(|ray| ray.z > 0.05);
        ray.map_or(0.0, |ray| camera.depth_m(ray * (wall_m / ray.z)) as f32)
    };
    (0..camera.pixels()).map(depth_m).collect()
}
