//! Lateral dynamics while speed changes. There is no closed form, so the state is approximated by a
//! polynomial that satisfies `|v| dz/dt = G(v) z + v steer δ` at five nodes of an interval (Radau
//! IIA, order 9: Hairer and Wanner, "Solving Ordinary Differential Equations II", IV.5). The
//! equation is linear, so one system of ten linear equations gives the solution. The last node is
//! the end of the interval, so the method is L-stable: stiff transients are damped. Nothing is
//! divided by v.

use std::sync::LazyLock;

use glam::DVec2;

use super::vehicle::LateralDynamics;

/// Number of nodes of an interval.
pub(super) const POINTS: usize = 5;

/// The nodes on [0, 1]: the zeros of the right Radau polynomial of degree 5.
pub(super) const NODES: [f64; POINTS] = [
    0.057_104_196_114_517_68,
    0.276_843_013_638_123_8,
    0.583_590_432_368_916_8,
    0.860_240_135_656_219_5,
    1.0,
];

/// Weights of the integrals from the start of the interval to each node. The last row is the
/// quadrature over the interval, exact for polynomials of degree 8.
pub(super) static INTEGRALS: LazyLock<[[f64; POINTS]; POINTS]> = LazyLock::new(|| {
    // Exact for every power: sum_j a_ij c_j^k = c_i^(k + 1) / (k + 1).
    let powers: [[f64; POINTS]; POINTS] =
        std::array::from_fn(|k| NODES.map(|node| node.powi(k as i32)));
    NODES.map(|node| {
        let wanted = std::array::from_fn(|k| node.powi(k as i32 + 1) / (k + 1) as f64);
        // Row k of `powers` has the k-th powers of all nodes, so the solution is one weight per
        // node.
        solved(powers, wanted)
    })
});

/// Weights of the derivative at each node, applied to the changes since the start of the interval.
static DERIVATIVES: LazyLock<[[f64; POINTS]; POINTS]> = LazyLock::new(|| {
    // Exact for every power: sum_j d_ij c_j^(k + 1) = (k + 1) c_i^k.
    let powers: [[f64; POINTS]; POINTS] =
        std::array::from_fn(|k| NODES.map(|node| node.powi(k as i32 + 1)));
    NODES.map(|node| {
        // The changes since the start are 0 for a constant, so the powers start at 1 and degree 5
        // is still exact.
        let wanted = std::array::from_fn(|k| (k + 1) as f64 * node.powi(k as i32));
        solved(powers, wanted)
    })
});

/// Lateral velocity (m/s) and yaw rate (rad/s) at the nodes of an interval of `piece_s` seconds
/// that starts with `sideways`, given the speeds (m/s, of one sign) and steering angles (rad) at
/// the nodes.
pub(super) fn solve(
    tyres: &LateralDynamics,
    piece_s: f64,
    speeds_m_s: &[f64; POINTS],
    angles_rad: &[f64; POINTS],
    sideways: DVec2,
) -> [DVec2; POINTS] {
    let derivatives = &*DERIVATIVES;
    let mut rows = [[0.0; 2 * POINTS]; 2 * POINTS];
    let mut right = [0.0; 2 * POINTS];
    // The unknowns are the changes since the start: |v| D y - G y = G z + v steer δ.
    for point in 0..POINTS {
        let speed = speeds_m_s[point];
        let angle = angles_rad[point];
        let matrix = tyres.matrix(speed);
        let pull = matrix * sideways + tyres.steer * (speed * angle);
        // `|v| / piece_s` scales the derivative from the unit interval to seconds.
        let rate = speed.abs() / piece_s;
        for other in 0..POINTS {
            // Derivatives couple a component only with itself at other nodes. Lateral velocity is
            // in the even rows, and yaw rate in the odd rows.
            rows[2 * point][2 * other] = rate * derivatives[point][other];
            rows[2 * point + 1][2 * other + 1] = rate * derivatives[point][other];
        }
        // G couples both components, but only within the node.
        for (row, column) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            rows[2 * point + row][2 * point + column] -= matrix.col(column)[row];
        }
        right[2 * point] = pull.x;
        right[2 * point + 1] = pull.y;
    }
    // At v = 0 all derivative terms vanish and each node solves `G y = -G z`, so that lateral
    // velocity and yaw rate become 0.
    let changes = solved(rows, right);
    std::array::from_fn(|point| sideways + DVec2::new(changes[2 * point], changes[2 * point + 1]))
}

/// Solves a system of linear equations by Gaussian elimination with partial pivoting.
fn solved<const N: usize>(mut rows: [[f64; N]; N], mut right: [f64; N]) -> [f64; N] {
    for column in 0..N {
        // `total_cmp` gives NaN a place instead of a panic; a NaN of the input then reaches the
        // result.
        let larger =
            |a: &usize, b: &usize| rows[*a][column].abs().total_cmp(&rows[*b][column].abs());
        let pivot = (column..N).max_by(larger).unwrap_or(column);
        rows.swap(column, pivot);
        right.swap(column, pivot);
        // A copy, because the rows below are changed while this row is read.
        let above = rows[column];
        for row in column + 1..N {
            let factor = rows[row][column] / above[column];
            // The columns left of the pivot are zero already.
            for (number, pivotal) in rows[row].iter_mut().zip(above).skip(column) {
                *number -= factor * pivotal;
            }
            right[row] -= factor * right[column];
        }
    }
    // From here on the matrix is upper triangular, and the unknowns follow from the last to the
    // first.
    for row in (0..N).rev() {
        let known: f64 = (row + 1..N).map(|k| rows[row][k] * right[k]).sum();
        right[row] = (right[row] - known) / rows[row][row];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quadrature_is_exact_to_degree_eight() {
        for degree in 0..=9 {
            // The integral of x^d over [0, 1] is 1 / (d + 1). Degree 9 must fail: otherwise the
            // test would not see a wrong bound.
            let sum: f64 =
                NODES.iter().zip(INTEGRALS[POINTS - 1]).map(|(x, w)| w * x.powi(degree)).sum();
            let error = (sum - 1.0 / f64::from(degree + 1)).abs();
            assert!((error < 1e-15) == (degree <= 8), "degree {degree}: {error}");
        }
    }
}
