//! Stage project by definition.
//!
//! The covariance's determinant is the sum of the squared minors of its root: `xx yy - xy²` has
//! nothing left of a needle of 3e8 px, even in f64.

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use crate::geometry::Camera;
use crate::render::View;
use crate::scene::chunk::column;
use crate::scene::{Chunk, RenderProfile, Scene, sh};

/// A Gaussian on screen.
#[derive(Clone, Copy, Debug)]
pub struct Splat {
    /// Camera-space z of the centre, in metres: what is sorted.
    pub depth_m: f64,
    /// Centre, in pixels.
    pub mean_px: DVec2,
    /// Inverse screen covariance (xx, xy, yy), in px⁻².
    pub conic: DVec3,
    /// Peak opacity.
    pub opacity: f64,
    /// Colour seen from the camera, linear.
    pub rgb: DVec3,
    /// How far from the centre's column and row anything can reach alpha_cut, in pixels.
    pub reach_px: DVec2,
}

/// Every Gaussian between near and far that can be seen at all, on the image or beside it, in order
/// of global ids.
pub fn project(scene: &Scene, profile: &RenderProfile, view: &View) -> Vec<Splat> {
    let chunks = scene.chunks.par_iter();
    chunks
        .flat_map_iter(|chunk| {
            (0..chunk.len()).filter_map(|i| project_one(chunk, i, profile, view))
        })
        .collect()
}

/// By depth rounded to f32; ties keep the order of global ids. The rounding is part of the
/// definition: backends sort 32 bits.
pub(super) fn sort(splats: &mut [Splat]) {
    splats.par_sort_by(|a, b| (a.depth_m as f32).total_cmp(&(b.depth_m as f32)));
}

fn project_one(chunk: &Chunk, index: usize, profile: &RenderProfile, view: &View) -> Option<Splat> {
    let value = |column| f64::from(chunk.value(index, column));
    let three = |first| DVec3::new(value(first), value(first + 1), value(first + 2));

    let mean_world = chunk.origin_m() + three(column::MEAN);
    let camera_from_world = view.world_from_camera.inverse();
    let mean = camera_from_world.transform_point(mean_world);
    let in_range = mean.z >= profile.near && mean.z <= profile.far;
    if !in_range {
        return None;
    }

    let q = column::QUAT;
    let rotation = DQuat::from_xyzw(value(q + 1), value(q + 2), value(q + 3), value(q)).normalize();
    let m = camera_from_world.rotation_matrix()
        * DMat3::from_quat(rotation)
        * DMat3::from_diagonal(three(column::SCALE));
    let [row_x, row_y] = jacobian(mean, &view.camera).map(|row| m.transpose() * row);
    let det_before = row_x.cross(row_y).length_squared();
    let (xx, xy, yy) = (row_x.dot(row_x), row_x.dot(row_y), row_y.dot(row_y));
    let det = det_before + profile.blur * (xx + yy + profile.blur);
    let (xx, yy) = (xx + profile.blur, yy + profile.blur);

    let mut opacity = value(column::LOG2_OPACITY).exp2();
    if profile.antialiased {
        // Yu et al. 2024 (Mip-Splatting), with gsplat's floor.
        opacity *= (det_before / det).max(0.005 * 0.005).sqrt();
    }
    let can_be_seen = opacity >= profile.alpha_cut;
    can_be_seen.then(|| Splat {
        depth_m: mean.z,
        mean_px: view.camera.pinhole.project(mean),
        conic: DVec3::new(yy, -xy, xx) / det,
        opacity,
        rgb: color(chunk, index, mean_world - view.world_from_camera.position_m),
        reach_px: (2.0 * (opacity / profile.alpha_cut).ln() * DVec2::new(xx, yy)).map(f64::sqrt),
    })
}

/// The rows of `∂pixel/∂point` by central differences, in px/m, at the centre with its slopes
/// clamped to 0.3 half-widths beyond the image (gsplat's `persp_proj`).
fn jacobian(mean: DVec3, camera: &Camera) -> [DVec3; 2] {
    let p = &camera.pinhole;
    let (width, height) = (f64::from(camera.width_px), f64::from(camera.height_px));
    let (slack_x, slack_y) = (0.3 * 0.5 * width / p.fx, 0.3 * 0.5 * height / p.fy);
    let slope = (mean.truncate() / mean.z).clamp(
        DVec2::new(-p.cx / p.fx - slack_x, -p.cy / p.fy - slack_y),
        DVec2::new((width - p.cx) / p.fx + slack_x, (height - p.cy) / p.fy + slack_y),
    );
    let at = (slope * mean.z).extend(mean.z);
    let h = 1e-5 * mean.z;
    let [dx, dy, dz] =
        DVec3::AXES.map(|axis| (p.project(at + h * axis) - p.project(at - h * axis)) / (2.0 * h));
    [DVec3::new(dx.x, dy.x, dz.x), DVec3::new(dx.y, dy.y, dz.y)]
}

/// `max(0, SH(direction) + 0.5)` of a Gaussian seen along `toward` (camera to centre, world axes).
fn color(chunk: &Chunk, index: usize, toward: DVec3) -> DVec3 {
    let basis = sh::basis(toward.normalize());
    let mut rgb = DVec3::splat(0.5);
    for (k, weight) in basis.iter().take(sh::coefficients(chunk.sh_degree())).enumerate() {
        let value = |c| f64::from(chunk.value(index, column::SH + 3 * k + c));
        rgb += weight * DVec3::new(value(0), value(1), value(2));
    }
    rgb.max(DVec3::ZERO)
}
