//! Polynomials by least squares.

/// Points at which a polynomial is fitted.
const FIT_POINTS: usize = 256;

/// Coefficients of powers 0 to 5 of the polynomial through 0 that is nearest to `of` on [0, `end`],
/// by least squares. The variable is scaled to [0, 1], so that the normal equations are
/// well-conditioned enough.
pub(super) fn fitted(end: f64, of: &dyn Fn(f64) -> f64) -> [f64; 6] {
    const TERMS: usize = 5;
    let mut normal = [[0.0; TERMS + 1]; TERMS];
    for point in 1..=FIT_POINTS {
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
        coefficients[power] = value / end.powi(power as i32);
    }
    coefficients
}

/// Solves five linear equations by elimination with pivots; each row is followed by its right side.
fn solved(mut rows: [[f64; 6]; 5]) -> [f64; 5] {
    for column in 0..5 {
        let pivot = (column..5)
            .max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))
            .unwrap_or(column);
        rows.swap(column, pivot);
        let pivot_row = rows[column];
        for row in rows.iter_mut().skip(column + 1) {
            let factor = row[column] / pivot_row[column];
            for (entry, &other) in row.iter_mut().zip(&pivot_row) {
                *entry -= factor * other;
            }
        }
    }
    let mut solution = [0.0; 5];
    for column in (0..5).rev() {
        let known: f64 = (column + 1..5).map(|k| rows[column][k] * solution[k]).sum();
        solution[column] = (rows[column][5] - known) / rows[column][column];
    }
    solution
}
