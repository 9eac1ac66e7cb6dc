//! The unscented transform: how a Gaussian lands on the image of a lens or of a rolling shutter, which
//! no matrix describes.
//!
//! Six points at √3 standard deviations along its axes are projected as points. Their mean is the
//! splat's, and a sixth of their scatter, three times over, its covariance (Julier and Uhlmann 1997;
//! for Gaussians on cameras Wu et al. 2024, 3DGUT). The centre has no weight: of the weights that are exact
//! for a linear camera, this is the choice where all are positive, and none cancels another.

use glam::{DMat3, DVec2, DVec3, Vec3};

use super::{RollingShutter, View};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::camera::{FieldCone, WIDEST_RAD};
use wildcity_scene::geometry::{Camera, Pose};

/// How far beyond its lens' field a centre may lie and still be drawn, in radians: as far as a pinhole
/// of 62° draws what is beside it, up to its plane.
pub const FIELD_MARGIN_RAD: f64 = 0.5;

/// A view of a lens or with a rolling shutter, ready to project many Gaussians.
#[derive(Clone, Copy, Debug)]
pub struct UnscentedView<'a> {
    view: &'a View,
    camera_from_world: Pose,
    /// Nearest and farthest depth of a centre, in metres.
    range_m: [f64; 2],
    cull_bound: CullBound,
}

/// Where a Gaussian lands.
#[derive(Clone, Copy, Debug)]
pub struct Footprint {
    /// Mean, in pixels.
    pub mean_px: DVec2,
    /// A square root of the covariance before the blur: `Σ column columnᵀ`, in pixels.
    pub root_px: [DVec2; 6],
    /// Depth of the centre, in metres.
    pub depth_m: f64,
    /// The camera's centre when it sees this one, in the world.
    pub camera_m: DVec3,
}

/// The numbers of the bound that [`UnscentedView::may_see`] explains. A Gaussian whose centre is never less than an angle
/// a off the axis, and whose points are within s of it, is not seen if `a > widest`, or if
/// `least (a - turned - image) > reach (s + turned) + blur` and its centre's largest angle and `s + turned`
/// are below [`WIDEST_RAD`] together.
#[derive(Clone, Copy, Debug)]
pub struct CullBound {
    /// How far a centre may be off the axis, in radians.
    pub widest_rad: f64,
    /// How far off the axis the image's corner is, in radians.
    pub image_rad: f64,
    /// Fewest pixels that an angle beyond the image makes, per radian.
    pub least_px_per_rad: f64,
    /// How far a splat reaches at most, in pixels per radian of its points' spread.
    pub reach_px_per_rad: f64,
    /// What the blur adds to it, in pixels.
    pub blur_px: f64,
    /// What a windshield may add to angles, in radians.
    pub turned_rad: f64,
    /// How far the camera moves and turns during the exposure, in metres and radians.
    pub moved_m: f64,
    /// See there.
    pub rolled_rad: f64,
}

impl<'a> UnscentedView<'a> {
    /// `None` for a pinhole at rest.
    pub fn new(view: &'a View, profile: &RenderProfile) -> Option<Self> {
        if view.is_static_pinhole() {
            return None;
        }
        let [moved_m, rolled_rad] = view.rolling_shutter.map_or(
            [0.0; 2],
            |RollingShutter { world_from_camera_first: first, .. }| {
                let last = &view.world_from_camera;
                [
                    first.position_m.distance(last.position_m),
                    first.rotation.angle_between(last.rotation),
                ]
            },
        );
        // The largest extent of any splat, in standard deviations.
        let sigmas = (-2.0 * profile.alpha_cut.ln()).sqrt() + 1e-3;
        let FieldCone { image_rad, least_px_per_rad, most_px_per_rad } =
            FieldCone::of(&view.camera);
        let cull_bound = CullBound {
            widest_rad: max_center_angle_rad(&view.camera),
            image_rad,
            least_px_per_rad,
            reach_px_per_rad: (1.0 + sigmas) * most_px_per_rad,
            blur_px: sigmas * profile.blur.sqrt() + 2.0,
            turned_rad: view.camera.windshield.map_or(0.0, |_| 0.4),
            moved_m,
            rolled_rad,
        };
        Some(Self {
            view,
            camera_from_world: view.world_from_camera.inverse(),
            range_m: [profile.near, profile.far],
            cull_bound,
        })
    }

