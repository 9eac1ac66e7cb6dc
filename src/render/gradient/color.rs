//! The derivatives of a Gaussian's colour, in f64.

use glam::DVec3;

use wildcity_scene::sh;

/// The derivatives by spherical harmonics, and by the vector from the camera to the centre.
///
/// A colour that is clamped at 0 has none.
pub(crate) fn color_gradient(
    coefficients: &[DVec3; 16],
    toward: DVec3,
    by_rgb: DVec3,
) -> ([DVec3; 16], DVec3) {
    let direction = toward.normalize();
    let basis = sh::basis(direction);
    let mut rgb = DVec3::splat(0.5);
    for (weight, coefficient) in basis.iter().zip(coefficients) {
        rgb += weight * coefficient;
    }
    let by_rgb = DVec3::select(rgb.cmpgt(DVec3::ZERO), by_rgb, DVec3::ZERO);
    let mut by_direction = DVec3::ZERO;
    for (gradient, &coefficient) in sh::basis_gradients(direction).iter().zip(coefficients) {
        by_direction += by_rgb.dot(coefficient) * gradient;
    }
    // d/|d| has the derivative (I - d dᵀ)/|d|.
    let by_toward = (by_direction - direction.dot(by_direction) * direction) / toward.length();
    (basis.map(|weight| weight * by_rgb), by_toward)
}
