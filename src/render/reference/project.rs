//! Stage project by definition.
//!
//! The determinant of a covariance is computed as the sum of the squared minors of its root.
//! `xx yy - xy²` would lose all digits for a needle of 3e8 px, even in f64.

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use crate::constants::MIN_BLUR_SHARE;
use crate::layout::{Filtered, PixelFilter};
use crate::unscented::max_center_angle_rad;
use crate::{FIRST_ACTOR_INSTANCE, TWIN_INSTANCE, View, gaussian_class};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::chunk::column;
use wildcity_scene::geometry::Camera;
use wildcity_scene::{Chunk, RenderProfile, Scene, SemanticClass, sh};

/// A Gaussian on the image.
#[derive(Clone, Copy, Debug)]
pub struct Splat {
    /// The Gaussian: index of its chunk, counting through those of the twin and then through those
    /// of actors, and index within the chunk.
    pub gaussian: [usize; 2],
    /// The owner of the Gaussian, as in [`Target::instances`](crate::Target::instances).
    pub instance: u16,
    /// The class of the Gaussian, as in [`Target::semantics`](crate::Target::semantics).
    pub class: SemanticClass,
    /// Depth of the centre, in metres, by which splats are sorted.
    pub depth_m: f64,
    pub mean_px: DVec2,
    /// Inverse screen covariance (xx, xy, yy), in px⁻².
    pub conic: DVec3,
    pub opacity: f64,
    /// Linear colour towards the camera.
    pub rgb: DVec3,
    /// Half-size of the box outside of which alpha is below alpha_cut, in pixels.
    pub reach_px: DVec2,
}

/// Projects every Gaussian between near and far with an opacity of at least alpha_cut, on the image
/// or outside of it, in order of global ids.
pub fn project(scene: &Scene, profile: &RenderProfile, view: &View) -> Vec<Splat> {
    // Chunks in parallel; the collection keeps their order, and so that of global ids.
    let twin = scene.chunks.par_iter().enumerate().flat_map_iter(|(number, chunk)| {
        let splat = move |i| {
            let gaussian = Gaussian::from_chunk(chunk, i);
            let splat = gaussian.project(profile, view)?;
            let rgb = splat.rgb * shadow_factor(scene, gaussian.mean_m);
            let class = gaussian_class(chunk, i, SemanticClass::Unlabelled);
            Some(Splat { gaussian: [number, i], class, rgb, ..splat })
        };
        (0..chunk.len()).filter_map(splat)
    });
    let actors = scene.placed.par_iter().enumerate().flat_map_iter(|(number, placed)| {
        let view = view.seen_from(placed);
        let tint = DVec3::from_array(placed.tint.map(f64::from));
        let splat = move |i| {
            let splat = Gaussian::from_chunk(&placed.chunk, i).project(profile, &view)?;
            // Actors' chunks are numbered after those of the twin.
            let number = scene.chunks.len() + number;
            let instance = FIRST_ACTOR_INSTANCE + placed.actor;
            let class = gaussian_class(&placed.chunk, i, placed.class);
            let rgb = splat.rgb * tint;
            Some(Splat { gaussian: [number, i], instance, class, rgb, ..splat })
        };
        (0..placed.chunk.len()).filter_map(splat)
    });
    twin.chain(actors).collect()
}

/// The product of all actors' contact shadows at a point of the twin, in the world.
fn shadow_factor(scene: &Scene, at_m: DVec3) -> f64 {
    let factor = |placed: &PlacedChunk| {
        let from_actor_m = at_m - placed.world_from_actor.position_m;
        let in_actor_m = placed.world_from_actor.rotation.inverse() * from_actor_m;
        placed.shadow.map_or(1.0, |shadow| shadow.factor(in_actor_m))
    };
    scene.placed.iter().map(factor).product()
}

/// Sorts by depth rounded to f32; ties keep the order of global ids. The rounding is part of the
/// definition, since backends sort 32 bits: all of them round the exact depth once.
pub(super) fn sort(splats: &mut [Splat]) {
    // rayon's `par_sort_by` is stable.
    splats.par_sort_by(|a, b| (a.depth_m as f32).total_cmp(&(b.depth_m as f32)));
}

