//! Merging two Gaussians by moment matching, and the cost of a merge.

use glam::{DMat3, DQuat, DVec3};

/// The alpha below which a splat is not drawn, of the default profile.
const ALPHA_CUT: f64 = 1.0 / 255.0;
/// Alpha that a merged Gaussian may show beyond the edges of those in whose place it is, without an
/// error. Two equal ones on one spot, merged, show an alpha of one cut beyond their edge; a hundred
/// pairs there would show a hundred times as much, and a pair does not know of the others.
const MOST_SHOWN: f64 = ALPHA_CUT / 2.0;

/// A Gaussian as it is kept between merges: a dense block has millions.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StoredNode {
    pub(super) mean_m: DVec3,
    /// Standard deviations along the principal axes, in metres.
    pub(super) scale_m: [f32; 3],
    /// The principal axes as a unit quaternion (w, x, y, z).
    pub(super) quat_wxyz: [f32; 4],
    /// This and the next are as in [`Node`].
    pub(super) weight: f64,
    pub(super) hidden_weight: f64,
}

impl StoredNode {
    /// With what is computed from it.
    pub(super) fn node(&self) -> Node {
        let scale_m = DVec3::from_array(self.scale_m.map(f64::from));
        let [w, x, y, z] = self.quat_wxyz.map(f64::from);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let root = axes * DMat3::from_diagonal(scale_m);
        let &Self { mean_m, weight, hidden_weight, .. } = self;
        // The covariance as root times its transpose is symmetric and has no negative eigenvalue,
        // also after rounding.
        Node { mean_m, cov_m2: root * root.transpose(), scale_m, axes, weight, hidden_weight }
    }

    /// Largest standard deviation, in metres.
    pub(super) fn sigma_m(&self) -> f64 {
        let [x, y, z] = self.scale_m.map(f64::from);
        x.max(y).max(z)
    }

    /// Opacity of the peak; above 1 where several Gaussians overlapped.
    pub(super) fn opacity(&self) -> f64 {
        // 0 / 0 for a Gaussian without any extent: NaN, which callers treat as invisible.
        self.weight / area_m2(DVec3::from_array(self.scale_m.map(f64::from)))
    }
}

/// A Gaussian with its moments.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    pub(super) mean_m: DVec3,
    pub(super) cov_m2: DMat3,
    /// Standard deviations along the principal axes, in metres.
    pub(super) scale_m: DVec3,
    /// Principal axes, as columns.
    pub(super) axes: DMat3,
    /// Opacity times [`area_m2`]: how much of an image the Gaussian takes.
    pub(super) weight: f64,
    /// The part of the weight that the Gaussians of level 0 that it represents hide: the sum of
    /// weight times [`hidden_share`].
    pub(super) hidden_weight: f64,
}

/// A measure of the area that a Gaussian covers: proportional to the mean area of its projections
/// along its three principal axes. Two flat neighbours that touch merge into a flat Gaussian with
/// the sum of their areas.
pub(super) fn area_m2(scale_m: DVec3) -> f64 {
    let DVec3 { x, y, z } = scale_m;
    x * y + y * z + z * x
}

impl Node {
    /// Without what is computed from it.
    pub(super) fn stored(&self) -> StoredNode {
        let q = DQuat::from_mat3(&self.axes).normalize();
        StoredNode {
            mean_m: self.mean_m,
            scale_m: self.scale_m.as_vec3().to_array(),
            quat_wxyz: [q.w, q.x, q.y, q.z].map(|q| q as f32),
            weight: self.weight,
            hidden_weight: self.hidden_weight,
        }
    }

    /// Largest standard deviation, in metres.
    pub(super) fn sigma_m(&self) -> f64 {
        self.scale_m.max_element()
    }

    /// How far beyond the edges of the Gaussians of level 0 that it represents it would be drawn,
    /// in its standard deviations, if its area were `area_m2`.
    ///
    /// A Gaussian of opacity `o` ends where its alpha falls below the cut, `√(2 ln(o / cut))`
    /// standard deviations from its centre, with a share of `cut / o` of its bell beyond: a faint
    /// one is only the tip of its bell. Of several on one spot, the merged one is more opaque than
    /// each and ends later, and shows what all of them cut off. What they cut off together is a
    /// share of their bells, too, and their edge is that of Gaussians which all hide that share.
    pub(super) fn beyond_edge(&self, area_m2: f64) -> f64 {
        let opacity = self.weight / area_m2;
        let before = self.hidden_weight / self.weight;
        let now = hidden_share(opacity);
        // The comparison with the NaN of an invisible one is false.
        let shows = opacity * (before - now) > MOST_SHOWN;
        if !shows {
            return 0.0;
        }
        let edge = |share: f64| (-2.0 * share.ln()).max(0.0).sqrt();
        edge(now) - edge(before)
    }
}

