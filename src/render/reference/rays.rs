//! Exact rays (`rays=exact`): every pixel's own ray against every Gaussian, without any projection.
//! Lenses, windshields and shutters are compared with this.
//!
//! A Gaussian's alpha on a ray is its response at the point of the ray that is closest in standard
//! deviations (Wu et al. 2024, 3DGUT). This is a 2D Gaussian of the distances across the ray. The
//! blur of the profile is a Gaussian of distances on the image. It is added in the pixels around
//! this ray, where the two distances are proportional to each other.

use glam::{DMat3, DVec2, DVec3};

use super::blend::Pixel;
use super::project::{Gaussian, Splat};
use crate::View;
use crate::layout::{Filtered, PixelFilter};
use wildcity_scene::{RenderProfile, Scene};

/// A Gaussian in the world, or one of an actor in the actor's axes.
#[derive(Clone, Copy, Debug)]
pub(super) struct UnprojectedGaussian {
    /// The view that sees it, as an index into those of [`relative_views`].
    view: usize,
    mean_m: DVec3,
    /// Its axes times their standard deviations, in metres.
    axes_m: DMat3,
    /// The largest standard deviation.
    sigma_m: f64,
    opacity: f64,
}

/// A view in the world, then from the axes of each placed chunk.
pub(super) fn relative_views(scene: &Scene, view: &View) -> Vec<View> {
    let from_actors = scene.placed.iter().map(|placed| view.seen_from(placed));
    std::iter::once(*view).chain(from_actors).collect()
}

/// The Gaussians of splats.
pub(super) fn gaussians(scene: &Scene, splats: &[Splat]) -> Vec<UnprojectedGaussian> {
    let gaussian = |splat: &Splat| {
        let [number, index] = splat.gaussian;
        // Below the number of the twin's chunks the subtraction fails: a Gaussian of the twin.
        let placed = number.checked_sub(scene.chunks.len());
        let chunk = match placed {
            None => &scene.chunks[number],
            Some(placed) => &scene.placed[placed].chunk,
        };
        // View 0 is the world's, view k + 1 that of actor k.
        let view = placed.map_or(0, |placed| placed + 1);
        let gaussian = Gaussian::from_chunk(chunk, index);
        let axes_m = gaussian.axes_m();
        let lengths_m = [axes_m.x_axis, axes_m.y_axis, axes_m.z_axis].map(DVec3::length);
        let sigma_m = lengths_m.into_iter().fold(0.0, f64::max);
        let opacity = gaussian.log2_opacity.exp2();
        UnprojectedGaussian { view, mean_m: gaussian.mean_m, axes_m, sigma_m, opacity }
    };
    splats.iter().map(gaussian).collect()
}

/// One row of pixels, from the left. Splats, in order of depth, give colours and depths, and
/// `gaussians` the shapes. `views` are those of [`relative_views`].
pub(super) fn row(
    splats: &[Splat],
    gaussians: &[UnprojectedGaussian],
    row: u32,
    views: &[View],
    profile: &RenderProfile,
) -> Vec<Pixel> {
    let y_px = f64::from(row) + 0.5;
    let pixel = |column: u32| {
        let mut pixel = Pixel::EMPTY;
        let at_px = DVec2::new(f64::from(column) + 0.5, y_px);
        // One ray per set of axes, once per pixel and not per Gaussian.
        let rays: Vec<Option<Ray>> =
            views.iter().map(|view| Ray::new(view, at_px, profile)).collect();
        for (splat, gaussian) in splats.iter().zip(gaussians) {
            let Some(ray) = &rays[gaussian.view] else { continue };
            let alpha = ray.alpha(gaussian, profile);
            // An alpha of 0 means out of sight and is below every cut.
            if alpha > 0.0 && !pixel.add(alpha, splat, profile) {
                break;
            }
        }
        pixel
    };
    (0..views[0].camera.width_px).map(pixel).collect()
}

/// The ray of a pixel, and how the pixels around it depend on direction.
struct Ray {
    origin_m: DVec3,
    /// Unit, in the world.
    direction: DVec3,
    /// Rows of the Jacobian: how the pixel changes as a point at unit distance moves across the
    /// ray.
    px_per_rad: [DVec3; 2],
    /// A lower bound of the Jacobian's smaller singular value.
    least_px_per_rad: f64,
    /// The variances that are added to screen covariances.
    filter: PixelFilter,
}