/// A Gaussian in f64, in the axes of the world or of its actor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaussian {
    pub mean_m: DVec3,
    /// Takes its own axes to those of `mean_m`. Of any length but zero: it is normalised.
    pub rotation: DQuat,
    /// Standard deviations along its own axes, in metres.
    pub scale_m: DVec3,
    pub log2_opacity: f64,
    /// Spherical harmonics by [`sh::basis`]; those above its degree are 0.
    pub sh: [DVec3; 16],
}

impl Gaussian {
    /// A Gaussian of a chunk.
    pub fn from_chunk(chunk: &Chunk, index: usize) -> Self {
        let value = |column| f64::from(chunk.value(index, column));
        let vector = |first| DVec3::new(value(first), value(first + 1), value(first + 2));
        let q = column::QUAT;
        let mut coefficients = [DVec3::ZERO; 16];
        for (k, to) in coefficients[..sh::coefficients(chunk.sh_degree())].iter_mut().enumerate() {
            *to = vector(column::SH + 3 * k);
        }
        Self {
            mean_m: chunk.origin_m() + vector(column::MEAN),
            rotation: DQuat::from_xyzw(value(q + 1), value(q + 2), value(q + 3), value(q)),
            scale_m: vector(column::SCALE),
            log2_opacity: value(column::LOG2_OPACITY),
            sh: coefficients,
        }
    }

    /// Its axes times their standard deviations, as columns, in metres.
    pub(crate) fn axes_m(&self) -> DMat3 {
        DMat3::from_quat(self.rotation.normalize()) * DMat3::from_diagonal(self.scale_m)
    }

    /// Its place and shape on the image; `None` if it is out of the range of depths or angles.
    pub(super) fn footprint(&self, profile: &RenderProfile, view: &View) -> Option<Footprint> {
        if view.is_static_pinhole() {
            project_pinhole(self.mean_m, self.axes_m(), profile, view)
        } else {
            project_unscented(self.mean_m, self.axes_m(), profile, view)
        }
    }

    /// Projects it; `None` if it cannot be seen.
    pub(super) fn project(&self, profile: &RenderProfile, view: &View) -> Option<Splat> {
        let splat = self.project_any_opacity(profile, view)?;
        let visible = splat.opacity >= profile.alpha_cut;
        visible.then_some(splat)
    }

    /// Projects it, however faint it is; `None` if it is out of the range of depths or angles.
    pub(super) fn project_any_opacity(
        &self,
        profile: &RenderProfile,
        view: &View,
    ) -> Option<Splat> {
        let Footprint { depth_m, mean_px, xx, xy, yy, det_before, camera_m } =
            self.footprint(profile, view)?;
        let filter = PixelFilter::new(profile, &view.camera);
        let Filtered { xx, yy, det, blur_share, shrink_share } =
            filter.filtered(xx, yy, det_before);

        let mut opacity = self.log2_opacity.exp2();
        if profile.antialiased {
            // Yu et al. 2024 (Mip-Splatting), with gsplat's floor.
            opacity *= blur_share.max(MIN_BLUR_SHARE).sqrt();
        }
        opacity *= shrink_share.powf(PixelFilter::SHRINK_POWER);
        Some(Splat {
            gaussian: [0, 0],
            instance: TWIN_INSTANCE,
            class: SemanticClass::Unlabelled,
            depth_m,
            mean_px,
            conic: DVec3::new(yy, -xy, xx) / det,
            opacity,
            rgb: self.color(self.mean_m - camera_m),
            // opacity exp(-k^2/2) = alpha_cut gives k^2 = 2 ln(opacity/cut); times each
            // variance, its root.
            reach_px: (2.0 * (opacity / profile.alpha_cut).ln() * DVec2::new(xx, yy))
                .map(f64::sqrt),
        })
    }

    /// `max(0, SH(direction) + 0.5)`; `toward` leads from the camera to its centre.
    fn color(&self, toward: DVec3) -> DVec3 {
        let basis = sh::basis(toward.normalize());
        let mut rgb = DVec3::splat(0.5);
        for (weight, coefficient) in basis.iter().zip(self.sh) {
            rgb += weight * coefficient;
        }
        rgb.max(DVec3::ZERO)
    }
}

/// Position and shape of a Gaussian on the image, before the blur.
pub(super) struct Footprint {
    pub(super) depth_m: f64,
    pub(super) mean_px: DVec2,
    /// Variance along x before the blur, in px².
    pub(super) xx: f64,
    pub(super) xy: f64,
    pub(super) yy: f64,
    pub(super) det_before: f64,
    /// The camera's position in the world.
    pub(super) camera_m: DVec3,
}

