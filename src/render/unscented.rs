//! The unscented transform: projection of Gaussians by cameras that no matrix describes (lens
//! distortion, a windshield, a rolling shutter while the camera moves).
//!
//! Six points at √3 standard deviations along a Gaussian's axes are projected as points. Their mean
//! is the splat's mean, and their scatter its covariance, each point with weight 1/6 (Julier and
//! Uhlmann 1997; for Gaussians and such cameras Wu et al. 2024, 3DGUT). The other stages are those
//! of a pinhole.
//!
//! **The centre has no weight.** Of the weights that are exact for a linear camera, this is the
//! choice where all are positive, so nothing cancels, and the covariance keeps a root of six
//! columns. The squares of the root's minors add up to its determinant, as for a pinhole. The other
//! choice in use, α = 0.1, gives the centre a weight of -99.
//!
//! **Limits.** Six points give the first two moments of a Gaussian that the camera maps almost
//! linearly. A Gaussian with a standard deviation along the view of an eighth of its distance comes
//! out 2 % too small (stress case T22), a quarter 9 %.
//!
//! **Lenses are extrapolated beyond their field,** for the shape of Gaussians that reach into it:
//! points may lie where the lens model folds back or has no solution. Where the extrapolation
//! begins belongs to the lens and not to the image, so that a part of an image is the image of the
//! part, except for images that reach beyond 73° off the axis by slopes. Those are extrapolated
//! from a slope of 4 on, 76° off the axis, or from the farthest corner. (From 8 on, where slopes
//! rise by 65 per radian, a road below the camera was torn into splats that reached into the image:
//! 42 dB behind a windshield and 28 dB with a shutter that rolls from the right; now 47 to 49 dB.)
//! Pixels beyond the field are masked when the image is complete, since no bound on splats
//! guarantees that they stay empty.

use glam::{DMat3, DVec2, DVec3, Vec3};

use super::expansion::ExpansionBound;
use super::layout::PixelFilter;
use super::{RollingShutter, View};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::camera::{FieldCone, ScaleWithin, WIDEST_RAD};
use wildcity_scene::geometry::{Camera, Pose};

/// Largest angle of a centre beyond the lens' field at which it is still drawn, in radians: as far
/// as a pinhole of 62° draws Gaussians outside of its image, up to its camera plane.
pub const FIELD_MARGIN_RAD: f64 = 0.5;

/// A view that is not a static pinhole, ready to project many Gaussians.
#[derive(Clone, Copy, Debug)]
pub struct UnscentedView<'a> {
    view: &'a View,
    camera_from_world: Pose,
    /// Nearest and farthest depth of a centre, in metres.
    range_m: [f64; 2],
    cull_bound: CullBound,
    expansion_bound: Option<ExpansionBound>,
}

/// A Gaussian on the image.
#[derive(Clone, Copy, Debug)]
pub struct Footprint {
    /// Mean of the six projected points, in pixels.
    pub mean_px: DVec2,
    /// Columns of a square root of the covariance before the blur: `Σ column columnᵀ`, in pixels.
    pub root_px: [DVec2; 6],
    /// Depth of the centre, in metres.
    pub depth_m: f64,
    /// The camera's position in the world when it sees the centre.
    pub camera_m: DVec3,
}

/// A bound beyond which no Gaussian touches the image.
///
/// Let the angle of a Gaussian's centre off the camera's axis be at least a, and the angles between
/// the centre and the six points at most s. The Gaussian is not seen
///
/// - if `a > max_center`, or
/// - if `least (a - windshield - image) > reach (s + windshield) + blur`, provided that the largest
///   angle of the centre plus `s + windshield` is below [`WIDEST_RAD`].
///
/// The left side of the second condition is the least distance of the centre's image from the
/// image, in pixels, and the right side the farthest that its splat reaches. A Gaussian at distance
/// d has its points within `s = asin(√3 σ/d)` of its centre, and their images within L s of the
/// centre's image, where L is the most pixels per radian between them. So no splat reaches farther
/// than `(1 + sigmas) L s` and the blur. L rises with the angle off the axis, so `reach` is a bound
/// within the narrowest of some cones that has all points.
#[derive(Clone, Copy, Debug)]
pub struct CullBound {
    /// Largest angle off the axis at which a centre is still drawn, in radians.
    pub max_center_rad: f64,
    /// The cosine of that angle.
    pub max_center_cos: f64,
    /// Angle of the image's farthest corner off the axis, in radians.
    pub image_rad: f64,
    /// Least pixels per radian between a point and the image.
    pub least_px_per_rad: f64,
    /// Farthest reach of splats with all their points in a cone, from the narrowest cone to the
    /// widest.
    pub reaches: [ReachWithin; FieldCone::SCALES],
    /// Contribution of the blur to the reach, in pixels.
    pub blur_px: f64,
    /// Largest change of the angle between two rays by a windshield, in radians; 0 without one.
    pub windshield_rad: f64,
    /// Distance that the camera moves during the exposure, in metres.
    pub translation_m: f64,
    /// Angle by which the camera rotates during the exposure, in radians.
    pub rotation_rad: f64,
}

