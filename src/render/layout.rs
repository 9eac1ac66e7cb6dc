//! Inputs of the fast backends: the scene and views in f64 become camera-relative f32.
//!
//! A position is subtracted from the camera's in f64, once per chunk and frame, and only the
//! difference is rounded to f32: a twin 4,500 km from its origin loses nothing.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3, Vec3, Vec4};
use rayon::prelude::*;

use super::View;
use super::constants::{DEPTH_BITS, SLOPE_SLACK};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::chunk::Cluster;
use wildcity_scene::geometry::Camera;
use wildcity_scene::{Chunk, RenderProfile, Scene, ViewSet};

/// A splat: a Gaussian on the image of one view (48 bytes).
///
/// Its alpha at pixel offset `(dx, dy)` from the mean is `2^(log2_opacity - u² - v²)` with
/// `u = l0 dx + l1 dy`, `v = l2 dy`: the Cholesky factor of half the inverse covariance times
/// log2(e). A sum of squares cannot become negative, however thin the needle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Splat {
    /// Centre, in pixels from the image's top-left corner.
    pub mean_px: [f32; 2],
    /// Factor `(l0, l1, l2)`, in 1/px.
    pub factor: [f32; 3],
    /// Base-2 logarithm of the peak opacity.
    pub log2_opacity: f32,
    /// Linear colour towards this view, at least 0.
    pub rgb: [f32; 3],
    /// Camera-space z of the centre, in metres.
    pub depth_m: f32,
    /// Half-size of the box outside of which alpha is below alpha_cut, in pixels, with
    /// [`EXTENT_SLACK_PX`].
    ///
    /// [`EXTENT_SLACK_PX`]: super::constants::EXTENT_SLACK_PX
    pub extent_px: [f32; 2],
}

/// The thresholds of a render profile, in the form that the kernels compare with.
#[derive(Clone, Copy, Debug)]
pub struct Cutoffs {
    /// Nearest z, in metres.
    pub near_m: f32,
    /// Farthest z, in metres.
    pub far_m: f32,
    /// Whether opacity is scaled down in proportion to the area that the blur adds to a splat.
    pub antialiased: bool,
    pub alpha_cap: f32,
    /// Base-2 logarithm of the smallest alpha.
    pub log2_alpha_cut: f32,
    /// Transmittance at which a pixel stops.
    pub stop: f32,
}

impl Cutoffs {
    /// Rounds a profile to f32.
    pub fn new(profile: &RenderProfile) -> Self {
        Self {
            near_m: profile.near as f32,
            far_m: profile.far as f32,
            antialiased: profile.antialiased,
            alpha_cap: profile.alpha_cap as f32,
            log2_alpha_cut: profile.alpha_cut.log2() as f32,
            stop: profile.stop as f32,
        }
    }

    /// The sort key of a splat: `view (4 bits) | depth (28 bits)`, from the nearest.
    ///
    /// The bits of positive f32 rise with their values, so their difference from the bits of near
    /// is an exact order; 28 bits reach 2^32 times near.
    #[inline(always)]
    pub fn sort_key(&self, view: usize, depth_m: f32) -> u32 {
        // Splats nearer than near are culled, so that the difference is not below 0.
        let depth = depth_m.to_bits() - self.near_m.to_bits();
        (view as u32) << DEPTH_BITS | depth.min((1 << DEPTH_BITS) - 1)
    }

    /// Largest extent of any splat, in standard deviations: 3.33 for 1/255.
    pub fn max_sigmas(&self) -> f32 {
        // exp(-k^2/2) = alpha_cut, with ln(cut) = ln 2 log2(cut).
        (2.0 * std::f32::consts::LN_2 * -self.log2_alpha_cut).sqrt()
    }
}

