//! Sixteen 3D vectors, one per SIMD lane.
//!
//! Every function is `#[inline(always)]`: a function that remains a call of its own is compiled
//! without the instruction set that its caller was dispatched to.

use fearless_simd::{f32x16, prelude::*};

use wildcity_scene::chunk::{LANES, Lanes};

/// One vector for each value, which has the value in every lane.
///
/// It uses a loop and not `map` of an array: `map` remains a call, and so is compiled without the
/// instruction set.
#[inline(always)]
pub(super) fn splats<S: Simd, const N: usize>(simd: S, values: [f32; N]) -> [f32x16<S>; N] {
    let mut vectors = [f32x16::splat(simd, 0.0); N];
    for (vector, value) in vectors.iter_mut().zip(values) {
        *vector = f32x16::splat(simd, value);
    }
    vectors
}

/// Sixteen 3D vectors, component by component.
#[derive(Clone, Copy)]
pub(super) struct Vec3x16<S: Simd> {
    pub(super) x: f32x16<S>,
    pub(super) y: f32x16<S>,
    pub(super) z: f32x16<S>,
}

impl<S: Simd> Vec3x16<S> {
    /// One vector in every lane.
    #[inline(always)]
    pub(super) fn splat(simd: S, v: [f32; 3]) -> Self {
        let [x, y, z] = v;
        Self { x: f32x16::splat(simd, x), y: f32x16::splat(simd, y), z: f32x16::splat(simd, z) }
    }

    /// The columns of a block as arrays.
    #[inline(always)]
    pub(super) fn from_arrays(simd: S, [x, y, z]: &[[f32; LANES]; 3]) -> Self {
        Self {
            x: f32x16::load_array_ref(simd, x),
            y: f32x16::load_array_ref(simd, y),
            z: f32x16::load_array_ref(simd, z),
        }
    }

    /// Three consecutive columns of a block.
    #[inline(always)]
    pub(super) fn load(simd: S, columns: &[Lanes], first: usize) -> Self {
        Self {
            x: f32x16::load_array_ref(simd, &columns[first].0),
            y: f32x16::load_array_ref(simd, &columns[first + 1].0),
            z: f32x16::load_array_ref(simd, &columns[first + 2].0),
        }
    }

    #[inline(always)]
    pub(super) fn dot(self, other: Self) -> f32x16<S> {
        self.x.mul_add(other.x, self.y.mul_add(other.y, self.z * other.z))
    }

    #[inline(always)]
    pub(super) fn cross(self, other: Self) -> Self {
        // Plain products: a fused difference would round the two products differently, and the
        // cross product of parallel vectors would not be 0.
        Self {
            x: self.y * other.z - self.z * other.y,
            y: self.z * other.x - self.x * other.z,
            z: self.x * other.y - self.y * other.x,
        }
    }

    /// Each vector times its own factor.
    #[inline(always)]
    pub(super) fn scale(self, by: f32x16<S>) -> Self {
        Self { x: self.x * by, y: self.y * by, z: self.z * by }
    }

    /// The product component by component.
    #[inline(always)]
    pub(super) fn times(self, other: Self) -> Self {
        Self { x: self.x * other.x, y: self.y * other.y, z: self.z * other.z }
    }

    /// `self * by + plus`.
    #[inline(always)]
    pub(super) fn mul_add(self, by: f32x16<S>, plus: Self) -> Self {
        Self {
            x: self.x.mul_add(by, plus.x),
            y: self.y.mul_add(by, plus.y),
            z: self.z.mul_add(by, plus.z),
        }
    }

    #[inline(always)]
    pub(super) fn plus(self, other: Self) -> Self {
        Self { x: self.x + other.x, y: self.y + other.y, z: self.z + other.z }
    }

    #[inline(always)]
    pub(super) fn minus(self, other: Self) -> Self {
        Self { x: self.x - other.x, y: self.y - other.y, z: self.z - other.z }
    }

    /// The larger of each component and a number of its lane.
    #[inline(always)]
    pub(super) fn max(self, least: f32x16<S>) -> Self {
        Self { x: self.x.max(least), y: self.y.max(least), z: self.z.max(least) }
    }

    /// The largest magnitude of the three components.
    #[inline(always)]
    pub(super) fn max_abs(self) -> f32x16<S> {
        self.x.abs().max(self.y.abs()).max(self.z.abs())
    }
}
