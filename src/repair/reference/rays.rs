//! The rays of a camera's pixels.

use glam::DVec2;

use wildcity_scene::geometry::Camera;

use super::lanes::LANES;

/// For each pixel of a camera, its point at a depth of 1 m, in the camera's axes.
#[derive(Debug)]
pub struct Rays(Kind);

#[derive(Debug)]
enum Kind {
    /// 1/fx, 1/fy, cx, cy.
    Pinhole([f32; 4]),
    /// Row by row; NaN outside of the lens' field.
    Table(Vec<[f32; 3]>),
}

/// The points of some pixels of a row, one per lane, in metres.
pub(super) struct RayPoints {
    pub(super) x: [f32; LANES],
    pub(super) y: [f32; LANES],
    pub(super) z: [f32; LANES],
}

impl Rays {
    /// The rays of a camera. For a non-pinhole camera, this fills a table of 12 bytes per pixel, in
    /// a microsecond per pixel.
    pub fn from_camera(camera: &Camera) -> Self {
        let pinhole = &camera.pinhole;
        if camera.is_pinhole() {
            let values = [pinhole.fx.recip(), pinhole.fy.recip(), pinhole.cx, pinhole.cy];
            return Self(Kind::Pinhole(values.map(|value| value as f32)));
        }
        let ray = |at: usize| {
            let column = at % camera.width_px as usize;
            let row = at / camera.width_px as usize;
            let at_px = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
            let direction = camera.unproject(at_px);
            // Divided by its own depth, so that a depth in metres scales it to the point.
            let point = direction.map(|direction| direction / camera.depth_m(direction));
            point.map_or([f32::NAN; 3], |point| point.to_array().map(|value| value as f32))
        };
        Self(Kind::Table((0..camera.pixels()).map(ray).collect()))
    }

    /// The points of pixels of a row of an image of a width, from column `left` on, at depths in
    /// metres.
    #[inline(always)]
    pub(super) fn points(
        &self,
        width: usize,
        row: usize,
        left: usize,
        depth_m: &[f32; LANES],
    ) -> RayPoints {
        let mut points = RayPoints { x: [0.0; LANES], y: [0.0; LANES], z: [0.0; LANES] };
        match &self.0 {
            Kind::Pinhole([inverse_fx, inverse_fy, cx, cy]) => {
                // Lanes beyond the image's edge are computed as well, and have a depth of 0.
                let y = (row as f32 + 0.5 - cy) * inverse_fy;
                for (lane, depth_m) in depth_m.iter().enumerate() {
                    let x = ((left + lane) as f32 + 0.5 - cx) * inverse_fx;
                    points.x[lane] = x * depth_m;
                    points.y[lane] = y * depth_m;
                    points.z[lane] = *depth_m;
                }
            }
            Kind::Table(rays) => {
                // The table ends with the row; lanes beyond it stay 0.
                let count = LANES.min(width - left);
                for (lane, ray) in rays[row * width + left..][..count].iter().enumerate() {
                    points.x[lane] = ray[0] * depth_m[lane];
                    points.y[lane] = ray[1] * depth_m[lane];
                    points.z[lane] = ray[2] * depth_m[lane];
                }
            }
        }
        points
    }
}