/// The variances that a view adds to the diagonal of screen covariances, along x and y, in px².
///
/// The blur of a profile belongs to pixels of the camera's native size: a twin is trained on these.
/// A pixel of an image whose sides are `s` times the native ones is the mean of native pixels.
/// Their splats have the variance `s² blur` in its unit. The mean over `n = 1/s` pixels of width
/// `s` adds that of their centres, a row of n points at distances s:
/// `s² (n² - 1)/12 = (1 - s²)/12`. The mean keeps a splat's sum over all pixels, so its peak
/// becomes lower as its area becomes larger, by `√(det before/det after)` of the average.
///
/// Both are exact for a single splat, and not for many: see `samples.rs`. A smaller spread with a
/// peak lower by another power, (1 - s²)/15 and 3/4, is 1 to 2 dB better where layers of large
/// splats end at one edge, and 6 to 13 dB worse where most splats are smaller than a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelFilter {
    /// The profile's blur of native pixels.
    pub native_px2: DVec2,
    /// This blur plus the spread of the native pixels that one pixel averages.
    pub total_px2: DVec2,
}

/// A screen covariance after a [`PixelFilter`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Filtered {
    /// Variance along x, in px².
    pub(super) xx: f64,
    /// Variance along y, in px².
    pub(super) yy: f64,
    /// Determinant of the filtered covariance, in px⁴.
    pub(super) det: f64,
    /// Determinant before the blur of native pixels as a share of the one after it.
    pub(super) blur_share: f64,
    /// Determinant after the blur of native pixels as a share of the one after the whole filter: 1
    /// in a native image.
    pub(super) shrink_share: f64,
}

impl PixelFilter {
    /// Variance of a pixel that averages very many native ones.
    const BOX_PX2: f64 = 1.0 / 12.0;

    /// Opacity is multiplied by the shrink share of a splat to this power.
    pub const SHRINK_POWER: f64 = 0.5;

    /// The filter of a camera's pixels.
    pub fn new(profile: &RenderProfile, camera: &Camera) -> Self {
        let scale = camera.native_scale();
        let native_px2 = profile.blur * (scale * scale);
        // Both terms for s times the native size: s^2 blur + (1 - s^2)/12.
        let total_px2 = native_px2 + Self::BOX_PX2 * (1.0 - scale * scale);
        Self { native_px2, total_px2 }
    }

    /// Whether the image is smaller than the native one. If not, both variances are the profile's
    /// blur.
    #[inline(always)]
    pub fn is_shrunk(&self) -> bool {
        self.native_px2 != self.total_px2
    }

    /// A screen covariance with its diagonal `xx`, `yy` and its determinant, in px², after the
    /// filter.
    #[inline(always)]
    pub(super) fn filtered(&self, xx: f64, yy: f64, det_before: f64) -> Filtered {
        // det(C + diag(u, v)) = det C + u C_yy + v C_xx + u v: a sum of positives.
        // A native image keeps its order of sums, and so its bytes.
        let det_with = |add: DVec2| {
            if self.is_shrunk() {
                det_before + add.x * (yy + add.y) + add.y * xx
            } else {
                det_before + add.x * (xx + yy + add.x)
            }
        };
        let det_native = det_with(self.native_px2);
        let det = det_with(self.total_px2);
        Filtered {
            xx: xx + self.total_px2.x,
            yy: yy + self.total_px2.y,
            det,
            blur_share: det_before / det_native,
            shrink_share: det_native / det,
        }
    }

    /// This covariance with its variances rounded to f32, as the fast backends have them.
    pub(super) fn rounded(&self) -> Self {
        let round = |px2: DVec2| px2.as_vec2().as_dvec2();
        Self { native_px2: round(self.native_px2), total_px2: round(self.total_px2) }
    }

    /// The larger standard deviation, in pixels.
    pub fn max_sigma_px(&self) -> f64 {
        self.total_px2.max_element().sqrt()
    }
}

/// A static pinhole view relative to one chunk.
#[derive(Clone, Copy, Debug)]
pub struct ChunkView {
    /// Rows of the rotation camera_from_world.
    pub rotation: [[f32; 3]; 3],
    /// The chunk's origin in camera space, in metres.
    pub translation_m: [f32; 3],
    /// The camera's forward axis in the world, and the camera-space z of the chunk's origin in
    /// metres. In f64, so that surfels of one plane are not ordered by rounding errors.
    pub forward: [f64; 4],
    /// The camera's centre relative to the chunk's origin, in world axes, in metres.
    pub camera_m: [f32; 3],
    /// Focal lengths, in pixels.
    pub focal_px: [f32; 2],
    /// Principal point, in pixels.
    pub center_px: [f32; 2],
    /// Image size, in pixels.
    pub size_px: [f32; 2],
    /// The variances that are added to screen covariances.
    pub filter: PixelFilter,
    /// Smallest slope x/z and y/z at which the projection is linearised.
    pub slope_min: [f32; 2],
    pub slope_max: [f32; 2],
}

