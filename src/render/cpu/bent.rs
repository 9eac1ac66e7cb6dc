//! Stage project for lenses and rolling shutters: six points of each Gaussian, where [`Optics`] describes
//! the camera and all of them are within its field 16 Gaussians at a time in f32, else one by one in f64,
//! where [`Bent`] says where each lands.

use fearless_simd::{f32x16, f64x8, mask32x16, prelude::*};
use glam::{DMat3, DQuat, DVec2, DVec3};

use super::lanes::Vec3x16;
use super::optics::{Exposed, Landed, Optics};
use super::project::{Ellipse, LOG2_UNIT, SplatLanes, along, color, rotation_columns, shown};
use crate::View;
use crate::constants::EXTENT_SLACK_PX;
use crate::layout::Cutoffs;
use crate::unscented::{CullBound, Footprint, UnscentedView};
use wildcity_scene::Chunk;
use wildcity_scene::chunk::{LANES, Lanes, column};
use wildcity_scene::geometry::camera::WIDEST_RAD;

/// A chunk as a lens sees it.
#[derive(Clone, Copy)]
pub(super) struct BentView<'a> {
    pub(super) bent: &'a UnscentedView<'a>,
    optics: Option<&'a Optics>,
    origin_m: DVec3,
    /// Rows that take a place in the chunk to the camera's frame, in metres.
    camera_from_chunk: [[f64; 4]; 3],
    /// The camera's centre relative to the chunk's origin, in world axes, in metres.
    camera_m: [f32; 3],
    size_px: [f32; 2],
    /// Whether depth is distance, and not z.
    by_distance: bool,
}

impl<'a> BentView<'a> {
    /// Subtracts in f64, so that a twin far from its origin loses nothing.
    pub(super) fn new(
        view: &View,
        chunk: &Chunk,
        bent: &'a UnscentedView<'a>,
        optics: Option<&'a Optics>,
    ) -> Self {
        let origin_m = chunk.origin_m();
        let camera_from_world = view.world_from_camera.inverse();
        let camera_m = view.world_from_camera.position_m - origin_m;
        let rows = camera_from_world.rotation_matrix().transpose();
        let moved_m = camera_from_world.rotation * -camera_m;
        let row = |axis: usize| rows.col(axis).extend(moved_m[axis]).to_array();
        Self {
            bent,
            optics,
            origin_m,
            camera_from_chunk: [0, 1, 2].map(row),
            camera_m: camera_m.as_vec3().to_array(),
            size_px: view.camera.size_px().as_vec2().to_array(),
            by_distance: view.camera.depth_is_distance(),
        }
    }
}

/// Projects one block of a chunk, or returns `None` if nothing of it can be seen.
#[inline(always)]
pub(super) fn project_block<S: Simd>(
    simd: S,
    columns: &[Lanes],
    sh_degree: u8,
    view: &BentView<'_>,
    cutoffs: &Cutoffs,
) -> Option<SplatLanes> {
    let mut toward_m = [[0.0_f32; LANES]; 3];
    let (mut lanes, left) = match view.optics {
        Some(optics) => project_lanes(simd, columns, (view, optics), cutoffs, &mut toward_m),
        None => (SplatLanes::default(), (1 << LANES) - 1),
    };
    for lane in (0..LANES).filter(|lane| left >> lane & 1 == 1) {
        if let Some(from_camera_m) =
            project_one(columns, lane, (view.bent, view.origin_m), cutoffs, &mut lanes)
        {
            lanes.visible |= 1 << lane;
            for (to, from) in toward_m.iter_mut().zip(from_camera_m.to_array()) {
                to[lane] = from as f32;
            }
        }
    }
    if lanes.visible == 0 {
        return None;
    }
    let [x, y, z] = toward_m.each_ref().map(|axis| f32x16::load_array_ref(simd, axis));
    lanes.paint(color(simd, columns, sh_degree, Vec3x16 { x, y, z }));
    Some(lanes)
}