/// A bound of the reach of splats whose points lie within a cone around the camera's axis.
#[derive(Clone, Copy, Debug)]
pub struct ReachWithin {
    /// The cone's angle, in radians off the axis.
    pub rad: f64,
    /// Farthest reach of a splat, in pixels per radian of its points' spread.
    pub px_per_rad: f64,
}

impl CullBound {
    /// Farthest reach of a splat with all points within an angle of the axis, in pixels per radian
    /// of their spread.
    fn reach_px_per_rad(&self, within_rad: f64) -> f64 {
        let cone = self.reaches.iter().find(|cone| within_rad <= cone.rad);
        cone.map_or(f64::INFINITY, |cone| cone.px_per_rad)
    }
}

impl<'a> UnscentedView<'a> {
    /// `None` for a static pinhole.
    pub fn new(view: &'a View, profile: &RenderProfile) -> Option<Self> {
        if view.is_static_pinhole() {
            return None;
        }
        let [translation_m, rotation_rad] = motion(view);
        // The largest extent of any splat, in standard deviations.
        let sigmas = (-2.0 * profile.alpha_cut.ln()).sqrt() + 1e-3;
        let FieldCone { image_rad, least_px_per_rad, scales } =
            // Several cones, since a wide lens has far more pixels per radian at its edge
            // than within.
            FieldCone::from_camera(&view.camera);
        let max_center_rad = max_center_angle_rad(&view.camera);
        let cull_bound = CullBound {
            max_center_rad,
            max_center_cos: max_center_rad.cos(),
            image_rad,
            least_px_per_rad,
            reaches: scales.map(|ScaleWithin { rad, most_px_per_rad }| ReachWithin {
                rad,
                px_per_rad: (1.0 + sigmas) * most_px_per_rad,
            }),
            // 2 px more than the blur, for pixel centres and rounding.
            blur_px: sigmas * PixelFilter::new(profile, &view.camera).max_sigma_px() + 2.0,
            // Both rays of an angle are refracted.
            windshield_rad: view.camera.windshield.map_or(0.0, |glass| 2.0 * glass.most_rad()),
            translation_m,
            rotation_rad,
        };
        Some(Self {
            view,
            camera_from_world: view.world_from_camera.inverse(),
            range_m: [profile.near, profile.far],
            cull_bound,
            expansion_bound: ExpansionBound::new(view, profile),
        })
    }

