//! The derivatives of the projection by a static pinhole.

use fearless_simd::{f32x16, prelude::*};

use super::{Block, add, add3, by_quaternion, color, visible_lanes};
use crate::constants::{MAX_SIGMA_PX, MIN_BLUR_SHARE};
use crate::cpu::lanes::Vec3x16;
use crate::cpu::project::axes::rotation_columns;
use crate::cpu::project::pinhole::{along_axes, camera_coordinate, depth, jacobian_row};
use crate::gradient::partial;
use crate::layout::{ChunkView, PixelFilter};
use wildcity_scene::chunk::{Lanes, column};

/// Adds the derivatives by a block of 16 Gaussians, and by the view's twist.
///
/// A row of the root is `v_k = jw · r_k s_k`, with the row `jw = (f/z)(W_x - (x/z) W_z)` of J W,
/// and the own axes r. So with `q = Σ b_k s_k r_k` of the derivatives b by the row, q is the
/// derivative by jw, and `q × jw` the torque on the axes.
#[inline(always)]
pub(super) fn back_project<S: Simd>(
    simd: S,
    block: Block<'_>,
    view: &ChunkView,
    to: &mut [Lanes],
    twist: &mut [f64; 6],
) {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let Block { columns, splats, by, .. } = block;
    let visible = visible_lanes(simd, splats.visible);

    let mean = Vec3x16::load(simd, columns, column::MEAN);
    let z = depth(simd, view, mean);
    let x = camera_coordinate(simd, view, mean, 0);
    let y = camera_coordinate(simd, view, mean, 1);
    let inverse_z = splat(1.0) / z;
    let slope_x = x * inverse_z;
    let slope_y = y * inverse_z;
    let axes = rotation_columns(simd, columns);
    let scale = Vec3x16::load(simd, columns, column::SCALE);
    let jw_x = jacobian_row(simd, view, 0, slope_x, inverse_z);
    let jw_y = jacobian_row(simd, view, 1, slope_y, inverse_z);
    let v0 = along_axes(jw_x, axes).times(scale);
    let v1 = along_axes(jw_y, axes).times(scale);

    // By the covariance, `2 ln2² Fᵀ M F`, and through the opacity's scales.
    let l0 = f32x16::load_array_ref(simd, &splats.l0);
    let l1 = f32x16::load_array_ref(simd, &splats.l1);
    let l2 = f32x16::load_array_ref(simd, &splats.l2);
    let g = by.load(simd, partial::G);
    let uv = by.load(simd, partial::UV);
    let is_shrunk = view.filter.is_shrunk();
    let antialiased = block.cutoffs.antialiased;
    let OpacityScale { total, by_before, by_native } = if antialiased || is_shrunk {
        OpacityScale::new(simd, v0, v1, g, view, antialiased)
    } else {
        OpacityScale::none(simd)
    };
    // The total covariance has the inverse 2 ln2 Fᵀ F, which fits into M.
    let per_ln2 = splat(std::f64::consts::LN_2.recip());
    let uu = total.mul_add(-per_ln2, by.load(simd, partial::UU));
    let vv = total.mul_add(-per_ln2, by.load(simd, partial::VV));

    // By the rows of the root. The derivative `2 V v` of a column v is `2 Fᵀ z` with `z = 2 ln2² M
    // w` and `w = F v`. A needle is a thousand times longer than wide, and so is v, while V is as
    // large as its width asks for: `v V v` would cancel to nothing, and `w z` does not.
    let w_u = v0.scale(l0).plus(v1.scale(l1));
    let w_v = v1.scale(l2);
    let four = splat(4.0 * std::f64::consts::LN_2 * std::f64::consts::LN_2);
    let z_u = w_u.scale(uu).plus(w_v.scale(uv)).scale(four);
    let z_v = w_u.scale(uv).plus(w_v.scale(vv)).scale(four);
    let two = splat(2.0);
    let of_filter_0 =
        v0.scale(by_native[0]).plus(v1.scale(by_native[1])).mul_add(two, by_before[0]);
    let of_filter_1 =
        v0.scale(by_native[1]).plus(v1.scale(by_native[2])).mul_add(two, by_before[1]);
    let by_v0 = z_u.mul_add(l0, of_filter_0);
    let by_v1 = z_u.mul_add(l1, z_v.mul_add(l2, of_filter_1));
    let of_shape = w_u.times(z_u).plus(w_v.times(z_v));
    let by_ln_scale = of_shape.plus(of_filter_0.times(v0)).plus(of_filter_1.times(v1));
    let combined = |b: Vec3x16<S>| {
        let b = b.times(scale);
        axes[0].scale(b.x).plus(axes[1].scale(b.y)).plus(axes[2].scale(b.z))
    };
    let q_x = combined(by_v0);
    let q_y = combined(by_v1);
    let torque = q_x.cross(jw_x).plus(q_y.cross(jw_y));

    // By the centre, in the camera's axes.
    let [fx, fy] = view.focal_px.map(f64::from).map(splat);
    let two_ln2 = splat(2.0 * std::f64::consts::LN_2);
    let gu = by.load(simd, partial::U);
    let gv = by.load(simd, partial::V);
    let by_mean_x = two_ln2 * l0 * gu;
    let by_mean_y = two_ln2 * l1.mul_add(gu, l2 * gv);
    let forward = Vec3x16::splat(simd, view.rotation[2]);
    let by_slope = |focal: f32x16<S>, by_mean: f32x16<S>, q: Vec3x16<S>, slope, axis: usize| {
        let is_free = f32x16::simd_ge(slope, splat(view.slope_min[axis].into()))
            & f32x16::simd_le(slope, splat(view.slope_max[axis].into()));
        // The linearisation does not follow a slope that is clamped.
        let of_shape = is_free.select(inverse_z * q.dot(forward), splat(0.0));
        focal * (by_mean - of_shape)
    };
    let by_slope_x = by_slope(fx, by_mean_x, q_x, slope_x, 0);
    let by_slope_y = by_slope(fy, by_mean_y, q_y, slope_y, 1);
    let along = by_slope_x.mul_add(slope_x, by_slope_y * slope_y) + q_x.dot(jw_x) + q_y.dot(jw_y);
    let by_point = Vec3x16 {
        x: by_slope_x * inverse_z,
        y: by_slope_y * inverse_z,
        z: by.load(simd, partial::DEPTH) - along * inverse_z,
    };

    let toward = mean.minus(Vec3x16::splat(simd, view.camera_m));
    let by_toward = color::back_project(simd, block, toward, visible, to);
    let rows = view.rotation.map(|row| Vec3x16::splat(simd, row));
    let by_mean = rows[0]
        .mul_add(by_point.x, rows[1].mul_add(by_point.y, rows[2].mul_add(by_point.z, by_toward)));
    add3(simd, to, column::MEAN, by_mean, visible);
    add3(simd, to, column::SCALE, by_ln_scale, visible);
    for (k, value) in by_quaternion(simd, columns, torque).into_iter().enumerate() {
        add(simd, to, column::QUAT + k, value, visible);
    }
    add(simd, to, column::LOG2_OPACITY, splat(std::f64::consts::LN_2) * g, visible);

    // By the twist: ρ moves the point and the direction, φ turns the point and the axes.
    let to_camera =
        |v: Vec3x16<S>| Vec3x16 { x: rows[0].dot(v), y: rows[1].dot(v), z: rows[2].dot(v) };
    let rho = by_point.plus(to_camera(by_toward));
    let phi = Vec3x16 { x, y, z }.cross(by_point).plus(to_camera(torque));
    let shown = visible.simd_gt(splat(0.0));
    for (sum, value) in twist.iter_mut().zip([rho.x, rho.y, rho.z, phi.x, phi.y, phi.z]) {
        *sum += f64::from(shown.select(value, splat(0.0)).reduce_sum());
    }
}

