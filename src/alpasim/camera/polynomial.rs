//! Polynomials by least squares.

/// Points at which a polynomial is fitted.
const FIT_POINTS: usize = 256;

/// Coefficients of powers 0 to 5 of the polynomial through 0 that is nearest to `of` on [0, `end`],
/// by least squares. The variable is scaled to [0, 1], so that the normal equations are
/// well-conditioned enough.
pub(super) fn fitted(end: f64, of: &dyn Fn(f64) -> f64) -> [f64; 6] {
    // Powers 1 to 5: a polynomial through 0 has no power 0, because the principal point is at angle
    // 0.
    const TERMS: usize = 5;
    // The normal equations A^T A c = A^T y, with the right side as the last column. They are summed
    // point by point, so that the 256 x 5 matrix A is never stored.
    let mut normal = [[0.0; TERMS + 1]; TERMS];
    for point in 1..=FIT_POINTS {
        // Not from 0: the polynomial is 0 there by its form.
        let t = point as f64 / FIT_POINTS as f64;
        let value = of(t * end);
        let powers: [f64; TERMS] = std::array::from_fn(|k| t.powi(k as i32 + 1));
        for (row, &power) in normal.iter_mut().zip(&powers) {
            for (entry, &other) in row.iter_mut().zip(&powers) {
                *entry += power * other;
            }
            row[TERMS] += power * value;
        }
    }
    let solution = solved(normal);
    let mut coefficients = [0.0; 6];
    for (power, value) in (1..).zip(solution) {
        // The fit is in t = x / end, and the result in x: c_k t^k = (c_k / end^k) x^k.
        coefficients[power] = value / end.powi(power as i32);
    }
    coefficients
}

/// Solves five linear equations by elimination with pivots; each row is followed by its right side.
fn solved(mut rows: [[f64; 6]; 5]) -> [f64; 5] {
    for column in 0..5 {
        // The largest entry of the column as pivot keeps the factors at 1 or below, and so the
        // rounding.
        let pivot = (column..5)
            .max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))
            .unwrap_or(column);
        rows.swap(column, pivot);
        let pivot_row = rows[column];
        // Afterwards the entries below the diagonal of this column are 0.
        for row in rows.iter_mut().skip(column + 1) {
            let factor = row[column] / pivot_row[column];
            for (entry, &other) in row.iter_mut().zip(&pivot_row) {
                *entry -= factor * other;
            }
        }
    }
    let mut solution = [0.0; 5];
    // The matrix is triangular now; each row has one unknown, given those of the rows below it.
    for column in (0..5).rev() {
        let known: f64 = (column + 1..5).map(|k| rows[column][k] * solution[k]).sum();
        solution[column] = (rows[column][5] - known) / rows[column][column];
    }
    solution
}