    /// This camera at another pose or in another motion: only values that depend on its poses are
    /// computed again.
    pub fn moved<'b>(&self, view: &'b View) -> UnscentedView<'b> {
        let [translation_m, rotation_rad] = motion(view);
        UnscentedView {
            view,
            camera_from_world: view.world_from_camera.inverse(),
            range_m: self.range_m,
            cull_bound: CullBound { translation_m, rotation_rad, ..self.cull_bound },
            // The lens is the same.
            expansion_bound: self.expansion_bound.filter(|_| rotation_rad <= 0.5),
        }
    }

    /// Whether a Gaussian with its centre in a box and standard deviations up to `sigma_m` can
    /// touch the image; `true` when in doubt. The box is relative to `origin_m` in the world, in
    /// metres.
    pub fn may_see(&self, origin_m: DVec3, min_m: Vec3, max_m: Vec3, sigma_m: f32) -> bool {
        let center_m = origin_m + (0.5 * (min_m + max_m)).as_dvec3();
        let half_m = f64::from((0.5 * (max_m - min_m)).length());
        let point_m = self.camera_from_world.transform_point(center_m);
        // Half the diagonal as a ball's radius, widened by more than the rounding of f32.
        self.may_touch(point_m, half_m * (1.0 + 1e-6), f64::from(sigma_m))
    }

    /// Projects a Gaussian: its centre in the world, and its axes times their standard deviations,
    /// in metres. `None` if it cannot be seen.
    #[inline(always)]
    pub fn project(&self, mean_m: DVec3, axes_m: DMat3) -> Option<Footprint> {
        // The centre: culled outside of the image, nearer than near, beyond far, and far outside of
        // the field.
        let [near_m, far_m] = self.range_m;
        // The longest axis bounds how far any of the six points is from the centre.
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
            && angle_rad(center.point_m) <= self.cull_bound.max_center_rad;
        if !in_range {
            return None;
        }

        // The six points. Each search for a row begins with the moment at which the centre is
        // exposed.
        let project =
            |point_m: DVec3| self.view.project_extrapolated(point_m, center.fraction).at_px;
        let pairs = [axes_m.x_axis, axes_m.y_axis, axes_m.z_axis].map(|axis_m| {
            let offset_m = 3.0_f64.sqrt() * axis_m;
            [project(mean_m + offset_m), project(mean_m - offset_m)]
        });
        let mean_px = pairs.iter().flatten().sum::<DVec2>() / 6.0;

        // The scatter with weights 1/6. For a pair (a, b) and the mean m, a - m and b - m scatter
        // as much as their half difference and the distance of their middle from m, each √2 times.
        // √2/√6 = 1/√3.
        let third = 3.0_f64.sqrt().recip();
        let [d0, d1, d2] = pairs.map(|[a, b]| 0.5 * (a - b) * third);
        let [e0, e1, e2] = pairs.map(|[a, b]| (0.5 * (a + b) - mean_px) * third);
        let camera_m = center.world_from_camera.position_m;
        Some(Footprint { mean_px, root_px: [d0, d1, d2, e0, e1, e2], depth_m, camera_m })
    }

    /// The view that it projects for.
    pub(super) fn view(&self) -> &'a View {
        self.view
    }

    /// The bound that culls, for tests of many Gaussians at once.
    pub fn cull_bound(&self) -> &CullBound {
        &self.cull_bound
    }

    /// When an expansion replaces the six points; `None` if never.
    pub fn expansion_bound(&self) -> Option<&ExpansionBound> {
        self.expansion_bound.as_ref()
    }

    /// Size of the image, in pixels.
    pub fn size_px(&self) -> DVec2 {
        self.view.camera.size_px()
    }

    /// Whether a Gaussian with its centre in a ball, in the camera's frame at the end of the
    /// exposure, can touch the image: the test of [`CullBound`].
    #[inline(always)]
    fn may_touch(&self, center_m: DVec3, radius_m: f64, sigma_m: f64) -> bool {
        let CullBound {
            max_center_rad,
            image_rad,
            windshield_rad,
            translation_m,
            rotation_rad,
            ..
        } = self.cull_bound;
        // Seen from the camera in motion the centre lies within a larger ball.
        let radius_m = radius_m + translation_m;
        let distance_m = center_m.length();
        if distance_m + radius_m < self.range_m[0] {
            return false;
        }
        // The camera may be within the six points: no bound on angles.
        let points_m = 3.0_f64.sqrt() * sigma_m;
        if distance_m - radius_m <= points_m {
            return true;
        }
        // From here on both arguments of `asin` below are less than 1.
        let least_rad = angle_rad(center_m) - (radius_m / distance_m).asin() - rotation_rad;
        // The centre may be anywhere in the ball: its least angle decides.
        if least_rad > max_center_rad {
            return false;
        }
        let spread_rad = (points_m / (distance_m - radius_m)).asin() + windshield_rad;
        let most_rad = least_rad + 2.0 * (radius_m / distance_m).asin() + 2.0 * rotation_rad;
        // Near the axis' other end the lens is not continued, and the bound does not hold.
        if most_rad + spread_rad >= WIDEST_RAD {
            return true;
        }
        let CullBound { least_px_per_rad, blur_px, .. } = self.cull_bound;
        let reach_px_per_rad = self.cull_bound.reach_px_per_rad(most_rad + spread_rad);
        let reach_px = reach_px_per_rad * spread_rad + blur_px;
        let distance_px = least_px_per_rad * (least_rad - windshield_rad - image_rad);
        let out = distance_px > reach_px;
        !out
    }
}

/// The distance that a view's camera moves during the exposure, in metres, and the angle of its
/// rotation in radians.
fn motion(view: &View) -> [f64; 2] {
    let Some(RollingShutter { world_from_camera_first: first, .. }) = &view.rolling_shutter else {
        return [0.0; 2];
    };
    let last = &view.world_from_camera;
    [first.position_m.distance(last.position_m), first.rotation.angle_between(last.rotation)]
}

/// Largest angle off the axis at which a centre is still drawn, in radians.
pub fn max_center_angle_rad(camera: &Camera) -> f64 {
    (camera.limit_rad() + FIELD_MARGIN_RAD).min(WIDEST_RAD)
}

/// The angle of a point off the axis, in radians.
#[inline(always)]
fn angle_rad(point_m: DVec3) -> f64 {
    point_m.truncate().length().atan2(point_m.z)
}
