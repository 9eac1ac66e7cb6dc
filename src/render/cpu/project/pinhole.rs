//! Projection by a static pinhole camera: linearised at each centre (EWA splatting).
//!
//! Twins: `shaders/project.wgsl` on the GPU, `reference/project.rs` in f64.

use fearless_simd::{f32x16, prelude::*};

use super::axes::{rotation_columns, transform_row};
use super::color::color;
use super::splat_block::{Ellipse, ProjectedBlock, SplatBlock};
use crate::cpu::lanes::Vec3x16;
use crate::layout::{ChunkView, Cutoffs};
use wildcity_scene::chunk::{Lanes, column};

/// Projects one block of 16 Gaussians, or returns `None` if none of them can be seen.
///
/// The screen covariance, in px², is `Σ′ = J W Σ Wᵀ Jᵀ + blur I` with `Σ = R S Sᵀ Rᵀ` (Zwicker et
/// al. 2001; Kerbl et al. 2023, eqs. 5 and 6): `W` is the rotation of camera_from_world,
/// `J = ∂pixel/∂point` the Jacobian of the projection at the centre, `R` and `S` the Gaussian's
/// rotation and standard deviations. Computed here are the two rows of the 2 x 3 root
/// `V = J W R S`; `Σ′ = V Vᵀ + blur I` follows in [`Ellipse::from_root`].
#[inline(always)]
pub(super) fn project_block<S: Simd>(
    simd: S,
    columns: &[Lanes],
    sh_degree: u8,
    view: &ChunkView,
    cutoffs: &Cutoffs,
) -> Option<SplatBlock> {
    let splat = |value: f32| f32x16::splat(simd, value);

    // Test the depth first, since it culls most. A NaN fails every comparison, and so is culled.
    let mean = Vec3x16::load(simd, columns, column::MEAN);
    let z = depth(simd, view, mean);
    let log2_opacity = f32x16::load_array_ref(simd, &columns[column::LOG2_OPACITY].0);
    let in_range = z.simd_ge(splat(cutoffs.near_m))
        & z.simd_le(splat(cutoffs.far_m))
        & log2_opacity.simd_ge(splat(cutoffs.log2_alpha_cut));
    if in_range.all_false() {
        return None;
    }

    // The centre: pixel = focal (x/z, y/z) + principal point.
    let inverse_z = splat(1.0) / z;
    // Lanes out of range may divide by 0: they are masked, and SIMD does not trap.
    let slope_x = camera_coordinate(simd, view, mean, 0) * inverse_z;
    let slope_y = camera_coordinate(simd, view, mean, 1) * inverse_z;
    let mean_x = slope_x.mul_add(splat(view.focal_px[0]), splat(view.center_px[0]));
    let mean_y = slope_y.mul_add(splat(view.focal_px[1]), splat(view.center_px[1]));

    // The shape: rows of V = (J W R) S.
    let axes = rotation_columns(simd, columns);
    let scale = Vec3x16::load(simd, columns, column::SCALE);
    let v0 = along_axes(jacobian_row(simd, view, 0, slope_x, inverse_z), axes).times(scale);
    let v1 = along_axes(jacobian_row(simd, view, 1, slope_y, inverse_z), axes).times(scale);
    let ellipse = Ellipse::from_root(simd, v0, v1, &view.filter);

    // Test against the image; compute colours only if some Gaussian passed.
    let projected = ProjectedBlock { mean_x, mean_y, depth_m: z, log2_opacity, ellipse, in_range };
    let mut splats = projected.clip(simd, view.size_px, cutoffs);
    if splats.visible == 0 {
        return None;
    }
    // In the axes of the chunk, in which the SH coefficients are given, too.
    let toward = mean.minus(Vec3x16::splat(simd, view.camera_m));
    splats.set_colors(color(simd, columns, sh_degree, toward));
    Some(splats)
}

/// Camera-space z of centres, in metres: computed in f64 and rounded to f32 once.
///
/// Splats are blended in order of this number. Thousands of surfels of one facade have the same
/// depth. As a sum in f32 it differed by rounding errors, and they were blended in the order of
/// those errors: 54 dB between backends on the demo street, and single pixels off by 0.2. In f64 it
/// costs 12 instructions for 16 Gaussians. Ties keep the order of global ids, and the backends
/// agree above 70 dB, with no value off by more than 2/255.
#[inline(always)]
pub(super) fn depth<S: Simd>(simd: S, view: &ChunkView, mean: Vec3x16<S>) -> f32x16<S> {
    let (low, high) = transform_row(simd, mean, view.forward);
    low.narrow(high)
}

/// The camera-space x (axis 0) or y (axis 1) of centres, in metres.
#[inline(always)]
pub(super) fn camera_coordinate<S: Simd>(
    simd: S,
    view: &ChunkView,
    mean: Vec3x16<S>,
    axis: usize,
) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let [rx, ry, rz] = view.rotation[axis];
    let z = splat(rz).mul_add(mean.z, splat(view.translation_m[axis]));
    splat(rx).mul_add(mean.x, splat(ry).mul_add(mean.y, z))
}

/// A row of `J W`, in px/m: how a pixel coordinate moves as the centre moves along each axis of the
/// world.
///
/// For the pixel coordinate `f x/z + c` the row of `J` is `(f/z)(1, 0, -x/z)`. Times `W` this is
/// `(f/z)(W_x - (x/z) W_z)` with the rows of `W`.
/// Outside of the image the slope x/z is clamped, since the linearisation is wrong there and would
/// give splats of unbounded size (see [`SLOPE_SLACK`](crate::constants::SLOPE_SLACK)).
#[inline(always)]
pub(super) fn jacobian_row<S: Simd>(
    simd: S,
    view: &ChunkView,
    axis: usize,
    slope: f32x16<S>,
    inverse_z: f32x16<S>,
) -> Vec3x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    // Only the shape is linearised at the clamped slope; the centre stays where it is.
    let clamped = slope.max(splat(view.slope_min[axis])).min(splat(view.slope_max[axis]));
    let forward = Vec3x16::splat(simd, view.rotation[2]);
    forward
        .mul_add(-clamped, Vec3x16::splat(simd, view.rotation[axis]))
        .scale(inverse_z * splat(view.focal_px[axis]))
}

/// The components of vectors along the own axes: `row R`.
#[inline(always)]
pub(super) fn along_axes<S: Simd>(row: Vec3x16<S>, axes: [Vec3x16<S>; 3]) -> Vec3x16<S> {
    Vec3x16 { x: row.dot(axes[0]), y: row.dot(axes[1]), z: row.dot(axes[2]) }
}