/// The derivatives through the scales of the opacity: powers of shares of determinants.
struct OpacityScale<S: Simd> {
    /// Share of g that has the total covariance's determinant with a minus.
    total: f32x16<S>,
    /// By the rows of the root.
    by_before: [Vec3x16<S>; 2],
    /// By the covariance (xx, xy, yy).
    by_native: [f32x16<S>; 3],
}

impl<S: Simd> OpacityScale<S> {
    #[inline(always)]
    fn none(simd: S) -> Self {
        let zero = f32x16::splat(simd, 0.0);
        let none = Vec3x16 { x: zero, y: zero, z: zero };
        Self { total: zero, by_before: [none; 2], by_native: [zero; 3] }
    }

    /// `ln opacity` has `½ ln(before/native)` if antialiased, and `¾ ln(native/total)`, and
    /// `d ln det C = C⁻¹ dC`. With the minors m of the root, `C⁻¹` times it has the rows
    /// `v1 × m/|m|²` and `m × v0/|m|²`.
    #[inline(always)]
    fn new(
        simd: S,
        v0: Vec3x16<S>,
        v1: Vec3x16<S>,
        g: f32x16<S>,
        view: &ChunkView,
        antialiased: bool,
    ) -> Self {
        let splat = |value: f64| f32x16::splat(simd, value as f32);
        let zero = splat(0.0);
        let minors = v0.cross(v1);
        let det_before = minors.dot(minors);
        let native = view.filter.native_px2;
        let xx = v0.dot(v0);
        let xy = v0.dot(v1);
        let yy = v1.dot(v1);
        let det_native =
            splat(native.x).mul_add(yy + splat(native.y), splat(native.y).mul_add(xx, det_before));
        // A splat so wide that its determinant leaves f32 is not changed by any filter.
        let widest = v0.max_abs().max(v1.max_abs());
        let is_measured = widest.simd_le(splat(f64::from(MAX_SIGMA_PX)));
        let share = det_before / det_native;
        let is_scaled = is_measured & share.simd_gt(splat(MIN_BLUR_SHARE));
        let before = if antialiased { is_scaled.select(splat(0.5) * g, zero) } else { zero };
        let shrink = if view.filter.is_shrunk() {
            is_measured.select(splat(PixelFilter::SHRINK_POWER) * g, zero)
        } else {
            zero
        };
        // 2 x: the derivative of a quadratic form of the rows.
        let per_det = is_scaled.select((before + before) / det_before, zero);
        let by_native = is_measured.select((shrink - before) / det_native, zero);
        Self {
            total: shrink,
            by_before: [v1.cross(minors).scale(per_det), minors.cross(v0).scale(per_det)],
            by_native: [
                by_native * (yy + splat(native.y)),
                -(by_native * xy),
                by_native * (xx + splat(native.x)),
            ],
        }
    }
}
