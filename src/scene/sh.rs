//! Real spherical harmonics, in the basis and sign of 3D Gaussian splatting.
//!
//! Source: Kerbl et al. 2023, reference code; the signs are those of Sloan, "Stupid Spherical
//! Harmonics Tricks" (2008), with the Condon-Shortley phase. The constants are written out in f64
//! so that every backend rounds the same number.

use std::f64::consts::FRAC_PI_4;

use glam::{DMat3, DVec3};

/// Largest supported degree: 16 coefficients per channel.
pub const MAX_DEGREE: u8 = 3;
/// Largest accepted magnitude of a coefficient in a scene: a colour of 282, where 1 is white.
pub const MAX_COEFFICIENT: f32 = 1e3;

/// `½ √(1/π)`, the basis function of degree 0.
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

/// Number of coefficients per colour channel at a degree: `(degree + 1)²`.
pub const fn coefficients(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// The 16 basis functions up to degree 3 at a unit direction, in coefficient order.
pub fn basis(direction: DVec3) -> [f64; 16] {
    let DVec3 { x, y, z } = direction;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
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

/// The derivatives of [`basis`] by x, y and z, as of polynomials of three independent variables.
pub fn basis_gradients(direction: DVec3) -> [DVec3; 16] {
    let DVec3 { x, y, z } = direction;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    [
        DVec3::ZERO,
        DVec3::new(0.0, -C1, 0.0),
        DVec3::new(0.0, 0.0, C1),
        DVec3::new(-C1, 0.0, 0.0),
        C2[0] * DVec3::new(y, x, 0.0),
        C2[1] * DVec3::new(0.0, z, y),
        C2[2] * DVec3::new(-2.0 * x, -2.0 * y, 4.0 * z),
        C2[3] * DVec3::new(z, 0.0, x),
        C2[4] * DVec3::new(2.0 * x, -2.0 * y, 0.0),
        C3[0] * DVec3::new(6.0 * x * y, 3.0 * (xx - yy), 0.0),
        C3[1] * DVec3::new(y * z, x * z, x * y),
        C3[2] * DVec3::new(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z),
        C3[3] * DVec3::new(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * (xx + yy)),
        C3[4] * DVec3::new(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z),
        C3[5] * DVec3::new(2.0 * x * z, -2.0 * y * z, xx - yy),
        C3[6] * DVec3::new(3.0 * (xx - yy), -6.0 * x * y, 0.0),
    ]
}

/// Rotation of SH coefficients with the scene, by an orthogonal matrix M (mirrors included): a
/// colour that was seen along `d` is afterwards seen along `M d`.
///
/// The basis Y is orthonormal, so `Y(M d) = B Y(d)` with `B_jk = ∫ Y_j(M d) Y_k(d) dω` (Ramamoorthi
/// and Hanrahan 2001). Coefficients are multiplied with the same B, which is orthogonal and mixes
/// no degrees. The integrand is a polynomial of degree 6 at most; 4 Gauss-Legendre heights times 8
/// azimuths integrate degree 7 exactly, so B has the accuracy of f64.
#[derive(Clone, Debug)]
pub struct ShRotation {
    /// `B`, of which the first `coefficients(degree)` rows and columns are used.
    matrix: [[f64; 16]; 16],
    count: usize,
}

impl ShRotation {
    /// The rotation for an orthogonal matrix that takes old directions to new ones, and for
    /// coefficients up to `degree`.
    pub fn new(turned_from_plain: DMat3, degree: u8) -> Self {
        // Abscissae and weights of the 4-point rule on [-1, 1] (Abramowitz & Stegun, table 25.4).
        const HEIGHTS: [(f64, f64); 2] = [
            (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
        ];
        let mut matrix = [[0.0; 16]; 16];
        // The rule is symmetric about 0; two abscissae stand for four.
        for (height, weight) in HEIGHTS.into_iter().flat_map(|(z, w)| [(z, w), (-z, w)]) {
            for step in 0..8 {
                // Eight azimuths of π/4 integrate trigonometric polynomials up to degree 7 exactly.
                let (sin, cos) = (f64::from(step) * FRAC_PI_4).sin_cos();
                let radius = (1.0 - height * height).sqrt();
                let direction = DVec3::new(radius * cos, radius * sin, height);
                let plain = basis(direction);
                let turned = basis(turned_from_plain * direction);
                for (row, turned) in matrix.iter_mut().zip(turned) {
                    for (entry, plain) in row.iter_mut().zip(plain) {
                        // Weight of the height times the arc of an azimuth, π/4: the weights sum up
                        // to 2 * 8 * π/4 = 4π.
                        *entry += weight * FRAC_PI_4 * turned * plain;
                    }
                }
            }
        }
        Self { matrix, count: coefficients(degree) }
    }

    /// Rotates the coefficients of one Gaussian in place, `[(degree + 1)², 3]`.
    pub fn apply(&self, colour: &mut [f32]) {
        // A copy, because every output reads all inputs.
        let mut plain = [[0.0; 3]; 16];
        for (plain, colour) in plain.iter_mut().zip(colour.chunks_exact(3)) {
            *plain = [colour[0], colour[1], colour[2]].map(f64::from);
        }
        for (row, turned) in self.matrix.iter().zip(colour.chunks_exact_mut(3)) {
            for (channel, value) in turned.iter_mut().enumerate() {
                let terms = row[..self.count].iter().zip(&plain);
                *value = terms.map(|(b, plain)| b * plain[channel]).sum::<f64>() as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    /// Checks the constants independently: the basis must be orthonormal.
    #[test]
    fn the_basis_is_orthonormal() {
        let matrix = ShRotation::new(DMat3::IDENTITY, 3).matrix;
        for (j, row) in matrix.iter().enumerate() {
            for (k, entry) in row.iter().enumerate() {
                let wanted = if j == k { 1.0 } else { 0.0 };
                assert!((entry - wanted).abs() < 1e-14, "B[{j}][{k}] = {entry}");
            }
        }
    }

    #[test]
    fn rotated_colours_are_seen_from_rotated_directions() {
        let rotation = DMat3::from_quat(DQuat::from_xyzw(0.3, -0.5, 0.7, 0.2).normalize());
        let mirror = DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0)) * rotation;
        for matrix in [rotation, mirror] {
            for degree in 0..=MAX_DEGREE {
                let count = coefficients(degree);
                let plain: Vec<f32> = (0..3 * count).map(|i| (i as f32 * 0.7).sin()).collect();
                let mut turned = plain.clone();
                ShRotation::new(matrix, degree).apply(&mut turned);
                for step in 0..50 {
                    let t = f64::from(step);
                    let away = DVec3::new((1.3 * t).sin(), (0.9 * t).cos(), (2.1 * t).sin());
                    let d = away.normalize();
                    let seen = colour(&turned, matrix * d);
                    let wanted = colour(&plain, d);
                    let error = (seen - wanted).abs().max_element();
                    assert!(error < 1e-6, "degree {degree}, from {d}: {seen}, not {wanted}");
                }
            }
        }
    }

    fn colour(coefficients: &[f32], direction: DVec3) -> DVec3 {
        let basis = basis(direction);
        coefficients.chunks_exact(3).zip(basis).fold(DVec3::ZERO, |sum, (rgb, b)| {
            sum + b * DVec3::new(rgb[0].into(), rgb[1].into(), rgb[2].into())
        })
    }
}
