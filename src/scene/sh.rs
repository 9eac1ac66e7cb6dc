//! Real spherical harmonics, in the basis and sign of 3D Gaussian splatting.
//!
//! Source: Kerbl et al. 2023, reference code; the signs are those of Sloan, "Stupid Spherical
//! Harmonics Tricks" (2008), with the Condon-Shortley phase. The constants are written out in f64
//! so that every backend rounds the same number.

use glam::DVec3;

/// Largest supported degree.
pub const MAX_DEGREE: u8 = 3;

/// `½ √(1/π)`.
pub const C0: f64 = 0.282_094_791_773_878_14;
/// `½ √(3/π)`: -y, z, -x.
pub const C1: f64 = 0.488_602_511_902_919_9;
/// Degree 2, in the order xy, yz, 2z²-x²-y², xz, x²-y².
pub const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
/// Degree 3, in the order y(3x²-y²), xyz, y(4z²-x²-y²), z(2z²-3x²-3y²), x(4z²-x²-y²), z(x²-y²),
/// x(x²-3y²).
pub const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Coefficients per colour channel of a degree: `(degree + 1)²`.
pub const fn coefficients(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// The 16 basis functions up to degree 3 at a unit direction, in coefficient order.
pub fn basis(direction: DVec3) -> [f64; 16] {
    let DVec3 { x, y, z } = direction;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        C2[1] * y * z,
        C2[2] * (2.0 * zz - xx - yy),
        C2[3] * x * z,
        C2[4] * (xx - yy),
        C3[0] * y * (3.0 * xx - yy),
        C3[1] * x * y * z,
        C3[2] * y * (4.0 * zz - xx - yy),
        C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        C3[4] * x * (4.0 * zz - xx - yy),
        C3[5] * z * (xx - yy),
        C3[6] * x * (xx - 3.0 * yy),
    ]
}
