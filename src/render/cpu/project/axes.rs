//! The axes of Gaussians, and coordinates of their centres in f64: the first step of both
//! projections.

use fearless_simd::{f32x16, f64x8, prelude::*};

use crate::cpu::lanes::Vec3x16;
use wildcity_scene::chunk::{Lanes, column};

/// Sixteen f64: lanes 0 to 7, then lanes 8 to 15.
pub(super) type F64x16<S> = (f64x8<S>, f64x8<S>);

/// One coordinate of 16 points in another frame, in metres: `row · (x, y, z, 1)`, in f64.
#[inline(always)]
pub(super) fn transform_row<S: Simd>(simd: S, points: Vec3x16<S>, row: [f64; 4]) -> F64x16<S> {
    let [rx, ry, rz, translation_m] = row;
    let rx = f64x8::splat(simd, rx);
    let ry = f64x8::splat(simd, ry);
    let rz = f64x8::splat(simd, rz);
    let translation_m = f64x8::splat(simd, translation_m);
    let x = points.x.widen();
    let y = points.y.widen();
    let z = points.z.widen();
    // One rounding per multiply-add in f64, and a single one to f32 at the end.
    let low = x.0.mul_add(rx, y.0.mul_add(ry, z.0.mul_add(rz, translation_m)));
    let high = x.1.mul_add(rx, y.1.mul_add(ry, z.1.mul_add(rz, translation_m)));
    (low, high)
}

/// Columns of the rotation matrices of a block's unit quaternions: each Gaussian's own axes, in the
/// world.
///
/// The matrix of a unit quaternion (w, x, y, z) is
///
/// ```text
/// 1 - 2(yy + zz)   2(xy - wz)       2(xz + wy)
/// 2(xy + wz)       1 - 2(xx + zz)   2(yz - wx)
/// 2(xz - wy)       2(yz + wx)       1 - 2(xx + yy)
/// ```
#[inline(always)]
pub(in crate::cpu) fn rotation_columns<S: Simd>(simd: S, columns: &[Lanes]) -> [Vec3x16<S>; 3] {
    matrix_columns(simd, Quaternions::load(simd, columns))
}

/// Sixteen unit quaternions, with the real part apart from the vector.
#[derive(Clone, Copy)]
pub(super) struct Quaternions<S: Simd> {
    w: f32x16<S>,
    v: Vec3x16<S>,
}

impl<S: Simd> Quaternions<S> {
    #[inline(always)]
    pub(super) fn load(simd: S, columns: &[Lanes]) -> Self {
        let w = f32x16::load_array_ref(simd, &columns[column::QUAT].0);
        Self { w, v: Vec3x16::load(simd, columns, column::QUAT + 1) }
    }

    /// These rotations, each followed by the rotation (x, y, z, w).
    #[inline(always)]
    pub(super) fn after(self, simd: S, [x, y, z, w]: [f32; 4]) -> Self {
        let a = Vec3x16::splat(simd, [x, y, z]);
        let aw = f32x16::splat(simd, w);
        let Self { w: bw, v: b } = self;
        Self {
            // Hamilton's product a b: b is the Gaussian's rotation, a the camera's.
            w: (-a.x).mul_add(b.x, (-a.y).mul_add(b.y, (-a.z).mul_add(b.z, aw * bw))),
            v: Vec3x16 {
                x: aw.mul_add(b.x, a.x.mul_add(bw, a.y.mul_add(b.z, -(a.z * b.y)))),
                y: aw.mul_add(b.y, a.y.mul_add(bw, a.z.mul_add(b.x, -(a.x * b.z)))),
                z: aw.mul_add(b.z, a.z.mul_add(bw, a.x.mul_add(b.y, -(a.y * b.x)))),
            },
        }
    }
}

/// Columns of the rotation matrices of unit quaternions.
#[inline(always)]
pub(super) fn matrix_columns<S: Simd>(simd: S, rotations: Quaternions<S>) -> [Vec3x16<S>; 3] {
    let one = f32x16::splat(simd, 1.0);
    let Quaternions { w, v: Vec3x16 { x, y, z } } = rotations;
    // Below each product holds the factor 2 of the matrix.
    let x2 = x + x;
    let y2 = y + y;
    let z2 = z + z;
    let xx = x * x2;
    let yy = y * y2;
    let zz = z * z2;
    let xy = x * y2;
    let xz = x * z2;
    let yz = y * z2;
    let wx = w * x2;
    let wy = w * y2;
    let wz = w * z2;
    [
        Vec3x16 { x: one - yy - zz, y: xy + wz, z: xz - wy },
        Vec3x16 { x: xy - wz, y: one - xx - zz, z: yz + wx },
        Vec3x16 { x: xz + wy, y: yz - wx, z: one - xx - yy },
    ]
}