impl Ray {
    /// `None` outside of the lens' field.
    fn new(view: &View, at_px: DVec2, profile: &RenderProfile) -> Option<Self> {
        let direction = view.ray_world(at_px)?;
        let pose = view.world_from_camera_at(at_px);
        // How the ray changes per pixel, by differences to both sides, or to the one that is within
        // the field.
        let derivative = |axis: DVec2| {
            // A thousandth of a pixel: f64 leaves ten digits of the difference.
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
        let u = derivative(DVec2::X)?;
        let v = derivative(DVec2::Y)?;
        // The dual basis of (u, v, direction): rows of the inverse.
        let inverse = DMat3::from_cols(u, v, direction).inverse().transpose();
        let x = inverse.x_axis;
        let y = inverse.y_axis;
        // The smaller singular value of a 2 x 3 matrix is at least the area |x × y| divided by the
        // Frobenius norm.
        let least_px_per_rad = x.cross(y).length() / x.length().hypot(y.length());
        let origin_m = pose.position_m;
        let filter = PixelFilter::new(profile, &view.camera);
        Some(Self { origin_m, direction, px_per_rad: [x, y], least_px_per_rad, filter })
    }

    /// Alpha before the cap; 0 where it is certainly below the cut, or the closest point lies
    /// behind the camera.
    fn alpha(&self, gaussian: &UnprojectedGaussian, profile: &RenderProfile) -> f64 {
        let to_mean_m = gaussian.mean_m - self.origin_m;
        let along_m = to_mean_m.dot(self.direction);
        // Skip a Gaussian that is far off the ray whatever its shape: the blur, in metres, is
        // widest at its far end.
        // Pythagoras: squared distance of the centre from the ray.
        let across_m2 = to_mean_m.length_squared() - along_m * along_m;
        let farthest_m = along_m.max(0.0) + 4.0 * gaussian.sigma_m;
        let blur_px2 = self.filter.total_px2.max_element();
        let blur_m2 = blur_px2 * (farthest_m / self.least_px_per_rad).powi(2);
        let sigmas2 = 2.0 * (gaussian.opacity / profile.alpha_cut).ln() + 1e-6;
        let near = across_m2 <= sigmas2 * (gaussian.sigma_m * gaussian.sigma_m + blur_m2);
        if !near {
            return 0.0;
        }
        // The point of the ray that is closest in standard deviations.
        let whiten = |v: DVec3| {
            let m = gaussian.axes_m;
            // The axes are orthogonal, so that the inverse of the matrix needs no elimination. An
            // axis of length 0 has infinitely many standard deviations; 1e-300 keeps them finite.
            let part = |axis: DVec3| v.dot(axis) / axis.length_squared().max(1e-300);
            DVec3::new(part(m.x_axis), part(m.y_axis), part(m.z_axis))
        };
        let toward = whiten(to_mean_m);
        let step = whiten(self.direction);
        // The minimum of |toward - s step|^2 over s.
        let closest_m = toward.dot(step) / step.length_squared();
        let in_front = closest_m > 0.0;
        if !in_front {
            return 0.0;
        }
        // The 2D Gaussian on the image around this pixel, with the blur.
        // Pixels per metre at that distance: pixels per radian over metres.
        let [x, y] = self.px_per_rad.map(|row| row / closest_m);
        let offset_px = DVec2::new(x.dot(to_mean_m), y.dot(to_mean_m));
        let row_x = gaussian.axes_m.transpose() * x;
        let row_y = gaussian.axes_m.transpose() * y;
        let det_before = row_x.cross(row_y).length_squared();
        let xx = row_x.dot(row_x);
        let xy = row_x.dot(row_y);
        let yy = row_y.dot(row_y);
        let Filtered { xx, yy, det, blur_share, shrink_share } =
            self.filter.filtered(xx, yy, det_before);
        let DVec2 { x: dx, y: dy } = offset_px;
        // The inverse of the covariance is its adjugate over the determinant.
        let power = -0.5 * (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / det;
        let mut opacity = gaussian.opacity * shrink_share.powf(PixelFilter::SHRINK_POWER);
        if profile.antialiased {
            opacity *= blur_share.max(0.005 * 0.005).sqrt();
        }
        opacity * power.exp()
    }
}
