//! The Savitzky-Golay filter: a polynomial is fitted to each window of samples.

/// Filters samples, or differentiates them, by polynomials of degree `order` fitted to windows of
/// `window` samples.
///
/// As scipy's `savgol_filter` with `mode="interp"`: the first and last half windows are read from
/// the polynomial of the first and last whole window. An even window has its middle between two
/// samples; the value is that of the middle, half a sample late. `delta` is the spacing of the
/// samples, `derivative` 0, 1 or 2.
///
/// # Panics
/// If `window` is not above `order`, or there are fewer samples than `window`.
pub fn savgol(
    values: &[f64],
    window: usize,
    order: usize,
    derivative: usize,
    delta: f64,
) -> Vec<f64> {
    assert!(order < window && window <= values.len(), "a window from order + 1 to all samples");
    // `inner` serves all samples whose window is centred; samples at the ends get weights of their
    // own.
    let half = window / 2;
    let inner = weights(window, 0.5 * (window - 1) as f64, order, derivative);
    // In an even window, sample i is the earlier of the middle two, and the value is that half a
    // sample after it.
    let samples_before = if window.is_multiple_of(2) { half - 1 } else { half };
    let last_start = values.len() - window;
    // Weights are for a spacing of 1; a derivative by x scales with 1 / delta.
    let scale = delta.powi(derivative as i32);
    let filtered = |i: usize| {
        let at_edge;
        let (row, start) = if i < half {
            at_edge = weights(window, i as f64, order, derivative);
            (&at_edge, 0)
        } else if i >= values.len() - half {
            at_edge = weights(window, (i - last_start) as f64, order, derivative);
            (&at_edge, last_start)
        } else {
            (&inner, i - samples_before)
        };
        let sum: f64 = row.iter().zip(&values[start..]).map(|(weight, value)| weight * value).sum();
        sum / scale
    };
    (0..values.len()).map(filtered).collect()
}

/// Weights of `window` samples at 0, 1, .. whose sum is a derivative, at `at`, of their
/// least-squares polynomial.
fn weights(window: usize, at: f64, order: usize, derivative: usize) -> Vec<f64> {
    // Powers of positions relative to the middle, in half windows, so that the normal equations
    // stay well conditioned: all powers are at most 1.
    let middle = 0.5 * (window - 1) as f64;
    let unit = middle.max(0.5);
    let position = |x: f64| (x - middle) / unit;
    let terms = order + 1;
    let powers: Vec<Vec<f64>> = (0..window)
        .map(|k| (0..terms).map(|p| position(k as f64).powi(p as i32)).collect())
        .collect();
    // The derivative of the polynomial at `at` is d · c, where the coefficients c solve (Xᵀ X) c =
    // Xᵀ y. So its weights are X (Xᵀ X)⁻¹ d.
    let mut system: Vec<Vec<f64>> = (0..terms)
        .map(|i| {
            // A row is [sums of products, right side]. The right side has the chain rule: a
            // derivative in half windows, divided by the unit for each order.
            let row = (0..terms).map(|j| powers.iter().map(|x| x[i] * x[j]).sum());
            row.chain([
                derivative_of_power(i, derivative, position(at)) / unit.powi(derivative as i32)
            ])
            .collect()
        })
        .collect();
    let solution = solve(&mut system);
    powers.iter().map(|x| x.iter().zip(&solution).map(|(x, s)| x * s).sum()).collect()
}

/// The derivative of x^power.
fn derivative_of_power(power: usize, derivative: usize, x: f64) -> f64 {
    if power < derivative {
        return 0.0;
    }
    let factor: usize = (power - derivative + 1..=power).product();
    factor as f64 * x.powi((power - derivative) as i32)
}

/// Solves a linear system of rows [coefficients, right side] by elimination with row pivots.
fn solve(rows: &mut [Vec<f64>]) -> Vec<f64> {
    let n = rows.len();
    for i in 0..n {
        let largest = |&a: &usize, &b: &usize| rows[a][i].abs().total_cmp(&rows[b][i].abs());
        let pivot = (i..n).max_by(largest).unwrap_or(i);
        rows.swap(i, pivot);
        let (head, tail) = rows.split_at_mut(i + 1);
        let pivot_row = &head[i];
        for row in tail {
            let factor = row[i] / pivot_row[i];
            for (value, above) in row.iter_mut().zip(pivot_row) {
                *value -= factor * above;
            }
        }
    }
    let mut solution = vec![0.0; n];
    for i in (0..n).rev() {
        let known: f64 = (i + 1..n).map(|j| rows[i][j] * solution[j]).sum();
        solution[i] = (rows[i][n] - known) / rows[i][i];
    }
    solution
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_of_its_degree_pass_unchanged() {
        let cubic = |x: f64| 2.0 - x + 0.5 * x * x - 0.1 * x * x * x;
        let slope = |x: f64| -1.0 + x - 0.3 * x * x;
        let samples: Vec<f64> = (0..12).map(|k| cubic(0.1 * f64::from(k))).collect();
        let same = savgol(&samples, 7, 3, 0, 0.1);
        let slopes = savgol(&samples, 7, 3, 1, 0.1);
        for k in 0..12 {
            let x = 0.1 * k as f64;
            assert!((same[k] - cubic(x)).abs() < 1e-13, "{k}: {}", same[k]);
            assert!((slopes[k] - slope(x)).abs() < 1e-11, "{k}: {}", slopes[k]);
        }
    }

    #[test]
    fn an_even_window_is_half_a_sample_late() {
        let samples: Vec<f64> = (0..10).map(f64::from).collect();
        let filtered = savgol(&samples, 4, 1, 0, 1.0);
        // A window of 4 around the interval from 5 to 6 has its middle at 5.5.
        assert!((filtered[5] - 5.5).abs() < 1e-13, "{}", filtered[5]);
        assert!((filtered[0] - 0.0).abs() < 1e-13 && (filtered[9] - 9.0).abs() < 1e-13);
    }
}