/// Projects those of a block whose points are within the lens' field, with the ways from the camera to them
/// in metres, and tells which others may be seen.
#[inline(always)]
fn project_lanes<S: Simd>(
    simd: S,
    columns: &[Lanes],
    (view, optics): (&BentView<'_>, &Optics),
    cutoffs: &Cutoffs,
    toward_m: &mut [[f32; LANES]; 3],
) -> (SplatLanes, u64) {
    let splat = |value: f32| f32x16::splat(simd, value);
    let mean = Vec3x16::load(simd, columns, column::MEAN);
    let [right, down, forward] = view.camera_from_chunk;
    let (x, y) = (along(simd, mean, right), along(simd, mean, down));
    let z = along(simd, mean, forward);
    let center = Vec3x16 { x: x.0.narrow(x.1), y: y.0.narrow(y.1), z: z.0.narrow(z.1) };
    let at_end_m = [x, y, z];
    let log2_opacity = f32x16::load_array_ref(simd, &columns[column::LOG2_OPACITY].0);
    let Vec3x16 { x, y, z } = Vec3x16::load(simd, columns, column::SCALE);
    let in_range = log2_opacity.simd_ge(splat(cutoffs.log2_alpha_cut))
        & !beside(simd, center, x.max(y).max(z), view.bent.cull_bound());
    if in_range.all_false() {
        return (SplatLanes::default(), 0);
    }
    let Exposed { landed, share } = optics.expose(simd, center, splat(0.0));
    let mut toward = mean.minus(Vec3x16::splat(simd, view.camera_m));
    if let Some(shutter) = optics.shutter() {
        toward = toward.plus(shutter.way_world(simd, share));
    }
    *toward_m = [toward.x, toward.y, toward.z].map(|axis| axis.to_array());
    let depth_m = depth(simd, at_end_m, (view, optics), center, share);
    let in_depth = depth_m.simd_ge(splat(cutoffs.near_m)) & depth_m.simd_le(splat(cutoffs.far_m));
    // While the shutter rolls, it is the depth only of what has found its row.
    let is_depth = match optics.shutter() {
        None => splat(0.0).simd_ge(splat(0.0)),
        Some(_) => landed.within.simd_ge(splat(0.0)),
    };
    let in_range = in_range & (in_depth | !is_depth);
    if in_range.all_false() {
        return (SplatLanes::default(), 0);
    }
    let own = rotation_columns(simd, columns);
    let [right, down, forward] =
        view.camera_from_chunk.map(|[x, y, z, _]| [x as f32, y as f32, z as f32]);
    let right = Vec3x16::splat(simd, right);
    let down = Vec3x16::splat(simd, down);
    let forward = Vec3x16::splat(simd, forward);
    let mut within = landed.within;
    let mut pairs = [[splat(0.0); 4]; 3];
    let [mut mean_x, mut mean_y] = [splat(0.0); 2];
    for axis in 0..3 {
        let sigma = [x, y, z][axis] * splat(3.0_f32.sqrt());
        let own = own[axis].scale(sigma);
        let offset = Vec3x16 { x: right.dot(own), y: down.dot(own), z: forward.dot(own) };
        let there = center.plus(offset);
        let back = center.minus(offset);
        let Landed { x_px: ax, y_px: ay, within: a } = optics.expose(simd, there, share).landed;
        let Landed { x_px: bx, y_px: by, within: b } = optics.expose(simd, back, share).landed;
        within = within.min(a).min(b);
        pairs[axis] = [ax, ay, bx, by];
        (mean_x, mean_y) = (mean_x + (ax + bx), mean_y + (ay + by));
    }
    let sixth = splat(1.0 / 6.0);
    (mean_x, mean_y) = (mean_x * sixth, mean_y * sixth);

    // As in `Bent::project`: half differences, and middles from the mean.
    let half = splat(0.5 / 3.0_f32.sqrt());
    let mut root = [[splat(0.0); 2]; 6];
    for (axis, [ax, ay, bx, by]) in pairs.into_iter().enumerate() {
        root[axis] = [(ax - bx) * half, (ay - by) * half];
        root[3 + axis] =
            [(ax - mean_x + (bx - mean_x)) * half, (ay - mean_y + (by - mean_y)) * half];
    }
    let [mut xx, mut yy, mut b, mut det_before] = [splat(0.0); 4];
    for (i, [x, y]) in root.into_iter().enumerate() {
        (xx, yy, b) = (x.mul_add(x, xx), y.mul_add(y, yy), x.mul_add(y, b));
        for [other_x, other_y] in &root[..i] {
            let minor = x * *other_y - y * *other_x;
            det_before = minor.mul_add(minor, det_before);
        }
    }
    let ellipse =
        Ellipse::of_moments([xx, yy, b], det_before, splat(cutoffs.blur_px2), splat(LOG2_UNIT));
    let inside = in_range & within.simd_ge(splat(0.0));
    let drawn = (mean_x, mean_y, depth_m);
    let lanes = shown(simd, drawn, log2_opacity, &ellipse, inside, view.size_px, cutoffs);
    (lanes, in_range.to_bitmask() & !inside.to_bitmask())
}

/// Which Gaussians surely are not seen: see [`CullBound`].
#[inline(always)]
fn beside<S: Simd>(
    simd: S,
    center_m: Vec3x16<S>,
    sigma_m: f32x16<S>,
    bound: &CullBound,
) -> mask32x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let off_axis2 = center_m.x.mul_add(center_m.x, center_m.y * center_m.y);
    let distance_m = center_m.z.mul_add(center_m.z, off_axis2).sqrt();
    // Half the angle: atan t for t up to 1 is t (π/4 + 0.273 (1 - t)) within 0.004, and π/2 less that of
    // 1/t beyond.
    let t = off_axis2.sqrt() / (distance_m + center_m.z).max(splat(1e-30));
    let steep = t.simd_gt(splat(1.0));
    let low = steep.select(splat(1.0) / t, t);
    let half = low * splat(-0.273).mul_add(low, splat(std::f64::consts::FRAC_PI_4 + 0.273));
    let half = steep.select(splat(std::f64::consts::FRAC_PI_2) - half, half);
    // asin s is at most s π/3 up to a half.
    let third_turn = splat(std::f64::consts::FRAC_PI_3);
    let moved = splat(bound.moved_m) / distance_m;
    let loose_rad = moved.mul_add(third_turn, splat(0.01 + bound.rolled_rad));
    let (least_rad, most_rad) = (half + half - loose_rad, half + half + loose_rad);
    let share = splat(3.0_f64.sqrt()) * sigma_m / (distance_m - splat(bound.moved_m));
    let spread_rad = share.mul_add(third_turn, splat(bound.turned_rad));
    let reach_px = spread_rad.mul_add(splat(bound.reach_px_per_rad), splat(bound.blur_px));
    let out_px =
        (least_rad - splat(bound.turned_rad + bound.image_rad)) * splat(bound.least_px_per_rad);
    let out = out_px.simd_gt(reach_px) & (most_rad + spread_rad).simd_lt(splat(WIDEST_RAD));
    let far = moved.simd_lt(splat(0.5)) & share.simd_lt(splat(0.5));
    far & (out | least_rad.simd_gt(splat(bound.widest_rad)))
}