    /// Whether anything of a box of centres, relative to `origin_m` in the world, can touch the image.
    ///
    /// A Gaussian at distance d has its points within `asin(√3 σ/d)` of its centre, and they land
    /// within that times the most pixels per radian, L, of where it does. No splat reaches farther
    /// than `(1 + sigmas) L asin(√3 σ/d)` and the blur from there.
    pub fn may_see(&self, origin_m: DVec3, min_m: Vec3, max_m: Vec3, sigma_m: f32) -> bool {
        let center_m = origin_m + (0.5 * (min_m + max_m)).as_dvec3();
        let half_m = f64::from((0.5 * (max_m - min_m)).length());
        let point_m = self.camera_from_world.transform_point(center_m);
        self.may_touch(point_m, half_m * (1.0 + 1e-6), f64::from(sigma_m))
    }

    /// Projects a Gaussian: its centre in the world and its axes times their standard deviations, in
    /// metres. `None` if it cannot be seen.
    #[inline(always)]
    pub fn project(&self, mean_m: DVec3, axes_m: DMat3) -> Option<Footprint> {
        let [near_m, far_m] = self.range_m;
        let sigma_m =
            axes_m.x_axis.length().max(axes_m.y_axis.length()).max(axes_m.z_axis.length());
        let at_end_m = self.camera_from_world.transform_point(mean_m);
        if !self.may_touch(at_end_m, 0.0, sigma_m) {
            return None;
        }
        let center = self.view.project_extrapolated(mean_m, 1.0);
        let depth_m = self.view.camera.depth_m(center.point_m);
        let in_range = depth_m >= near_m
            && depth_m <= far_m
            && angle_rad(center.point_m) <= self.cull_bound.widest_rad;
        if !in_range {
            return None;
        }
        let land = |point_m: DVec3| self.view.project_extrapolated(point_m, center.fraction).at_px;
        let pairs = [axes_m.x_axis, axes_m.y_axis, axes_m.z_axis].map(|axis_m| {
            let offset_m = 3.0_f64.sqrt() * axis_m;
            [land(mean_m + offset_m), land(mean_m - offset_m)]
        });
        let mean_px = pairs.iter().flatten().sum::<DVec2>() / 6.0;
        // Of each pair (a, b): a - m and b - m scatter as much as their half difference and their
        // middle's distance from m, each √2 times.
        let third = 3.0_f64.sqrt().recip();
        let [d0, d1, d2] = pairs.map(|[a, b]| 0.5 * (a - b) * third);
        let [e0, e1, e2] = pairs.map(|[a, b]| (0.5 * (a + b) - mean_px) * third);
        let camera_m = center.world_from_camera.position_m;
        Some(Footprint { mean_px, root_px: [d0, d1, d2, e0, e1, e2], depth_m, camera_m })
    }

    /// What decides beside the field, for tests of many Gaussians at once.
    pub fn cull_bound(&self) -> &CullBound {
        &self.cull_bound
    }

    /// Size of the image, in pixels.
    pub fn size_px(&self) -> DVec2 {
        self.view.camera.size_px()
    }

    /// Whether a Gaussian within a ball, in the camera's frame at the end of the exposure, can touch
    /// the image.
    #[inline(always)]
    fn may_touch(&self, center_m: DVec3, radius_m: f64, sigma_m: f64) -> bool {
        let CullBound { widest_rad, image_rad, turned_rad, moved_m, rolled_rad, .. } =
            self.cull_bound;
        let radius_m = radius_m + moved_m;
        let distance_m = center_m.length();
        if distance_m + radius_m < self.range_m[0] {
            return false;
        }
        let points_m = 3.0_f64.sqrt() * sigma_m;
        if distance_m - radius_m <= points_m {
            return true;
        }
        let nearest_rad = angle_rad(center_m) - (radius_m / distance_m).asin() - rolled_rad;
        if nearest_rad > widest_rad {
            return false;
        }
        let spread_rad = (points_m / (distance_m - radius_m)).asin() + turned_rad;
        let farthest_rad = nearest_rad + 2.0 * (radius_m / distance_m).asin() + 2.0 * rolled_rad;
        if farthest_rad + spread_rad >= WIDEST_RAD {
            return true;
        }
        let CullBound { least_px_per_rad, reach_px_per_rad, blur_px, .. } = self.cull_bound;
        let reach_px = reach_px_per_rad * spread_rad + blur_px;
        let beyond_px = least_px_per_rad * (nearest_rad - turned_rad - image_rad);
        let out = beyond_px > reach_px;
        !out
    }
}

/// How far off the axis a centre may lie and still be drawn, in radians.
pub fn max_center_angle_rad(camera: &Camera) -> f64 {
    (camera.limit_rad() + FIELD_MARGIN_RAD).min(WIDEST_RAD)
}

/// The angle of a point off the axis, in radians.
#[inline(always)]
fn angle_rad(point_m: DVec3) -> f64 {
    point_m.truncate().length().atan2(point_m.z)
}
