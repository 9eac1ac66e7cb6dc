//! Order statistics of a few values.

/// The least value. NaN if one of the values is NaN, or if there are none.
pub(super) fn min(values: impl IntoIterator<Item = f64>) -> f64 {
    // `f64::min` would drop a NaN.
    let lesser = |a: f64, b: f64| if a.is_nan() || a <= b { a } else { b };
    values.into_iter().reduce(lesser).unwrap_or(f64::NAN)
}

/// The quantile of a share from 0 to 1: the value at the nearest rank, without interpolation. NaN
/// if there are no values.
pub(super) fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    // share <= 1, so that the index is at most the last one.
    sorted.get((last as f64 * share).round() as usize).copied().unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_nan_is_never_hidden() {
        assert_eq!(min([2.0, 1.0, 3.0]), 1.0);
        assert!(min([1.0, f64::NAN]).is_nan() && min([f64::NAN, 1.0]).is_nan());
        assert!(min([]).is_nan() && quantile(&[], 0.5).is_nan());
    }

    #[test]
    fn a_quantile_is_one_of_the_values() {
        let values = [4.0, 1.0, 3.0, 2.0, 5.0];
        // 0.95 x 4 = 3.8 rounds to the last of five.
        assert_eq!([0.0, 0.5, 0.95, 1.0].map(|q| quantile(&values, q)), [1.0, 3.0, 5.0, 5.0]);
    }
}