impl ChunkView {
    /// The view relative to a chunk.
    pub fn new(view: &View, chunk: &Chunk, profile: &RenderProfile) -> Self {
        let camera_from_world = view.world_from_camera.inverse();
        // glam has columns: the columns of the transpose are the rows.
        let rotation = camera_from_world.rotation_matrix().transpose();
        let camera_m = view.world_from_camera.position_m - chunk.origin_m();
        let p = &view.camera.pinhole;
        // Slopes of the image's edges, and the slack beyond them.
        let slopes = |size: u32, f: f64, c: f64| {
            let slack = SLOPE_SLACK * 0.5 * f64::from(size) / f;
            // Pixel 0 is at the slope -c/f, the right edge at (size - c)/f.
            [(-c / f - slack) as f32, ((f64::from(size) - c) / f + slack) as f32]
        };
        let x = slopes(view.camera.width_px, p.fx, p.cx);
        let y = slopes(view.camera.height_px, p.fy, p.cy);
        let forward = rotation.z_axis;
        let origin_m = camera_from_world.rotation * -camera_m;
        Self {
            forward: [forward.x, forward.y, forward.z, origin_m.z],
            rotation: rotation.to_cols_array_2d().map(|row| row.map(|r| r as f32)),
            translation_m: origin_m.as_vec3().to_array(),
            camera_m: camera_m.as_vec3().to_array(),
            focal_px: [p.fx as f32, p.fy as f32],
            center_px: [p.cx as f32, p.cy as f32],
            size_px: [view.camera.width_px as f32, view.camera.height_px as f32],
            filter: PixelFilter::new(profile, &view.camera),
            slope_min: [x[0], y[0]],
            slope_max: [x[1], y[1]],
        }
    }
}

/// An actor's contact shadow relative to a chunk of the twin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChunkShadow {
    /// Rows of the rigid transform from the chunk to the actor's axes, translation last, in metres.
    pub actor_from_chunk: [[f32; 4]; 3],
    /// Half the length and half the width of the actor's box, in metres.
    pub half_m: [f32; 2],
    /// Half the size of the box outside of which there is no shadow, in metres.
    reach_m: Vec3,
    /// The views that show it.
    pub views: ViewSet,
}

impl ChunkShadow {
    /// The shadow of an actor; `None` if it has none.
    fn new(placed: &PlacedChunk, chunk: &Chunk) -> Option<Self> {
        let shadow = placed.shadow?;
        let actor_from_world = placed.world_from_actor.rotation.inverse();
        // The difference of positions first, in f64: both may be thousands of kilometres
        // from the origin.
        let origin_m = actor_from_world * (chunk.origin_m() - placed.world_from_actor.position_m);
        let rows = DMat3::from_quat(actor_from_world).transpose();
        let row = |axis: usize| rows.col(axis).extend(origin_m[axis]).as_vec4().to_array();
        Some(Self {
            actor_from_chunk: [row(0), row(1), row(2)],
            half_m: [0.5 * shadow.length_m, 0.5 * shadow.width_m],
            reach_m: shadow.reach_m(),
            views: placed.views,
        })
    }

    /// Whether the shadow can fall on a Gaussian with its centre in a box, relative to the chunk's
    /// origin, in metres; `true` when in doubt.
    pub fn may_touch(&self, min_m: Vec3, max_m: Vec3) -> bool {
        let center_m = (0.5 * (min_m + max_m)).extend(1.0);
        let half_m = 0.5 * (max_m - min_m);
        // The box in the actor's axes, as an interval along each of them. Intervals may overlap
        // where the boxes do not: a doubt.
        (0..3).all(|axis| {
            let row = Vec4::from_array(self.actor_from_chunk[axis]);
            // Larger than any rounding error, which is 1e-5 m at 100 m.
            let spread_m = row.truncate().abs().dot(half_m) + 1e-3;
            row.dot(center_m).abs() <= self.reach_m[axis] + spread_m
        })
    }

