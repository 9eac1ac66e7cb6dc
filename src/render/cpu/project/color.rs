//! Colours of Gaussians: spherical harmonics of the viewing direction.

use fearless_simd::{f32x16, prelude::*};

use crate::cpu::lanes::Vec3x16;
use wildcity_scene::chunk::{Lanes, column};
use wildcity_scene::sh;

/// `max(0, SH(direction) + 0.5)`, linear, of 16 Gaussians. `toward` leads from the camera to each centre in
/// world axes; it may have any length.
///
/// The real basis up to degree 3 and its signs are those of 3D Gaussian splatting (Kerbl et al. 2023). Chunks
/// hold three columns (red, green, blue) per coefficient, in order of degree.
#[inline(always)]
pub(super) fn color<S: Simd>(
    simd: S,
    columns: &[Lanes],
    degree: u8,
    toward: Vec3x16<S>,
) -> Vec3x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let half = Vec3x16 { x: splat(0.5), y: splat(0.5), z: splat(0.5) };
    let mut rgb = Vec3x16::load(simd, columns, column::SH).mul_add(splat(sh::C0), half);
    let mut add = |k: usize, basis: f32x16<S>| {
        rgb = Vec3x16::load(simd, columns, column::SH + 3 * k).mul_add(basis, rgb);
    };
    if degree > 0 {
        // Degree 1: linear in the unit direction.
        let length = toward.dot(toward).max(splat(1e-30)).sqrt();
        let Vec3x16 { x, y, z } = toward.scale(splat(1.0) / length);
        add(1, splat(-sh::C1) * y);
        add(2, splat(sh::C1) * z);
        add(3, splat(-sh::C1) * x);
        if degree > 1 {
            // Degree 2: quadratic.
            let xx = x * x;
            let yy = y * y;
            let zz = z * z;
            let xy = x * y;
            let yz = y * z;
            let xz = x * z;
            add(4, splat(sh::C2[0]) * xy);
            add(5, splat(sh::C2[1]) * yz);
            add(6, splat(sh::C2[2]) * (zz + zz - xx - yy));
            add(7, splat(sh::C2[3]) * xz);
            add(8, splat(sh::C2[4]) * (xx - yy));
            if degree > 2 {
                // Degree 3: cubic.
                let three = splat(3.0);
                let four = splat(4.0);
                add(9, splat(sh::C3[0]) * y * (three * xx - yy));
                add(10, splat(sh::C3[1]) * xy * z);
                add(11, splat(sh::C3[2]) * y * (four * zz - xx - yy));
                add(12, splat(sh::C3[3]) * z * (zz + zz - three * (xx + yy)));
                add(13, splat(sh::C3[4]) * x * (four * zz - xx - yy));
                add(14, splat(sh::C3[5]) * z * (xx - yy));
                add(15, splat(sh::C3[6]) * x * (xx - three * yy));
            }
        }
    }
    rgb.max(splat(0.0))
}
