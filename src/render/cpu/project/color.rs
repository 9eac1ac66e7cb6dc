//! Colours of Gaussians: spherical harmonics of the viewing direction.

use fearless_simd::{f32x16, prelude::*};

use crate::cpu::lanes::Vec3x16;
use wildcity_scene::chunk::{Lanes, column};
use wildcity_scene::sh;

/// `max(0, SH(direction) + 0.5)`, linear, of 16 Gaussians. `toward` leads from the camera to each
/// centre in world axes; it may have any length.
///
/// The real basis up to degree 3 and its signs are those of 3D Gaussian splatting (Kerbl et al.
/// 2023). Chunks hold three columns (red, green, blue) per coefficient, in order of degree.
#[inline(always)]
pub(super) fn color<S: Simd>(
    simd: S,
    columns: &[Lanes],
    degree: u8,
    toward: Vec3x16<S>,
) -> Vec3x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let half = Vec3x16 { x: splat(0.5), y: splat(0.5), z: splat(0.5) };
    let mut rgb = half.plus_term(simd, columns, 0, splat(sh::C0));
    if degree > 0 {
        // Degree 1: linear in the unit direction.
        // A camera exactly at the centre sees no direction; any finite one will do.
        let length = toward.dot(toward).max(splat(1e-30)).sqrt();
        let Vec3x16 { x, y, z } = toward.scale(splat(1.0) / length);
        rgb = rgb.plus_term(simd, columns, 1, splat(-sh::C1) * y);
        rgb = rgb.plus_term(simd, columns, 2, splat(sh::C1) * z);
        rgb = rgb.plus_term(simd, columns, 3, splat(-sh::C1) * x);
        if degree > 1 {
            // Degree 2: quadratic.
            let xx = x * x;
            let yy = y * y;
            let zz = z * z;
            let xy = x * y;
            let yz = y * z;
            let xz = x * z;
            rgb = rgb.plus_term(simd, columns, 4, splat(sh::C2[0]) * xy);
            rgb = rgb.plus_term(simd, columns, 5, splat(sh::C2[1]) * yz);
            rgb = rgb.plus_term(simd, columns, 6, splat(sh::C2[2]) * (zz + zz - xx - yy));
            rgb = rgb.plus_term(simd, columns, 7, splat(sh::C2[3]) * xz);
            rgb = rgb.plus_term(simd, columns, 8, splat(sh::C2[4]) * (xx - yy));
            if degree > 2 {
                // Degree 3: cubic.
                let three = splat(3.0);
                let across = splat(4.0) * zz - xx - yy;
                let along = zz + zz - three * (xx + yy);
                let in_plane = xx - yy;
                rgb = rgb.plus_term(simd, columns, 9, splat(sh::C3[0]) * y * (three * xx - yy));
                rgb = rgb.plus_term(simd, columns, 10, splat(sh::C3[1]) * xy * z);
                rgb = rgb.plus_term(simd, columns, 11, splat(sh::C3[2]) * y * across);
                rgb = rgb.plus_term(simd, columns, 12, splat(sh::C3[3]) * z * along);
                rgb = rgb.plus_term(simd, columns, 13, splat(sh::C3[4]) * x * across);
                rgb = rgb.plus_term(simd, columns, 14, splat(sh::C3[5]) * z * in_plane);
                rgb = rgb.plus_term(simd, columns, 15, splat(sh::C3[6]) * x * (xx - three * yy));
            }
        }
    }
    // Trained coefficients may give negative light in directions that no image has shown.
    rgb.max(splat(0.0))
}

impl<S: Simd> Vec3x16<S> {
    /// Adds `basis` times SH coefficient `k`. It is not a closure, because a closure would not be
    /// inlined, and so would be compiled without the instruction set.
    #[inline(always)]
    fn plus_term(self, simd: S, columns: &[Lanes], k: usize, basis: f32x16<S>) -> Self {
        Self::load(simd, columns, column::SH + 3 * k).mul_add(basis, self)
    }
}