    /// Whether the shadow can fall on a Gaussian of a cluster in a view; `true` when in doubt.
    #[inline(always)]
    pub fn falls_on(&self, cluster: &Cluster, view: usize) -> bool {
        self.views.contains(view) && self.may_touch(cluster.min_m, cluster.max_m)
    }

    /// The shadows that may fall on each chunk of the twin; empty if no actor has one.
    pub fn by_chunk(scene: &Scene) -> Vec<Vec<Self>> {
        if scene.placed.iter().all(|placed| placed.shadow.is_none()) {
            return Vec::new();
        }
        let of_chunk = |chunk: &Arc<Chunk>| {
            // The box of the whole chunk: an actor's shadow falls on few chunks.
            let clusters = chunk.clusters().iter();
            let none = (Vec3::INFINITY, Vec3::NEG_INFINITY);
            let (min_m, max_m) =
                clusters.fold(none, |(min_m, max_m), c| (min_m.min(c.min_m), max_m.max(c.max_m)));
            let shadows = scene.placed.iter().filter_map(|placed| Self::new(placed, chunk));
            shadows.filter(|shadow| shadow.may_touch(min_m, max_m)).collect()
        };
        scene.chunks.par_iter().map(of_chunk).collect()
    }
}

/// Half-spaces in which every Gaussian misses the image, to cull whole clusters of 256 at once.
///
/// The bound is that of the linearised projection and not of the true ellipsoid: a linearised splat
/// can be wider than the ellipsoid's outline, and culling must not change a pixel. A splat misses
/// the left edge when `fx x/z + cx + k s (fx/z) √(1 + t²) + k √blur < 0`, where `s` is its largest
/// standard deviation, `t` its clamped slope, `k` the extent in standard deviations and `blur` that
/// of the [`PixelFilter`]: `√cov_xx` is at most `(fx/z) √(1 + t²) s + √blur`. Multiplied by `z/fx`
/// the condition is linear in the centre: `x + ((cx + k √blur)/fx) z + k s √(1 + t²) < 0`. The
/// other edges are analogous. Near and far have no width, since only centres are compared with
/// them.
#[derive(Clone, Copy, Debug)]
pub struct Frustum {
    planes: [Plane; 6],
}

/// A Gaussian is culled if `normal · mean + offset + spread * sigma < 0`.
#[derive(Clone, Copy, Debug)]
struct Plane {
    normal: Vec3,
    offset_m: f32,
    spread: f32,
}

impl Frustum {
    /// The frustum of a view relative to one chunk's origin.
    pub fn new(view: &View, chunk: &Chunk, profile: &RenderProfile) -> Self {
        let p = &view.camera.pinhole;
        let width = f64::from(view.camera.width_px);
        let height = f64::from(view.camera.height_px);
        let sigmas = f64::from(Cutoffs::new(profile).max_sigmas()) + 1e-3;
        // One pixel more than the blur reaches, for pixel centres and rounding.
        let margin_px = sigmas * PixelFilter::new(profile, &view.camera).max_sigma_px() + 1.0;
        // The largest clamped slope.
        let max_slope = |size: f64, f: f64, c: f64| {
            let slack = SLOPE_SLACK * 0.5 * size / f;
            (c / f + slack).abs().max(((size - c) / f + slack).abs())
        };
        let spread_x = sigmas * (1.0 + max_slope(width, p.fx, p.cx).powi(2)).sqrt();
        let spread_y = sigmas * (1.0 + max_slope(height, p.fy, p.cy).powi(2)).sqrt();
        // Left, right, top, bottom, near, far: normal and offset in camera space, and k √(1 + t²).
        let camera_planes = [
            (DVec3::new(1.0, 0.0, (p.cx + margin_px) / p.fx), 0.0, spread_x),
            // The right edge: fx x/z + cx > width, mirrored.
            (DVec3::new(-1.0, 0.0, (width - p.cx + margin_px) / p.fx), 0.0, spread_x),
            (DVec3::new(0.0, 1.0, (p.cy + margin_px) / p.fy), 0.0, spread_y),
            (DVec3::new(0.0, -1.0, (height - p.cy + margin_px) / p.fy), 0.0, spread_y),
            (DVec3::Z, -profile.near * (1.0 - 1e-6), 0.0),
            (DVec3::NEG_Z, profile.far * (1.0 + 1e-6), 0.0),
        ];
        let camera_from_world = view.world_from_camera.inverse();
        let origin = camera_from_world.transform_point(chunk.origin_m());
        // From camera space to the chunk's.
        let plane = |(normal, offset_m, spread): (DVec3, f64, f64)| Plane {
            // A normal turns with the camera; the offset is that at the chunk's origin.
            normal: (view.world_from_camera.rotation * normal).as_vec3(),
            offset_m: (normal.dot(origin) + offset_m) as f32,
            spread: spread as f32,
        };
        Self { planes: camera_planes.map(plane) }
    }