/// The share of its bell that a Gaussian of this opacity hides: where its alpha is below the cut.
pub(super) fn hidden_share(opacity: f64) -> f64 {
    (ALPHA_CUT / opacity).min(1.0)
}

/// The merge of two Gaussians: the first two moments of their weighted mixture. `scale_m` and
/// `axes` are invalid until [`Node::diagonalise`] is called.
pub(super) fn joined(a: &Node, b: &Node) -> Node {
    let weight = a.weight + b.weight;
    let hidden_weight = a.hidden_weight + b.hidden_weight;
    // Two invisible Gaussians get equal shares.
    let share = if weight > 0.0 { b.weight / weight } else { 0.5 };
    let offset = b.mean_m - a.mean_m;
    let mean_m = a.mean_m + share * offset;
    // Both displacements together: share (1 - share) d dᵀ.
    let spread = outer(offset) * (share * (1.0 - share));
    // The law of total variance: the mean of the covariances plus the covariance of the means.
    let cov_m2 = a.cov_m2 * (1.0 - share) + b.cov_m2 * share + spread;
    Node { mean_m, cov_m2, weight, hidden_weight, ..*a }
}

impl Node {
    /// Computes principal axes and standard deviations from the covariance.
    pub(super) fn diagonalise(&mut self) {
        let (squares, axes) = eigen(self.cov_m2);
        // Rounding may leave a tiny negative eigenvalue of a flat Gaussian.
        self.scale_m = squares.max(DVec3::ZERO).map(f64::sqrt);
        self.axes = axes;
    }
}

/// The cost of a merge: the squared L2 norm of the difference between the fields before and after,
/// relative to that of the field before; 0 to about 1.
///
/// A field is `weight x normal density x (1, colour)`, blurred with variance `blur_m2` so that
/// details that a pixel cannot resolve do not count. With `∫ N(a, A) N(b, B) = N(a - b; 0, A + B)`
/// all six terms have a closed form.
pub(super) fn cost(a: &Node, b: &Node, merged: &Node, colours: [DVec3; 2], blur_m2: f64) -> f64 {
    let share = if merged.weight > 0.0 { b.weight / merged.weight } else { 0.5 };
    let colour = colours[0].lerp(colours[1], share);
    let fields =
        // The merged field counts negatively, so that the square of the sum is the square of the
        // difference.
        [(a, a.weight, colours[0]), (b, b.weight, colours[1]), (merged, -merged.weight, colour)];
    let term = |i: usize, j: usize| {
        let (p, weight_p, colour_p) = fields[i];
        let (q, weight_q, colour_q) = fields[j];
        // 1 + p·q is the inner product of (1, colour) with (1, colour): opacity counts as much as a
        // channel of colour.
        weight_p * weight_q * (1.0 + colour_p.dot(colour_q)) * overlap(p, q, blur_m2)
    };
    let there = term(0, 0) + term(1, 1) + 2.0 * term(0, 1);
    let difference = there + term(2, 2) + 2.0 * (term(0, 2) + term(1, 2));
    if there > 0.0 { difference / there } else { 0.0 }
}

/// `N(a - b; 0, A + B + 2 blur)` without the constant `(2 π)^(-3/2)`.
fn overlap(a: &Node, b: &Node, blur_m2: f64) -> f64 {
    // Each of the two is blurred, so that the variance counts twice.
    let sum = a.cov_m2 + b.cov_m2 + DMat3::from_diagonal(DVec3::splat(2.0 * blur_m2));
    let offset = b.mean_m - a.mean_m;
    // Solve by Cramer's rule: the cofactor rows are the inverse times the determinant.
    let x = sum.x_axis;
    let y = sum.y_axis;
    let z = sum.z_axis;
    let yz = y.cross(z);
    let zx = z.cross(x);
    let xy = x.cross(y);
    let determinant = x.dot(yz);
    let solved = DVec3::new(yz.dot(offset), zx.dot(offset), xy.dot(offset));
    (-0.5 * offset.dot(solved) / determinant).exp() / determinant.sqrt()
}

fn outer(v: DVec3) -> DMat3 {
    DMat3::from_cols(v * v.x, v * v.y, v * v.z)
}

