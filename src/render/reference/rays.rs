//! Every pixel's own ray against every Gaussian: what an image is before anything is projected.
//!
//! A Gaussian's alpha on a ray is its response where the ray comes closest, in its own units (Wu et al.
//! 2024, 3DGUT). That is a Gaussian of the distances across the ray, so the blur, which is one of
//! distances on the image, is added where both are the same: in the pixels around this ray.

use glam::{DMat3, DVec2, DVec3};

use super::blend::Pixel;
use super::project::{Splat, placed};
use crate::View;
use wildcity_scene::{RenderProfile, Scene};

/// A Gaussian in the world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Solid {
    mean_m: DVec3,
    /// Its axes times their standard deviations, in metres.
    axes_m: DMat3,
    /// The longest of them.
    sigma_m: f64,
    /// Opacity before what the profile's antialiasing made of it.
    opacity: f64,
}

/// What each splat was made of.
pub(super) fn solids(scene: &Scene, splats: &[Splat]) -> Vec<Solid> {
    let solid = |splat: &Splat| {
        let [chunk, index] = splat.of;
        let chunk = &scene.chunks[chunk];
        let (mean_m, axes_m) = placed(chunk, index);
        let lengths_m = [axes_m.x_axis, axes_m.y_axis, axes_m.z_axis].map(DVec3::length);
        let sigma_m = lengths_m.into_iter().fold(0.0, f64::max);
        let log2_opacity = chunk.value(index, wildcity_scene::chunk::column::LOG2_OPACITY);
        Solid { mean_m, axes_m, sigma_m, opacity: f64::from(log2_opacity).exp2() }
    };
    splats.iter().map(solid).collect()
}

/// One row of pixels, from the left. Splats, in order of depth, give colours and depths.
pub(super) fn row(
    splats: &[Splat],
    solids: &[Solid],
    row: u32,
    view: &View,
    profile: &RenderProfile,
) -> Vec<Pixel> {
    let y_px = f64::from(row) + 0.5;
    let pixel = |column: u32| {
        let mut pixel = Pixel::EMPTY;
        let Some(ray) = Ray::of(view, DVec2::new(f64::from(column) + 0.5, y_px)) else {
            return pixel;
        };
        for (splat, solid) in splats.iter().zip(solids) {
            let alpha = ray.alpha(solid, profile);
            if alpha > 0.0 && !pixel.add(alpha, splat, profile) {
                break;
            }
        }
        pixel
    };
    (0..view.camera.width_px).map(pixel).collect()
}

/// The ray of a pixel, and the pixels around it.
struct Ray {
    origin_m: DVec3,
    /// Unit, in the world.
    direction: DVec3,
    /// Rows: how the pixel moves with a point at unit distance that moves across the ray, in px.
    px_per_rad: [DVec3; 2],
    /// The least that it moves, in px.
    least_px_per_rad: f64,
}

impl Ray {
    /// `None` outside of the lens' field.
    fn of(view: &View, at_px: DVec2) -> Option<Self> {
        let direction = view.ray_world(at_px)?;
        let pose = view.world_from_camera_at(at_px);
        // How the ray turns per pixel, by differences to one or both sides, whatever the field has.
        let turn = |axis: DVec2| {
            let h = 1e-3;
            let side = |h: f64| {
                let ray = view.camera.unproject(at_px + h * axis)?;
                Some(pose.rotation * ray)
            };
            match (side(h), side(-h)) {
                (Some(after), Some(before)) => Some((after - before) / (2.0 * h)),
                (Some(after), None) => Some((after - direction) / h),
                (None, Some(before)) => Some((direction - before) / h),
                (None, None) => None,
            }
        };
        let (u, v) = (turn(DVec2::X)?, turn(DVec2::Y)?);
        // The dual basis of (u, v, direction): rows of the inverse.
        let inverse = DMat3::from_cols(u, v, direction).inverse().transpose();
        let (x, y) = (inverse.x_axis, inverse.y_axis);
        // The smaller singular value of a 2 x 3 matrix is at least its area over its size.
        let least_px_per_rad = x.cross(y).length() / x.length().hypot(y.length());
        let origin_m = pose.position_m;
        Some(Self { origin_m, direction, px_per_rad: [x, y], least_px_per_rad })
    }

    /// Before the cap; 0 where it cannot reach the cut, or the Gaussian lies behind.
    fn alpha(&self, solid: &Solid, profile: &RenderProfile) -> f64 {
        let to_mean_m = solid.mean_m - self.origin_m;
        let along_m = to_mean_m.dot(self.direction);
        // Far off the ray, whatever the shape: at no point of it is the blur wider than at its end.
        let across_m2 = to_mean_m.length_squared() - along_m * along_m;
        let farthest_m = along_m.max(0.0) + 4.0 * solid.sigma_m;
        let blur_m2 = profile.blur * (farthest_m / self.least_px_per_rad).powi(2);
        let sigmas2 = 2.0 * (solid.opacity / profile.alpha_cut).ln() + 1e-6;
        let near = across_m2 <= sigmas2 * (solid.sigma_m * solid.sigma_m + blur_m2);
        if !near {
            return 0.0;
        }
        // Where the ray comes closest in standard deviations.
        let whiten = |v: DVec3| {
            let m = solid.axes_m;
            let part = |axis: DVec3| v.dot(axis) / axis.length_squared().max(1e-300);
            DVec3::new(part(m.x_axis), part(m.y_axis), part(m.z_axis))
        };
        let (toward, step) = (whiten(to_mean_m), whiten(self.direction));
        let closest_m = toward.dot(step) / step.length_squared();
        let in_front = closest_m > 0.0;
        if !in_front {
            return 0.0;
        }
        let [x, y] = self.px_per_rad.map(|row| row / closest_m);
        let offset_px = DVec2::new(x.dot(to_mean_m), y.dot(to_mean_m));
        let (row_x, row_y) = (solid.axes_m.transpose() * x, solid.axes_m.transpose() * y);
        let det_before = row_x.cross(row_y).length_squared();
        let (xx, xy, yy) = (row_x.dot(row_x), row_x.dot(row_y), row_y.dot(row_y));
        let det = det_before + profile.blur * (xx + yy + profile.blur);
        let (xx, yy) = (xx + profile.blur, yy + profile.blur);
        let DVec2 { x: dx, y: dy } = offset_px;
        let power = -0.5 * (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / det;
        let mut opacity = solid.opacity;
        if profile.antialiased {
            opacity *= (det_before / det).max(0.005 * 0.005).sqrt();
        }
        opacity * power.exp()
    }
}
