//! Stage project for lenses and rolling shutters: Gaussian by Gaussian in f64, and their colours 16 at a
//! time. `Bent` says where one lands.

use fearless_simd::{f32x16, prelude::*};
use glam::{DMat3, DQuat, DVec2, DVec3};

use super::lanes::Vec3x16;
use super::project::{LOG2_UNIT, SplatLanes, color};
use crate::render::constants::EXTENT_SLACK_PX;
use crate::render::layout::Cutoffs;
use crate::render::unscented::{Bent, Footprint};
use crate::scene::chunk::{LANES, Lanes, column};

/// Projects one block of a chunk with this origin, or returns `None` if nothing of it can be seen.
#[inline(always)]
pub(super) fn project_block<S: Simd>(
    simd: S,
    columns: &[Lanes],
    sh_degree: u8,
    (view, origin_m): (&Bent<'_>, DVec3),
    cutoffs: &Cutoffs,
) -> Option<SplatLanes> {
    let mut lanes = SplatLanes::default();
    let mut toward_m = [[0.0_f32; LANES]; 3];
    for lane in 0..LANES {
        if let Some(from_camera_m) =
            project_one(columns, lane, (view, origin_m), cutoffs, &mut lanes)
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
    let rgb = color(simd, columns, sh_degree, Vec3x16 { x, y, z });
    rgb.x.store_array(&mut lanes.red);
    rgb.y.store_array(&mut lanes.green);
    rgb.z.store_array(&mut lanes.blue);
    Some(lanes)
}

/// Fills one lane, and returns the way from the camera to the centre, in metres; `None` if the
/// Gaussian cannot be seen.
#[inline(always)]
fn project_one(
    columns: &[Lanes],
    lane: usize,
    (view, origin_m): (&Bent<'_>, DVec3),
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