/// Sixteen numbers of f64.
type Wide<S> = (f64x8<S>, f64x8<S>);

#[inline(always)]
fn plus<S: Simd>((low, high): Wide<S>, more: f32x16<S>) -> Wide<S> {
    let more = more.widen();
    (low + more.0, high + more.1)
}

/// Depth of centres, in metres: computed in f64 and rounded once, since splats are blended in order of it.
/// They are given in the camera's frame at the exposure's end, and once more in f32; where a share of it is
/// still to come when they are seen, they are farther by what the camera had yet to go.
#[inline(always)]
fn depth<S: Simd>(
    simd: S,
    [mut x, mut y, mut z]: [Wide<S>; 3],
    (view, optics): (&BentView<'_>, &Optics),
    center: Vec3x16<S>,
    share: f32x16<S>,
) -> f32x16<S> {
    if !view.by_distance {
        if let Some(shutter) = optics.shutter() {
            z = plus(z, shutter.farther(simd, center, share));
        }
        return z.0.narrow(z.1);
    }
    if let Some(shutter) = optics.shutter() {
        let way_m = shutter.way(simd, share);
        (x, y, z) = (plus(x, way_m.x), plus(y, way_m.y), plus(z, way_m.z));
    }
    let low = x.0.mul_add(x.0, y.0.mul_add(y.0, z.0 * z.0)).sqrt();
    let high = x.1.mul_add(x.1, y.1.mul_add(y.1, z.1 * z.1)).sqrt();
    low.narrow(high)
}

/// Fills one lane, and returns the way from the camera to the centre, in metres; `None` if the
/// Gaussian cannot be seen.
#[inline(always)]
fn project_one(
    columns: &[Lanes],
    lane: usize,
    (view, origin_m): (&UnscentedView<'_>, DVec3),
    cutoffs: &Cutoffs,
    to: &mut SplatLanes,
) -> Option<DVec3> {
    let value = |column: usize| f64::from(columns[column].0[lane]);
    let three = |first| DVec3::new(value(first), value(first + 1), value(first + 2));
    let log2_cut = f64::from(cutoffs.log2_alpha_cut);
    let mut log2_opacity = value(column::LOG2_OPACITY);
    let opaque = log2_opacity >= log2_cut;
    if !opaque {
        return None;
    }
    let q = column::QUAT;
    let rotation = DQuat::from_xyzw(value(q + 1), value(q + 2), value(q + 3), value(q));
    let axes_m = DMat3::from_quat(rotation) * DMat3::from_diagonal(three(column::SCALE));
    let mean_m = origin_m + three(column::MEAN);
    let Footprint { mean_px, root_px, depth_m, camera_m } = view.project(mean_m, axes_m)?;

    // The covariance, its determinant as a sum of positives, and the factor of its inverse: as of a
    // pinhole's 2 x 3 root, with 6 columns.
    let blur = f64::from(cutoffs.blur_px2);
    let (mut xx, mut yy, mut b, mut det_before) = (0.0, 0.0, 0.0, 0.0);
    for (i, column_px) in root_px.iter().enumerate() {
        xx += column_px.x * column_px.x;
        yy += column_px.y * column_px.y;
        b += column_px.x * column_px.y;
        for other_px in &root_px[..i] {
            let minor = column_px.perp_dot(*other_px);
            det_before += minor * minor;
        }
    }
    let det = det_before + blur * (xx + yy + blur);
    if cutoffs.antialiased {
        log2_opacity += 0.5 * (det_before / det).max(0.005 * 0.005).log2();
    }
    let power = log2_opacity - log2_cut;
    let unit = f64::from(LOG2_UNIT);
    let (sigma_x, sigma_y) = ((xx + blur).sqrt(), (yy + blur).sqrt());
    let extent_px =
        power.max(0.0).sqrt() / unit * DVec2::new(sigma_x, sigma_y) + f64::from(EXTENT_SLACK_PX);
    let on_image = power >= 0.0
        && (mean_px + extent_px).cmpge(DVec2::splat(0.5)).all()
        && (mean_px - extent_px).cmple(view.size_px() - 0.5).all();
    if !on_image {
        return None;
    }
    let l2 = unit / sigma_y;
    let root_det = det.sqrt();
    to.mean_x[lane] = mean_px.x as f32;
    to.mean_y[lane] = mean_px.y as f32;
    to.l0[lane] = (unit * sigma_y / root_det) as f32;
    to.l1[lane] = (-(b * l2) / root_det) as f32;
    to.l2[lane] = l2 as f32;
    to.log2_opacity[lane] = log2_opacity as f32;
    to.depth_m[lane] = depth_m as f32;
    to.extent_x[lane] = extent_px.x as f32;
    to.extent_y[lane] = extent_px.y as f32;
    Some(mean_m - camera_m)
}