/// Projection by a static pinhole: linearised at the centre.
fn project_pinhole(
    mean_world: DVec3,
    axes_m: DMat3,
    profile: &RenderProfile,
    view: &View,
) -> Option<Footprint> {
    let camera_from_world = view.world_from_camera.inverse();
    let mean = camera_from_world.transform_point(mean_world);
    let in_range = mean.z >= profile.near && mean.z <= profile.far;
    if !in_range {
        return None;
    }
    let m = camera_from_world.rotation_matrix() * axes_m;
    // (J M) rows: J_i M = M^T J_i.
    let [row_x, row_y] = jacobian(mean, &view.camera).map(|row| m.transpose() * row);
    Some(Footprint {
        depth_m: mean.z,
        mean_px: view.camera.pinhole.project(mean),
        xx: row_x.dot(row_x),
        xy: row_x.dot(row_y),
        yy: row_y.dot(row_y),
        det_before: row_x.cross(row_y).length_squared(),
        camera_m: view.world_from_camera.position_m,
    })
}

/// Projection by any other camera: the mean and the scatter of six points, each with weight 1/6
/// (see [`crate::unscented`]).
fn project_unscented(
    mean_world: DVec3,
    axes_m: DMat3,
    profile: &RenderProfile,
    view: &View,
) -> Option<Footprint> {
    let center = view.project_extrapolated(mean_world, 1.0);
    let depth_m = view.camera.depth_m(center.point_m);
    let off_axis_rad = center.point_m.angle_between(DVec3::Z);
    let in_range = depth_m >= profile.near
        && depth_m <= profile.far
        && off_axis_rad <= max_center_angle_rad(&view.camera);
    if !in_range {
        return None;
    }
    let mut points_px = [DVec2::ZERO; 6];
    for (i, point_px) in points_px.iter_mut().enumerate() {
        let side = if i % 2 == 0 { 1.0 } else { -1.0 };
        let point = mean_world + side * 3.0_f64.sqrt() * axes_m.col(i / 2);
        // The search begins anew for each point: simple, and independent of the fast paths.
        *point_px = view.project_extrapolated(point, 1.0).at_px;
    }
    let mean_px = points_px.iter().sum::<DVec2>() / 6.0;
    // Each with weight 1/6, so that the plain sum of products below is the covariance.
    let off_px = points_px.map(|point_px| (point_px - mean_px) / 6.0_f64.sqrt());
    let pairs = (0..6).flat_map(|i| (0..i).map(move |k| (i, k)));
    Some(Footprint {
        depth_m,
        mean_px,
        xx: off_px.iter().map(|off| off.x * off.x).sum(),
        xy: off_px.iter().map(|off| off.x * off.y).sum(),
        yy: off_px.iter().map(|off| off.y * off.y).sum(),
        det_before: pairs.map(|(i, k)| off_px[i].perp_dot(off_px[k]).powi(2)).sum(),
        camera_m: center.world_from_camera.position_m,
    })
}

/// The rows of `∂pixel/∂point` by central differences, in px/m, at the centre with its slopes
/// clamped to 0.3 half-widths beyond the image (gsplat's `persp_proj`).
fn jacobian(mean: DVec3, camera: &Camera) -> [DVec3; 2] {
    let p = &camera.pinhole;
    let width = f64::from(camera.width_px);
    let height = f64::from(camera.height_px);
    let slack_x = 0.3 * 0.5 * width / p.fx;
    let slack_y = 0.3 * 0.5 * height / p.fy;
    let slope = (mean.truncate() / mean.z).clamp(
        DVec2::new(-p.cx / p.fx - slack_x, -p.cy / p.fy - slack_y),
        DVec2::new((width - p.cx) / p.fx + slack_x, (height - p.cy) / p.fy + slack_y),
    );
    let at = (slope * mean.z).extend(mean.z);
    // In proportion to the distance: rounding 1e-16/1e-5 and curvature 1e-10 are both negligible.
    let h = 1e-5 * mean.z;
    let [dx, dy, dz] =
        DVec3::AXES.map(|axis| (p.project(at + h * axis) - p.project(at - h * axis)) / (2.0 * h));
    // Columns of derivatives become rows.
    [DVec3::new(dx.x, dy.x, dz.x), DVec3::new(dx.y, dy.y, dz.y)]
}