/// Eigenvalues and a right-handed set of eigenvectors of a symmetric matrix, by Jacobi rotations.
/// Each rotation makes one off-diagonal entry zero; five rounds reach the accuracy of f64.
fn eigen(mut matrix: DMat3) -> (DVec3, DMat3) {
    let mut vectors = DMat3::IDENTITY;
    for _ in 0..8 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let pp = matrix.col(p)[p];
            let qq = matrix.col(q)[q];
            let pq = matrix.col(q)[p];
            if pq.abs() <= 1e-18 * (pp.abs() + qq.abs()) {
                continue;
            }
            // Golub & Van Loan, Matrix Computations, symmetric Schur decomposition.
            let tau = (qq - pp) / (2.0 * pq);
            // The smaller of the two angles that make the entry 0: it is at most 45 degrees, which
            // keeps the iteration stable.
            let t = tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt());
            let cos = 1.0 / (1.0 + t * t).sqrt();
            let sin = t * cos;
            let mut turn = DMat3::IDENTITY;
            turn.col_mut(p)[p] = cos;
            turn.col_mut(q)[q] = cos;
            turn.col_mut(q)[p] = sin;
            turn.col_mut(p)[q] = -sin;
            matrix = turn.transpose() * matrix * turn;
            vectors *= turn;
        }
    }
    (DVec3::new(matrix.x_axis.x, matrix.y_axis.y, matrix.z_axis.z), vectors)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ball(x: f64, sigma_m: f64, opacity: f64) -> Node {
        let scale_m = DVec3::splat(sigma_m);
        let cov_m2 = DMat3::from_diagonal(scale_m * scale_m);
        let weight = opacity * area_m2(scale_m);
        let hidden_weight = weight * hidden_share(opacity);
        let axes = DMat3::IDENTITY;
        Node { mean_m: DVec3::X * x, cov_m2, scale_m, axes, weight, hidden_weight }
    }

    #[test]
    fn eigenvectors_make_the_matrix_again() {
        let turn = DMat3::from_quat(DQuat::from_xyzw(0.3, -0.5, 0.7, 0.2).normalize());
        for squares in [[4.0, 1.0, 1e-8], [1.0, 1.0, 1.0], [1e4, 1e-9, 2e-9], [0.0, 0.0, 0.0]] {
            let squares = DVec3::from_array(squares);
            let matrix = turn * DMat3::from_diagonal(squares) * turn.transpose();
            let (values, axes) = eigen(matrix);
            let again = axes * DMat3::from_diagonal(values) * axes.transpose();
            let off = (again - matrix).to_cols_array().map(f64::abs);
            assert!(off.iter().all(|&off| off <= 1e-14 * squares.max_element()), "{off:?}");
            assert!((axes.determinant() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn a_merger_has_the_moments_of_both() {
        let mut merged = joined(&ball(-1.0, 0.5, 0.8), &ball(1.0, 0.5, 0.8));
        merged.diagonalise();
        assert!((merged.mean_m - DVec3::ZERO).length() < 1e-15);
        // A variance of 0.25 m² of each, and a displacement of 1 m along x.
        let wanted = DVec3::new(1.25_f64.sqrt(), 0.5, 0.5);
        assert!((merged.scale_m - wanted).length() < 1e-12, "{}", merged.scale_m);
        assert!((merged.weight - 2.0 * 0.8 * 0.75).abs() < 1e-12);
    }

    #[test]
    fn twins_on_one_spot_cost_nothing_and_become_twice_as_opaque() {
        let a = ball(0.0, 0.5, 0.8);
        let b = ball(0.0, 0.5, 0.8);
        let mut merged = joined(&a, &b);
        merged.diagonalise();
        let opacity = merged.stored().opacity();
        assert!((opacity - 1.6).abs() < 1e-6, "{opacity}");
        assert!(cost(&a, &b, &merged, [DVec3::ONE; 2], 1e-4).abs() < 1e-12);
    }

    #[test]
    fn distance_and_colour_cost() {
        let price = |x: f64, colours: [DVec3; 2], blur_m2: f64| {
            let a = ball(0.0, 0.1, 0.8);
            let b = ball(x, 0.1, 0.8);
            let mut merged = joined(&a, &b);
            merged.diagonalise();
            cost(&a, &b, &merged, colours, blur_m2)
        };
        let grey = [DVec3::splat(0.5); 2];
        let near = price(0.1, grey, 1e-4);
        let far = price(1.0, grey, 1e-4);
        assert!(near < 0.01 && far > 0.3, "{near}, {far}");
        assert!(price(1.0, grey, 1.0) < 0.01, "what a blur hides is free");
        assert!(price(0.1, [DVec3::ZERO, DVec3::ONE], 1e-4) > near);
    }
}
