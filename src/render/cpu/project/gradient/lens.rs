//! The derivatives of the projection by every camera that is not a static pinhole: one Gaussian
//! after the other, in f64 ([`FootprintGradient::to_shape`]).
//!
//! It differentiates the six points, also of Gaussians that are drawn by the lens' expansion: that
//! differs from them by at most the profile's `lens_error_px`.

use fearless_simd::{f32x16, prelude::*};
use glam::{DMat3, DQuat, DVec3};

use super::{Block, SplatDerivatives, add, add3, color, visible_lanes};
use crate::cpu::lanes::Vec3x16;
use crate::cpu::project::splat_block::SplatBlock;
use crate::cpu::project::unscented::UnscentedChunkView;
use crate::gradient::{FootprintGradient, partial};
use wildcity_scene::chunk::{LANES, Lanes, column};

/// Adds the derivatives by a block of 16 Gaussians, and by the view's twist.
#[inline(always)]
pub(super) fn back_project<S: Simd>(
    simd: S,
    block: Block<'_>,
    view: &UnscentedChunkView<'_>,
    to: &mut [Lanes],
    twist: &mut [f64; 6],
) {
    let visible = visible_lanes(simd, block.splats.visible);
    let is_visible = |lane: &usize| block.splats.visible >> lane & 1 == 1;
    // The vectors from the camera to the centres, for the colours.
    let mut toward_m = [[0.0; LANES]; 3];
    for lane in (0..LANES).filter(is_visible) {
        let toward = view.toward_m(mean_m(block.columns, lane));
        for (axis, value) in toward.to_array().into_iter().enumerate() {
            toward_m[axis][lane] = value as f32;
        }
    }
    let toward = Vec3x16::from_arrays(simd, &toward_m);
    let Vec3x16 { x, y, z } = color::back_project(simd, block, toward, visible, to);
    let by_toward = [x.to_array(), y.to_array(), z.to_array()];

    let mut by_mean = [[0.0; LANES]; 3];
    let mut by_scale = [[0.0; LANES]; 3];
    let mut by_quat = [[0.0; LANES]; 4];
    for lane in (0..LANES).filter(is_visible) {
        let value = |column: usize| f64::from(block.columns[column].0[lane]);
        let q = column::QUAT;
        let rotation = DQuat::from_xyzw(value(q + 1), value(q + 2), value(q + 3), value(q));
        let scale_m = DVec3::from_array([0, 1, 2].map(|axis| value(column::SCALE + axis)));
        let axes_m = DMat3::from_quat(rotation) * DMat3::from_diagonal(scale_m);
        let toward = DVec3::from_array([0, 1, 2].map(|axis| by_toward[axis][lane].into()));
        let SplatDerivatives(by) = block.by;
        let sums = by.map(|values| values[lane]);
        let SplatBlock { l0, l1, l2, .. } = block.splats;
        let factor = [l0[lane], l1[lane], l2[lane]];
        let antialiased = block.cutoffs.antialiased;
        let footprint =
            FootprintGradient::from_sums(&sums, factor, view.filter(), antialiased, toward);
        let center_m = view.origin_m() + mean_m(block.columns, lane);
        let shape = footprint.to_shape(view.view(), center_m, axes_m);
        let (ln_scale, quat) = shape.to_scale_and_rotation(axes_m, rotation);
        for axis in 0..3 {
            by_mean[axis][lane] = shape.mean_m[axis] as f32;
            by_scale[axis][lane] = ln_scale[axis] as f32;
        }
        for (column, value) in by_quat.iter_mut().zip(quat) {
            column[lane] = value as f32;
        }
        for (sum, value) in twist.iter_mut().zip(shape.twist.to_array()) {
            *sum += value;
        }
    }
    add3(simd, to, column::MEAN, Vec3x16::from_arrays(simd, &by_mean), visible);
    add3(simd, to, column::SCALE, Vec3x16::from_arrays(simd, &by_scale), visible);
    for (k, values) in by_quat.iter().enumerate() {
        add(simd, to, column::QUAT + k, f32x16::load_array_ref(simd, values), visible);
    }
    let ln2 = f32x16::splat(simd, std::f32::consts::LN_2);
    let g = block.by.load(simd, partial::G);
    add(simd, to, column::LOG2_OPACITY, ln2 * g, visible);
}

/// A centre relative to its chunk, in metres.
fn mean_m(columns: &[Lanes], lane: usize) -> DVec3 {
    DVec3::from_array([0, 1, 2].map(|axis| columns[column::MEAN + axis].0[lane].into()))
}