    /// Whether a Gaussian with its centre in a box, relative to the chunk's origin, and standard
    /// deviations up to `sigma_m` can touch the image; `true` when in doubt. The test allows for
    /// rounding errors of 1e-5 of the terms' size.
    pub fn may_see(&self, min_m: Vec3, max_m: Vec3, sigma_m: f32) -> bool {
        let center = 0.5 * (min_m + max_m);
        let half = 0.5 * (max_m - min_m);
        self.planes.iter().all(|plane| {
            // The corner of the box that lies farthest along the normal.
            let nearest = plane.normal.dot(center) + plane.normal.abs().dot(half);
            let distance = nearest + plane.offset_m + plane.spread * sigma_m;
            // Ten times the rounding errors of f32 in three products of this size.
            distance >= -1e-5 * (plane.normal.length() * center.length() + plane.offset_m.abs())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use wildcity_scene::actor::ContactShadow;
    use wildcity_scene::geometry::Pose;

    /// Boxes around an actor that is turned: the test may only reject those without a shadowed
    /// corner.
    #[test]
    fn no_box_with_a_shadowed_corner_is_skipped() {
        // 4,000 km from the origin, where f32 resolves half a metre.
        let world_from_actor = Pose {
            position_m: DVec3::new(4.0e6, -3.0, 0.1),
            rotation: DQuat::from_rotation_z(0.7) * DQuat::from_rotation_y(0.1),
        };
        let chunk = Arc::new(Chunk::new([0, 0], DVec3::new(4.0e6 - 20.0, 0.0, 0.0), 0, 0));
        let shadow = ContactShadow { length_m: 4.0, width_m: 2.0 };
        let placed = PlacedChunk {
            shadow: Some(shadow),
            ..PlacedChunk::at_rest(chunk.clone(), world_from_actor, 0)
        };
        let relative = ChunkShadow::new(&placed, &chunk).unwrap();
        let mut touched = 0;
        for i in 0..4_000_u32 {
            // 4,001 is prime: each factor runs through all shares, in another order.
            let share = |k: u32| f64::from(i * k % 4_001) / 4_001.0 - 0.5;
            let at_m = DVec3::new(10.0 * share(37), 10.0 * share(101), 1.5 * share(467));
            let mean_m = (world_from_actor.position_m - chunk.origin_m() + at_m).as_vec3();
            let half_m = Vec3::new(0.4, 0.3, 0.05) * (1.0 + share(911) as f32);
            let may = relative.may_touch(mean_m - half_m, mean_m + half_m);
            let is_shadowed = |corner: u32| {
                let sign = |bit: u32| if corner >> bit & 1 == 0 { -1.0 } else { 1.0 };
                let corner_m = mean_m + half_m * Vec3::new(sign(0), sign(1), sign(2));
                let from_actor_m =
                    chunk.origin_m() + corner_m.as_dvec3() - world_from_actor.position_m;
                shadow.factor(world_from_actor.rotation.inverse() * from_actor_m) < 1.0
            };
            assert!(may || !(0..8).any(is_shadowed), "{i}");
            touched += u32::from(may);
        }
        // Neither all nor none of the 4,000 boxes may be rejected, or the test shows nothing.
        assert!((400..2_000).contains(&touched), "{touched}");
    }
}
