//! A plane of a scene.

use glam::{DMat3, DVec3};

/// A plane, and which of its sides is up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundPlane {
    /// A point of it, in the unit of the scene.
    pub point: DVec3,
    pub up: DVec3,
}

impl GroundPlane {
    /// With the other side up.
    pub(super) fn turned(self) -> Self {
        Self { up: -self.up, ..self }
    }
}

/// The plane with the least squares of distances: through the mean, normal to the two main axes of
/// the points.
pub(super) fn fit(points: &[DVec3]) -> Option<GroundPlane> {
    if points.len() < 3 {
        return None;
    }
    let mean = points.iter().sum::<DVec3>() / points.len() as f64;
    let covariance = points.iter().fold(DMat3::ZERO, |sum, &point| {
        let d = point - mean;
        sum + DMat3::from_cols(d * d.x, d * d.y, d * d.z)
    });
    // The eigenvector of the smallest eigenvalue: power iteration on the adjugate, whose largest
    // eigenvalue belongs to it. The adjugate of a symmetric matrix with columns a, b, c has the
    // columns b x c, c x a, a x b.
    let scale = covariance.to_cols_array().iter().fold(0.0_f64, |most, e| most.max(e.abs()));
    let [a, b, c] = [covariance.x_axis, covariance.y_axis, covariance.z_axis].map(|v| v / scale);
    let mut adjugate = DMat3::from_cols(b.cross(c), c.cross(a), a.cross(b));
    // Each round squares the matrix: 12 rounds are the power 2^12 = 4096. Two eigenvalues that
    // differ by 1 % then differ by a factor of e^40.
    for _ in 0..12 {
        let norm = adjugate.to_cols_array().iter().fold(0.0_f64, |most, e| most.max(e.abs()));
        if !(norm > 0.0 && norm.is_finite()) {
            return None;
        }
        adjugate *= 1.0 / norm;
        adjugate = adjugate * adjugate;
    }
    let columns = [adjugate.x_axis, adjugate.y_axis, adjugate.z_axis];
    let longest = columns.into_iter().max_by(|a, b| a.length().total_cmp(&b.length()))?;
    longest.try_normalize().map(|up| GroundPlane { point: mean, up })
}
